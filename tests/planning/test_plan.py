"""plan(): certified or refused with a reason, whatever the planner does."""

import re
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from cfplan.errors import CfplanError, InfeasibleError, InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.yaw import YawMode
from cfplan.planners.expert.expert import refinements
from cfplan.planners.expert.tuning import WindowSize
from cfplan.planners.solution import Solution, Status
from cfplan.planning import repair
from cfplan.planning.plan import plan
from cfplan.planning.planners import FEWEST_NODES, MOST_NODES, PLANNERS, default_nodes, find_planner
from cfplan.safety.certificate import certify


def stub(monkeypatch, **answers):
    """Replace planners by functions of (path, nodes) that give a Solution, others by failures; return the calls."""
    calls = []

    def find(name):
        def planner(task):
            calls.append((name, task.nodes, task))
            answer = answers.get(name, lambda path, nodes: Solution(Status.NOT_CONVERGED, None))
            return answer(task.path, task.nodes)

        return planner

    monkeypatch.setattr("cfplan.planning.policy.find_planner", find)
    return calls


def test_a_plan_is_certified_for_its_limits_and_space(path, limits):
    made = plan(path, limits.airframe, limits, planner="minsnap")
    assert made.certificate.passed
    assert made.certificate == certify(made.trajectory, limits.plan, limits.space)
    assert (made.planner, made.nodes, made.speed_factor) == ("minsnap", default_nodes(path), 1.0)
    assert made.profile is made.trajectory.profile
    assert made.seconds > 0


def test_too_fast_a_profile_is_slowed_and_the_plan_says_by_how_much(path, limits, make_profile, monkeypatch):
    fast = make_profile(path.end, np.full(40, 9.0))
    calls = stub(monkeypatch, toppquad=lambda path, nodes: Solution(Status.SOLVED, fast))
    made = plan(path, limits.airframe, limits, planner="toppquad")
    assert made.certificate.passed
    assert 0.1 < made.repair_speed_factor < 0.9
    assert f"{made.repair_speed_factor:.2%}" in made.notes[-1]
    # Once more with twice the nodes, in the hope of slowing less.
    assert [nodes for _, nodes, _ in calls] == [default_nodes(path), 2 * default_nodes(path)]


def test_the_faster_of_two_tries_is_taken(path, limits, make_profile, monkeypatch):
    def answer(path, nodes):
        rates = np.full(nodes + 3, 9.0)
        if nodes == default_nodes(path):
            rates[20] = 0.5  # rough, so that it must be slowed more
        return Solution(Status.SOLVED, make_profile(path.end, rates))

    stub(monkeypatch, toppquad=answer)
    assert plan(path, limits.airframe, limits, planner="toppquad").nodes == 2 * default_nodes(path)


def test_nodes_that_are_given_are_kept(path, limits, make_profile, monkeypatch):
    fast = make_profile(path.end, np.full(40, 9.0))
    calls = stub(monkeypatch, toppquad=lambda path, nodes: Solution(Status.SOLVED, fast))
    plan(path, limits.airframe, limits, planner="toppquad", nodes=77)
    assert [nodes for _, nodes, _ in calls] == [77]


def test_where_the_planner_fails_another_one_steps_in_and_the_plan_says_so(path, limits, make_profile, monkeypatch):
    stub(
        monkeypatch,
        toppquad=lambda path, nodes: Solution(Status.NOT_CONVERGED, None, "restoration failed"),
        **{"minsnap": lambda path, nodes: Solution(Status.SOLVED, make_profile(path.end, np.full(40, 0.5)))},
    )
    made = plan(path, limits.airframe, limits, planner="toppquad")
    assert made.planner == "minsnap"
    assert made.certificate.passed
    assert "did not converge" in made.notes[0]
    assert "restoration failed" in made.notes[0]


def test_an_unsound_profile_counts_as_a_failure(path, limits, make_profile, monkeypatch):
    sound = make_profile(path.end, np.full(40, 0.5))
    broken = replace(sound, h=np.full_like(sound.h, np.nan))
    stub(
        monkeypatch,
        toppquad=lambda path, nodes: Solution(Status.SOLVED, broken),
        convex=lambda path, nodes: Solution(Status.SOLVED, sound),
    )
    made = plan(path, limits.airframe, limits, planner="toppquad")
    assert made.planner == "convex"
    assert "h is not finite" in made.notes[0]


def test_where_every_planner_fails_the_reasons_are_given_in_one_line(path, limits, monkeypatch):
    stub(monkeypatch, toppquad=lambda path, nodes: Solution(Status.INFEASIBLE, None, "no\nway"))
    with pytest.raises(InfeasibleError, match="no profile meets the limits") as error:
        plan(path, limits.airframe, limits, planner="toppquad")
    assert "\n" not in str(error.value)
    assert error.value.hint


def test_a_speed_share_slows_the_whole_flight(path, limits):
    whole, half = (plan(path, limits.airframe, limits, planner="minsnap", speed_factor=share) for share in (1.0, 0.5))
    assert half.trajectory.duration == pytest.approx(2 * whole.trajectory.duration)
    fast, slow = ({margin.name: margin.worst for margin in made.certificate.margins} for made in (whole, half))
    assert slow["speed"] == pytest.approx(fast["speed"] / 2, rel=1e-4)
    assert slow["acceleration"] == pytest.approx(fast["acceleration"] / 4, rel=1e-3)
    assert half.certificate.passed


@pytest.mark.parametrize("arguments", [{"speed_factor": s} for s in (0.0, -1.0, 1.1, float("nan"))] + [{"nodes": 1}])
def test_arguments_out_of_range_are_refused(path, limits, arguments):
    with pytest.raises(InputError, match=re.escape(next(iter(arguments))[:5])):
        plan(path, limits.airframe, limits, planner="minsnap", **arguments)


def test_a_boundary_state_is_never_slowed_away(path, limits, make_profile, monkeypatch):
    fast = make_profile(path.end, np.full(40, 9.0))
    stub(monkeypatch, toppquad=lambda path, nodes: Solution(Status.SOLVED, fast))
    with pytest.raises(InfeasibleError, match="break the boundary state"):
        plan(path, limits.airframe, limits, planner="toppquad", start=fast.boundary(0))
    with pytest.raises(InputError, match="break the boundary state"):
        plan(path, limits.airframe, limits, planner="toppquad", start=fast.boundary(0), speed_factor=0.5)


def test_yaw_and_the_boundary_state_reach_the_planner(path, limits, make_profile, monkeypatch):
    slow = make_profile(path.end, np.full(40, 0.1))
    calls = stub(monkeypatch, toppquad=lambda path, nodes: Solution(Status.SOLVED, slow))
    start = slow.boundary(0)
    plan(path, limits.airframe, limits, planner="toppquad", yaw=YawMode.TANGENT, yaw_angle=0.3, start=start)
    task = calls[0][2]
    assert (task.yaw, task.yaw_angle, task.start) == (YawMode.TANGENT, 0.3, start)


def test_a_path_outside_the_space_is_refused_before_any_planner_runs(limits, monkeypatch):
    calls = stub(monkeypatch)
    with pytest.raises(InfeasibleError, match="beyond the "):
        plan(min_snap([[0, 0, 1], [5, 0, 1]]), limits.airframe, limits)
    assert not calls


def test_a_path_longer_than_the_battery_lasts_is_refused(path, limits):
    tired = replace(limits, battery=replace(limits.battery, endurance=15.0))
    with pytest.raises(InfeasibleError, match="the battery is trusted for 15 s"):
        plan(path, limits.airframe, tired, planner="minsnap", speed_factor=0.5)


def test_too_fast_a_profile_of_the_learned_planner_is_refined_and_the_plan_says_where(
    path, limits, make_profile, monkeypatch
):
    fast = make_profile(path.end, np.full(64, 4.0))
    best = plan(path, limits.airframe, limits, planner="expert", nodes=61)
    stub(monkeypatch, learned=lambda path, nodes: Solution(Status.SOLVED, fast))
    made = plan(path, limits.airframe, limits, planner="learned")
    assert made.certificate.passed
    assert made.repair_speed_factor == 1.0
    assert made.trajectory.duration == pytest.approx(best.trajectory.duration, rel=5e-3)
    assert re.search(r"refined; slower along .* most at s = .*, by .*%", made.notes[-1])


def test_a_plan_made_window_by_window_tells_where_they_meet(limits, make_profile, monkeypatch):
    zigzag = min_snap([[(-1) ** turn, 0.4 * turn - 1.6, 1.0] for turn in range(9)])
    monkeypatch.setattr(repair, "refinements", partial(refinements, window=WindowSize(96, 32)))
    found = {n: plan(zigzag, limits.airframe, limits, planner="convex", nodes=n) for n in (100, 150)}
    assert all("refined" in made.notes[-1] for made in found.values())
    assert found[100].joints == ()
    assert found[150].joints == pytest.approx([96 / 150 * zigzag.end])

    slow = make_profile(zigzag.end, np.full(150 + 3, 0.2))
    stub(monkeypatch, expert=lambda path, nodes: Solution(Status.SOLVED, slow, joints=(1.25, 2.5)))
    chained = plan(zigzag, limits.airframe, limits, planner="expert")
    assert chained.notes == ()
    assert chained.joints == (1.25, 2.5)


def test_where_the_learned_planner_fails_the_expert_steps_in(path, limits, make_profile, monkeypatch):
    stub(
        monkeypatch,
        learned=lambda path, nodes: Solution(Status.NOT_CONVERGED, None, "answered what is not a number"),
        expert=lambda path, nodes: Solution(Status.SOLVED, make_profile(path.end, np.full(40, 0.5))),
    )
    made = plan(path, limits.airframe, limits, planner="learned")
    assert made.planner == "expert"
    assert "not a number" in made.notes[0]


def automatic(monkeypatch, make_profile, model=True, outside=(), **rates):
    """plan() with planners that fly at these rates."""
    answers = {
        name: lambda path, nodes, rate=rate: Solution(Status.SOLVED, make_profile(path.end, np.full(64, rate)))
        for name, rate in rates.items()
    }
    known = SimpleNamespace(outside=lambda airframe, limits: outside) if model else None
    monkeypatch.setattr("cfplan.planning.policy.find_model", lambda airframe, limits, folders: known)
    return stub(monkeypatch, **answers)


def test_auto_refines_the_networks_proposal_to_the_experts_optimum(path, limits, make_profile, monkeypatch):
    """Whether it passes or not: slow or fast, the flight is the expert's."""
    best = plan(path, limits.airframe, limits, planner="expert", nodes=61)
    for rate in (0.3, 4.0):
        calls = automatic(monkeypatch, make_profile, learned=rate)
        made = plan(path, limits.airframe, limits)
        assert [name for name, *_ in calls] == ["learned"]
        assert made.planner == "learned"
        assert made.repair_speed_factor == 1.0
        assert made.trajectory.duration == pytest.approx(best.trajectory.duration, rel=5e-4)
        monkeypatch.undo()


def test_auto_asks_the_expert_where_refining_fails(path, limits, make_profile, monkeypatch):
    calls = automatic(monkeypatch, make_profile, learned=4.0, expert=0.39)
    failed = [Solution(Status.NOT_CONVERGED, None, "refining: no step improves the solution")]
    monkeypatch.setattr(repair, "refinements", lambda *_: failed)
    made = plan(path, limits.airframe, limits)
    assert [name for name, *_ in calls] == ["learned", "learned", "expert"]  # on two grids first
    assert any("no step improves" in note for note in made.notes) == (made.planner == "learned")
    assert made.certificate.passed


def test_auto_asks_the_expert_where_no_model_knows_the_limits_and_says_why(path, limits, make_profile, monkeypatch):
    calls = automatic(monkeypatch, make_profile, outside=("tilt is 1.6",), expert=0.39)
    made = plan(path, limits.airframe, limits)
    assert [name for name, *_ in calls] == ["expert"]
    assert "tilt is 1.6" in made.notes


def test_auto_plans_without_a_model(path, limits, make_profile, monkeypatch):
    calls = automatic(monkeypatch, make_profile, model=False, expert=0.39)
    made = plan(path, limits.airframe, limits)
    assert [name for name, *_ in calls] == ["expert"]
    assert any("cfplan train" in note for note in made.notes)


def test_auto_says_that_a_model_is_damaged_and_goes_on(path, limits, make_profile, monkeypatch):
    automatic(monkeypatch, make_profile, expert=0.39)

    def damaged(airframe, limits, folders):
        raise InputError("damaged", where="models/x")

    monkeypatch.setattr("cfplan.planning.policy.find_model", damaged)
    assert any("no learned plan: models/x: damaged" in n for n in plan(path, limits.airframe, limits).notes)


def test_a_vehicle_that_was_weighed_keeps_its_planner(path, limits):
    """33 g instead of 31.8: the model that comes with cfplan knows it, and the limits of a hand that edits them."""
    weighed = replace(limits.airframe, mass=0.033)
    edited = replace(limits, airframe=weighed, plan=replace(limits.plan, speed=1.4, acceleration=3.0))
    made = plan(path, weighed, edited)
    assert made.planner == "learned"
    assert made.certificate.passed
    best = plan(path, weighed, edited, planner="expert")
    assert made.trajectory.duration <= 1.0005 * best.trajectory.duration


def test_an_unknown_planner_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match="unknown planner 'min snap'") as error:
        find_planner("min snap")
    assert "did you mean minsnap?" in error.value.hint
    assert all(name in error.value.hint for name in PLANNERS)


def test_the_number_of_nodes_grows_with_the_path_within_bounds():
    def count(length):
        return default_nodes(min_snap([[0, 0, 1], [length, 0, 1]]))

    assert count(0.1) == FEWEST_NODES
    assert count(20.0) == pytest.approx(200, abs=1)
    assert count(1e4) == MOST_NODES
    waypoints = np.column_stack([0.02 * np.arange(101), np.zeros(101), np.ones(101)])
    assert default_nodes(min_snap(waypoints)) >= 300


@pytest.mark.parametrize("planner", ["auto", *(name for name in PLANNERS if name != "learned")])
def test_every_planner_ends_in_a_certified_plan_or_a_typed_error(limits, planner):
    path = min_snap([[-1, 0, 1], [0.5, 0.8, 1.3], [1, 0, 1]])
    try:
        made = plan(path, limits.airframe, limits, planner=planner, nodes=60)
    except CfplanError as error:
        pytest.fail(str(error))
    assert made.planner == planner or planner == "auto"
    assert made.certificate.passed
    assert made.repair_speed_factor > 0.8
