"""Planning ends in time: what is certified by the deadline is the answer, and the plan says what was left out.

Time is a count of how often planning asked for it, so a deadline falls between the same two steps on every machine.
"""

from dataclasses import replace
from itertools import count
from threading import Event

import pytest
from numba.core import event

from cfplan.deadline import NEVER, Deadline
from cfplan.errors import InfeasibleError
from cfplan.geometry.yaw import YawMode
from cfplan.planners.expert.expert import plan_expert, refine
from cfplan.planners.expert.tuning import WindowSize
from cfplan.planners.solution import Status
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan import plan
from cfplan.planning.planners import PLANNERS
from cfplan.planning.repair import repair
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import LIMIT_SETS
from studies.drawn_paths import path_of_length, random_path

HARDWARE = LIMIT_SETS["hardware"]


def after(questions: float) -> Deadline:
    """Return a deadline that has passed once it was asked that often."""
    ticks = count()
    return Deadline(questions, lambda: float(next(ticks)))


@pytest.mark.parametrize("questions", [0, 1, 3, 10, 30, 100])
@pytest.mark.parametrize("planner", ["auto", "learned", "expert", "convex"])
def test_whenever_the_deadline_comes_the_answer_is_certified(planner, questions, path, limits):
    made = plan(path, limits.airframe, limits, planner=planner, deadline=after(questions))
    assert made.certificate.passed
    assert certify(made.trajectory, limits.plan, limits.space).passed


@pytest.mark.parametrize("planner", ["auto", *PLANNERS])
def test_a_deadline_that_does_not_pass_changes_nothing(planner, path, limits):
    free = plan(path, limits.airframe, limits, planner=planner)
    timed = plan(path, limits.airframe, limits, planner=planner, deadline=after(1e9))
    assert (timed.profile.h == free.profile.h).all()
    assert timed.notes == free.notes
    assert timed.left_out == free.left_out == ""


def test_what_there_was_no_time_for_is_told(path, limits):
    made = plan(path, limits.airframe, limits, deadline=after(0))
    assert "not refined" in made.left_out
    assert "out of time" in made.left_out
    assert "not asked" in made.left_out


def test_what_is_late_is_given_up_where_another_planner_has_answered(path, limits):
    task = PlanningTask(path, limits.airframe, limits.plan, nodes=200, deadline=after(0))
    profile = plan(path, limits.airframe, limits).profile.slowed(1.5)
    assert repair(task, profile).certificate.passed
    with pytest.raises(InfeasibleError, match="out of time") as caught:
        repair(replace(task, dispensable=True), profile)
    assert "--budget" in caught.value.hint


def test_more_time_makes_faster_flights(path, limits):
    none, enough = (plan(path, limits.airframe, limits, deadline=after(questions)) for questions in (0, 1e9))
    assert enough.trajectory.duration < none.trajectory.duration < 1.5 * enough.trajectory.duration


def test_the_expert_that_runs_out_of_time_says_so_and_needs_no_clock_otherwise():
    path = random_path(1, "10x10x10")
    task = PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, yaw=YawMode.FREE)
    solution = plan_expert(replace(task, deadline=after(5)))
    assert solution.status is Status.OUT_OF_TIME
    assert "out of time" in solution.reason
    assert task.deadline is NEVER


def test_a_long_path_is_refined_as_far_as_time_allows():
    path = path_of_length(60.0, "10x10x10", 1)
    task = PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, 600)
    near = plan_expert(task).profile.slowed(0.7)
    part = refine(replace(task, deadline=after(20)), near, window=WindowSize(96, 24))
    assert part.status is Status.SOLVED
    assert "out of time" in part.reason
    assert (part.profile.h[40:80] > 1.2 * near.h[40:80]).all()
    assert part.profile.h[-100:] == pytest.approx(near.h[-100:], rel=1e-9)


def test_where_nothing_is_found_in_time_the_hint_is_to_give_more(path, limits, monkeypatch):
    monkeypatch.setattr("cfplan.planning.policy.ask", lambda planner, task, space: f"{planner}: {Status.OUT_OF_TIME}")
    with pytest.raises(InfeasibleError, match="--budget"):
        plan(path, limits.airframe, limits, deadline=after(0))


def test_what_takes_longer_than_the_battery_lasts_is_refused_before_it_is_planned(path, limits, monkeypatch):
    monkeypatch.setattr("cfplan.planning.plan.choose", None)
    short = replace(limits, battery=replace(limits.battery, endurance=20.0))
    with pytest.raises(InfeasibleError, match="at least"):
        plan(path, short.airframe, short, speed_factor=0.05)


def test_a_budget_is_time_that_a_user_waits_not_processor_time():
    deadline = Deadline.after(0.05)
    Event().wait(0.1)  # during which this process does not use the processor
    assert deadline.passed


def test_compiling_does_not_count():
    deadline = Deadline.after(1.0)
    with event.trigger_event("numba:compile"):
        Event().wait(1.2)
        assert deadline.left > 0.0
    assert not deadline.passed


def test_deadlines_count_on_their_own_clock():
    now = 5.0
    deadline = Deadline.after(2.0, lambda: now)
    assert (deadline.at, deadline.left, deadline.passed) == (7.0, 2.0, False)
    assert deadline.earlier(2.0).passed
    assert Deadline.after(float("inf"), lambda: now) is NEVER
    assert not NEVER.passed
    assert NEVER.left == float("inf")
