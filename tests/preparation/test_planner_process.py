"""The planner's process: what it proposes verifies, and whatever happens to it the pilot has what is committed."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing.connection import Connection

import numpy as np
import psutil
import pytest
from waiting import a_moment, until

from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.pilot.proposals import _ANSWER, _BEGUN, ReceivedProposals
from cfplan.flight.setpoints.commitment import (
    LEAST_AHEAD,
    QUANTUM,
    SPLICE_AHEAD,
    Commitment,
    Fault,
    Proposal,
    Refusal,
    propose,
    splice,
)
from cfplan.flight.setpoints.encoding import LEAD, RATE
from cfplan.flight.setpoints.packets import decode
from cfplan.geometry.min_snap import centripetal_times, min_snap
from cfplan.planning.continuation import TooLateError, Ways
from cfplan.planning.plan import plan
from cfplan.preparation import certified_flight, planner_worker
from cfplan.preparation import replan as replanning
from cfplan.preparation.air_planner import FIRST_PART, SLACK, PathAnswer, PathRequest, PathVerdict, Wish
from cfplan.preparation.certified_flight import EndsBadlyError
from cfplan.preparation.lead import IN_TIME, LEARNED_FROM, Lead
from cfplan.preparation.planner_process import AirPlanner
from cfplan.preparation.planner_worker import PlannerWorker
from cfplan.preparation.replan import hold, replan

LATE = 1.5  # s, longer than a planner waits for an answer
NOT_FLOWN = "the plan is not flown yet"
FAR = ((-0.5, 0.8, 1.0), (0.5, 2.0, 1.0), (-0.8, 0.4, 1.2), (0.8, -1.5, 0.9), (-0.8, 1.5, 1.0), (0.0, -2.0, 1.0))
WAYPOINTS = np.array([[-1.0, -2.0, 0.8], [0.8, -1.0, 1.1], [-0.6, 0.6, 0.9], [0.7, 1.8, 1.1]])


class PilotSide:
    """The pilot as the planner sees it: what it is committed to, at which moment.

    Where this computer is slow its time stands still until a proposal is there, so that none is late.
    """

    def __init__(self, commitment, limits, connection):
        self.commitment, self.limits = commitment, limits
        self.proposals = ReceivedProposals(connection)
        self.begun = 0.0
        self.given: list[Commitment | Refusal] = []
        self.silent_for: float | None = None  # s, for which the next answer is kept back
        self.told: list[PathAnswer] = []  # by the planner, and not looked at yet

    def begin(self, ago: float = 0.0) -> None:
        self.begun = REAL_CLOCK.now() - ago
        self.proposals.begin(self.begun)

    def tick(self) -> None:
        proposal = self.proposals.newest()
        if proposal is not None:
            now = min(round((REAL_CLOCK.now() - self.begun) * RATE), proposal.splice - LEAST_AHEAD)
            answer = splice(self.commitment, proposal, now, self.limits)
            if isinstance(answer, Commitment):
                self.commitment = answer
            self.given.append(answer)
            if self.silent_for is not None:
                REAL_CLOCK.sleep(self.silent_for)
                self.silent_for = None
            self.proposals.answer(proposal, answer)


@pytest.fixture(scope="module")
def held(limits):
    path = min_snap(WAYPOINTS, times=centripetal_times(WAYPOINTS))
    return hold(plan(path, limits.airframe, limits, planner="expert"), WAYPOINTS)


@pytest.fixture
def both(held, limits):
    """A planner's process that is ready, and the pilot's side of it."""
    theirs, ours = multiprocessing.get_context("spawn").Pipe()
    with AirPlanner(held, limits, theirs) as planner:
        theirs.close()
        assert until(lambda: bool(planner.answers()) or planner.ready)
        yield planner, PilotSide(held.commitment, limits, ours)


def answer_to(number: int, planner: AirPlanner, pilot: PilotSide) -> PathAnswer:
    """Return the first answer to a request that was not looked at yet; there may be two at once."""

    def answered() -> bool:
        pilot.tick()
        pilot.told.extend(planner.answers())
        return any(answer.number == number for answer in pilot.told)

    assert until(answered)
    return pilot.told.pop([answer.number for answer in pilot.told].index(number))


def begin(planner: AirPlanner, pilot: PilotSide) -> None:
    """Begin the flight, and wait until the planner knows: a thread of the pilot's tells it."""
    pilot.begin()
    assert until(lambda: answer_to(planner.request(Wish.EXTEND), planner, pilot).reason != NOT_FLOWN)


def test_requests_are_answered_and_the_pilot_is_committed_to_what_was_accepted(both, limits):
    planner, pilot = both
    early = answer_to(planner.request(Wish.REPLACE, [(0.0, 0.5, 1.0)]), planner, pilot)
    assert (early.verdict, early.reason) == (PathVerdict.REFUSED, NOT_FLOWN)
    pilot.begin()
    told: list[PathAnswer] = []

    def knows() -> bool:
        told.append(answer_to(planner.request(Wish.REPLACE, [(0.0, 0.5, 7.0)]), planner, pilot))
        return told[-1].reason != early.reason

    assert until(knows)
    assert told[-1].verdict is PathVerdict.REFUSED
    assert "waypoint 1" in told[-1].reason
    assert "hint" in told[-1].reason
    none = answer_to(planner.request(Wish.EXTEND), planner, pilot)
    assert none.verdict is PathVerdict.REFUSED
    # Late in the flight or after it, as slowly as this computer plans: from rest at the latest.
    answer = answer_to(planner.request(Wish.REPLACE, [(0.0, 0.5, 1.0)]), planner, pilot)
    assert answer.verdict is PathVerdict.ACCEPTED, answer
    assert isinstance(pilot.given[-1], Commitment)
    assert answer.splice in pilot.commitment.splices
    joint = round(answer.joint * RATE)
    assert 0 < joint - answer.splice <= SPLICE_AHEAD  # less by the setpoints that are the committed ones

    def goes_on() -> bool:
        pilot.tick()
        end = decode(pilot.commitment.payloads[-1:]).position[0]
        return pilot.commitment.splices[-1] > answer.splice or bool(np.abs(end - (0.0, 0.5, 1.0)).max() < 2e-3)

    assert until(goes_on)  # behind its first part
    numbers = np.arange(joint, joint + 20)
    committed = decode(pilot.commitment.payloads[numbers - pilot.commitment.first])
    planned = answer.plan.trajectory.at(numbers / RATE + LEAD - answer.joint)
    np.testing.assert_allclose(committed.position, planned.position, atol=QUANTUM)
    np.testing.assert_allclose(committed.velocity, planned.velocity, atol=QUANTUM)
    again = answer_to(planner.request(Wish.EXTEND, [(0.5, -0.5, 1.0)]), planner, pilot)
    assert again.verdict is PathVerdict.ACCEPTED, again


def test_a_request_that_comes_while_a_proposal_is_with_the_pilot_is_answered(both):
    planner, pilot = both
    begin(planner, pilot)
    planner.request(Wish.REPLACE, [(0.0, 0.5, 1.0)])
    proposals: list[Proposal] = []

    def proposed() -> bool:
        proposals.extend(filter(None, [pilot.proposals.newest()]))
        return bool(proposals)

    assert until(proposed)
    another = planner.request(Wish.REPLACE, [(0.0, 7.0, 1.0)])
    a_moment()  # the planner's process reads it, and waits for the pilot
    pilot.proposals.answer(proposals[0], Refusal(Fault.MOTION, ""))
    assert "waypoint 1" in answer_to(another, planner, pilot).reason


def test_the_latest_request_wins(both):
    planner, pilot = both
    begin(planner, pilot)
    assert planner.process_id is not None
    os.kill(planner.process_id, signal.SIGSTOP)  # so that it finds all of them, however slowly they are asked for
    numbers = [planner.request(Wish.REPLACE, [(0.0, 0.1 * k, 1.0)]) for k in range(6)]
    os.kill(planner.process_id, signal.SIGCONT)
    answers: list[PathAnswer] = []

    def all_answered() -> bool:
        pilot.tick()
        answers.extend(planner.answers())
        return len(answers) == len(numbers)

    assert until(all_answered)
    verdicts = {answer.number: answer.verdict for answer in answers}
    last = next(answer for answer in answers if answer.number == numbers[-1])
    assert [verdicts[number] for number in numbers[:-1]] == [PathVerdict.SUPERSEDED] * 5
    assert last.verdict is PathVerdict.ACCEPTED, last


def test_an_answer_that_comes_late_leaves_both_sides_with_the_same_commitment(both):
    """Longer than the planner waits for it: nobody is to plan on from what the pilot has left meanwhile."""
    planner, pilot = both
    pilot.begin()
    assert until(lambda: answer_to(planner.request(Wish.EXTEND), planner, pilot).reason != NOT_FLOWN)
    far = [(-0.5, 0.8, 1.0), (0.5, 2.0, 1.0), (-0.8, 0.4, 1.2), (0.8, -1.5, 0.9)]
    while not any(isinstance(answer, Commitment) for answer in pilot.given):
        pilot.silent_for = LATE
        number = planner.request(Wish.REPLACE, far)
        told = answer_to(number, planner, pilot)
    assert (told.number, told.verdict) == (number, PathVerdict.REFUSED)
    assert "the pilot does not answer" in told.reason
    assert answer_to(number, planner, pilot).verdict is PathVerdict.ACCEPTED  # it is flown after all
    later = [answer_to(planner.request(Wish.REPLACE, [(0.0, 0.5, 1.0)]), planner, pilot) for _ in range(2)]
    assert not any(answer.reason.startswith(Fault.ORDER) for answer in later), later
    assert any(answer.verdict is PathVerdict.ACCEPTED for answer in later), later


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_planner_that_is_killed_or_stopped_leaves_the_pilot_its_commitment(both, held, how):
    planner, pilot = both
    pilot.begin()
    assert planner.process_id is not None
    planner.request(Wish.REPLACE, [(0.0, 0.5, 1.0)])
    os.kill(planner.process_id, how)
    planner.request(Wish.STOP)
    for _ in range(20):
        pilot.tick()
        REAL_CLOCK.sleep(0.01)
    assert pilot.commitment is held.commitment
    # Before the signal came it may have refused the first request, as nothing was flown yet.
    assert {(answer.number, answer.verdict) for answer in planner.answers()} <= {(1, PathVerdict.REFUSED)}


def test_what_is_no_proposal_is_none(held):
    commitment = held.commitment
    good = propose(commitment, 100, commitment.payloads[100:], commitment.stops[100:])
    message = good.to_bytes()
    read = Proposal.of_bytes(message)
    assert (read.follows, read.splice, read.checksum) == (good.follows, good.splice, good.checksum)
    np.testing.assert_array_equal(read.payloads, good.payloads)
    np.testing.assert_array_equal(read.stops, good.stops)
    for broken in (b"", b"proposal", message[:-1], message + b"x", b"text " * 1000, bytes(len(message))):
        assert Proposal.of_bytes(broken) is None


def test_of_the_stops_within_a_stop_only_that_is_sent(held, limits):
    good = replan(held, 100, [[-0.5, 0.9, 1.0], [0.4, 2.0, 1.0]], limits, part=50).proposal
    message = good.to_bytes()
    read = Proposal.of_bytes(message)
    np.testing.assert_array_equal(read.payloads, good.payloads)
    np.testing.assert_array_equal(read.stops, good.stops)
    assert len(message) < 0.3 * good.stops.nbytes
    assert isinstance(splice(held.commitment, read, 90, limits), Commitment)
    stops = np.broadcast_to(good.stops[0], (20_000, *good.stops.shape[1:]))
    payloads = np.repeat(good.payloads[-1:], len(stops), axis=0)
    few = replace(good, payloads=payloads, stops=stops, ending=len(stops) - 1).to_bytes()
    assert Proposal.of_bytes(few) is None  # it would ask for any memory


@contextlib.contextmanager
def served(worker: PlannerWorker, main: Connection, pilot: Connection) -> Iterator[None]:
    """Let a thread do the worker's work until the ends of the main process and the pilot are closed."""

    def serve() -> None:
        with contextlib.suppress(EOFError, OSError):
            worker.serve()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        main.close()
        pilot.close()
        thread.join()


def two_answers(main: Connection, pilot: PilotSide) -> list[PathAnswer]:
    answers: list[PathAnswer] = []

    def both_are_told() -> bool:
        pilot.tick()
        while main.poll():
            answers.append(main.recv())
        return len(answers) == 2

    assert until(both_are_told)
    return answers


@pytest.mark.parametrize("accepted", [True, False])
def test_another_request_is_planned_while_the_pilot_looks_at_the_last_proposal(held, limits, accepted):
    (main, requests), (theirs, ours) = multiprocessing.Pipe(), multiprocessing.Pipe()
    worker, pilot = PlannerWorker(held, limits, requests, ours), PilotSide(held.commitment, limits, theirs)
    pilot.begin()
    assert until(lambda: worker._chain.read(0.1) is None and worker._chain.begun > 0.0)
    main.send(PathRequest(2, Wish.REPLACE, ((0.0, 0.5, 1.0),)))
    assert worker._answer(PathRequest(1, Wish.REPLACE, ((0.5, 0.9, 1.0),)), REAL_CLOCK.now()) is None
    assert worker._chain.held is not held  # but what it will be, if that is accepted
    if not accepted:
        assert until(lambda: (proposal := pilot.proposals.newest()) is not None and refused(pilot, proposal))

    with served(worker, main, theirs):
        first, second = two_answers(main, pilot)
    assert (first.number, first.verdict) == (1, PathVerdict.ACCEPTED if accepted else PathVerdict.REFUSED), first
    assert (second.number, second.verdict) == (2, PathVerdict.ACCEPTED), second
    assert worker._chain.held.commitment.checksum == pilot.commitment.checksum


def comes(worker: PlannerWorker, main: Connection, request: PathRequest) -> None:
    """Let a request wait."""
    main.send(request)
    assert until(lambda: worker._chain.read(0.1, or_request=True) is None and worker._requests.waiting is not None)


def pressed(worker: PlannerWorker, main: Connection, request: PathRequest) -> PathAnswer | None:
    """Return what a worker answers at once to a request, where it takes others to wait."""
    comes(worker, main, request)
    worker._pressed = True
    return worker._answer(*worker._requests.take())


@pytest.fixture
def in_flight(held, limits, monkeypatch):
    """A worker that plans for a flight that has begun, the main process's end of its requests, and the pilot's side."""
    monkeypatch.setattr(PlannerWorker, "_late_by", lambda *_: -1.0)  # however slow this computer is
    (main, requests), (theirs, ours) = multiprocessing.Pipe(), multiprocessing.Pipe()
    worker, pilot = PlannerWorker(held, limits, requests, ours), PilotSide(held.commitment, limits, theirs)
    pilot.begin()
    assert until(lambda: worker._chain.read(0.1) is None and worker._chain.begun > 0.0)
    worker._meanwhile.note(0.05, only=True)  # else all of a plan is committed at once
    return worker, main, pilot, theirs


FIRST, SECOND = PathRequest(1, Wish.REPLACE, FAR), PathRequest(2, Wish.REPLACE, FAR[1:])


def once_failing(monkeypatch) -> None:
    """Let the next simulation of a plan that goes on beside fail."""
    simulate, failed = certified_flight._simulate, []

    def fails_once(*given):
        if not failed:
            failed.append(True)
            raise EndsBadlyError("it ends outside", where="link loss")
        return simulate(*given)

    monkeypatch.setattr(certified_flight, "_simulate", fails_once)


@pytest.mark.parametrize("passes", [True, False])
def test_while_requests_press_one_is_planned_on_what_is_simulated_still(in_flight, monkeypatch, passes):
    """Where that does not pass, it is planned again on what the pilot is bound to."""
    worker, main, pilot, theirs = in_flight
    if not passes:
        once_failing(monkeypatch)
    before = worker._chain.held
    assert pressed(worker, main, FIRST) is None
    assert worker._chain.held is not before
    assert pilot.proposals.newest() is None  # it is held back
    comes(worker, main, SECOND)
    with served(worker, main, theirs):
        first, second = two_answers(main, pilot)
    assert (first.number, first.verdict) == (1, PathVerdict.ACCEPTED if passes else PathVerdict.SUPERSEDED), first
    assert passes or "it ends outside" in first.reason
    assert (second.number, second.verdict) == (2, PathVerdict.ACCEPTED), second
    assert worker._chain.held.commitment.checksum == pilot.commitment.checksum


@contextlib.contextmanager
def looking(pilot: PilotSide) -> Iterator[None]:
    """Let a thread look for the pilot at what is proposed."""
    ended = threading.Event()

    def look() -> None:
        while not ended.wait(0.001):
            pilot.tick()

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_three_on_their_way_are_accepted_in_order(in_flight):
    worker, main, pilot, theirs = in_flight
    third = PathRequest(3, Wish.REPLACE, FAR[2:])
    with looking(pilot):
        assert [pressed(worker, main, each) for each in (FIRST, SECOND, third)] == [None] * 3
        worker._chain.settle()
    told = [main.recv() for _ in range(3)]
    assert [(each.number, each.verdict) for each in told] == [(n, PathVerdict.ACCEPTED) for n in (1, 2, 3)]
    assert [each.splice for each in told] == sorted(each.splice for each in told)
    assert worker._chain.held.commitment.checksum == pilot.commitment.checksum
    theirs.close()


def test_what_was_committed_in_haste_is_committed_to_its_end_once_nobody_presses(in_flight):
    worker, main, pilot, theirs = in_flight
    assert pressed(worker, main, FIRST) is None
    first = worker._chain.held
    with served(worker, main, theirs):

        def to_its_end() -> bool:
            pilot.tick()
            end = decode(pilot.commitment.payloads[-1:]).position[0]
            heard = worker._chain.held.commitment.checksum == pilot.commitment.checksum
            return heard and bool(np.abs(end - FAR[-1]).max() < 2e-3)

        assert until(to_its_end)
    assert first.stops_from - pilot.commitment.splices[0] <= round(FIRST_PART * RATE)


@pytest.mark.parametrize("what", ["plan", "checks"])
def test_who_came_late_plans_as_far_ahead_as_plan_or_checks_took(in_flight, monkeypatch, what):
    """They may take longer than those of most plans, and do so again."""
    worker, _, pilot, theirs = in_flight
    long, begun, firsts, others, planned = 0.2, REAL_CLOCK.now(), [], [], worker._planned
    now = begun
    worker._plans.note(0.05, only=True)

    class Standing:
        def now(self):
            return now

    monkeypatch.setattr(planner_worker, "REAL_CLOCK", Standing())
    monkeypatch.setattr(worker, "_late_by", lambda splice: 1.0 if len(firsts) == 1 and now > begun else -1.0)

    def takes_long(request, first, part, attempt):
        nonlocal now
        firsts.append(first - worker._in_time_for(0.0))
        others.append(attempt.in_time() - worker._in_time_for(0.0))
        made = planned(request, first, part, attempt)
        now += long
        if what == "plan" and len(firsts) == 1:
            raise TooLateError("the plan was not made in time")
        return made

    monkeypatch.setattr(worker, "_planned", takes_long)
    with looking(pilot):
        answer = worker._answer(FIRST, now)
    assert answer.verdict is PathVerdict.ACCEPTED, answer
    assert firsts[0] < firsts[1] == pytest.approx(long * RATE, abs=2)
    assert (others[1] > long * RATE) is (what == "checks")  # other joints must leave time for these too
    theirs.close()


def test_a_plan_along_the_path_left_has_the_time_that_such_plans_leave_the_motion_as_it_is(in_flight, monkeypatch):
    worker, *_ = in_flight
    at_once, along = Ways((0, 1)), Ways((2, 0))
    for ways, equal in ((at_once, 1), (along, 5)):
        for _ in range(20):
            worker._too_late(0.0, ways, 100, equal)
    for late_by in (0.0, 0.04):
        monkeypatch.setattr(worker, "_late_by", lambda splice, late_by=late_by: late_by)
        assert worker._too_late(0.0, at_once, 100, None) is (late_by > 0.01)
        assert not worker._too_late(0.0, along, 100, None)


@pytest.mark.parametrize("falls", ["in its simulation", "as the pilot refuses it"])
def test_the_latest_request_is_planned_again_where_it_was_planned_in_haste(in_flight, monkeypatch, falls):
    worker, main, pilot, theirs = in_flight
    if falls == "in its simulation":
        once_failing(monkeypatch)
    assert pressed(worker, main, FIRST) is None
    if falls == "as the pilot refuses it":
        worker._chain.release()
        assert until(lambda: (proposal := pilot.proposals.newest()) is not None and refused(pilot, proposal))
    with served(worker, main, theirs):
        answers: list[PathAnswer] = []

        def told() -> bool:
            pilot.tick()
            return main.poll()

        assert until(told)
        answers.append(main.recv())
    assert [(each.number, each.verdict) for each in answers] == [(1, PathVerdict.ACCEPTED)]
    assert worker._chain.held.commitment.checksum == pilot.commitment.checksum


def refused(pilot: PilotSide, proposal: Proposal) -> bool:
    pilot.proposals.answer(proposal, Refusal(Fault.MOTION, ""))
    return True


def test_what_ends_badly_far_ahead_is_accepted_and_flown_slower_soon(held, limits, monkeypatch):
    """Link loss is foreseen to end outside where the vehicle is fast 3 s or more behind what is certified."""
    monkeypatch.setattr(PlannerWorker, "_late_by", lambda *_: -1.0)  # however slow this computer is
    (main, requests), (theirs, ours) = multiprocessing.Pipe(), multiprocessing.Pipe()
    worker, pilot = PlannerWorker(held, limits, requests, ours), PilotSide(held.commitment, limits, theirs)
    worker.warm_up()

    def foresee(payloads, limits, starts):
        if np.linalg.norm(decode(payloads).velocity, axis=1)[300:].max(initial=0.0) > 1.3:
            raise EndsBadlyError("it ends outside", where="link loss")

    for module in (certified_flight, replanning):
        monkeypatch.setattr(module, "foresee_link_loss", foresee)

    with served(worker, main, theirs):
        pilot.begin(ago=0.5)  # as soon as it has begun, now and then no way leads on
        assert until(lambda: worker._chain.begun > 0.0)
        main.send(PathRequest(1, Wish.REPLACE, FAR))
        answers = two_answers(main, pilot)
    assert [(each.number, each.verdict) for each in answers] == [(1, PathVerdict.ACCEPTED), (1, PathVerdict.CHANGED)]
    first, slower = (fastest(each.plan.trajectory, 4.0) for each in answers)
    assert slower < 1.3 < first


def fastest(trajectory, begin):
    return np.linalg.norm(trajectory.at(np.arange(begin, trajectory.duration, 0.02)).velocity, axis=1).max()


def test_a_fault_in_planning_is_an_answer_and_what_is_held_stays(held, limits):
    """The process would else be gone for the rest of the flight."""
    (_main, requests), (pilot, proposals) = multiprocessing.Pipe(), multiprocessing.Pipe()
    worker = PlannerWorker(held, limits, requests, proposals)
    pilot.send_bytes(_ANSWER.pack(_BEGUN, 0, 0, REAL_CLOCK.now()))
    worker._chain.read(1.0)
    answer = worker._answer(PathRequest(1, Wish.REPLACE, ("no", "numbers")), REAL_CLOCK.now())
    assert answer.verdict is PathVerdict.REFUSED
    assert "fault in the planner: ValueError" in answer.reason
    assert worker._chain.held is held


def test_what_is_committed_far_ahead_of_the_vehicle_is_replaced_from_near(both):
    """A plan is committed in parts, the last of them long before it is flown; then another one replaces it."""
    planner, pilot = both
    begin(planner, pilot)
    first = answer_to(planner.request(Wish.REPLACE, FAR), planner, pilot)
    assert first.verdict is PathVerdict.ACCEPTED, first

    def all_of_it() -> bool:
        pilot.tick()
        end = decode(pilot.commitment.payloads[-1:]).position[0]
        return bool(np.abs(end - FAR[-1]).max() < 2e-3)

    assert until(all_of_it)
    ends = len(pilot.commitment.payloads) / RATE
    second = answer_to(planner.request(Wish.REPLACE, [(0.0, 0.5, 1.0)]), planner, pilot)
    assert second.verdict is PathVerdict.ACCEPTED, second
    assert second.joint < ends


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_plans_are_checked_all_the_same_where_the_process_beside_the_planner_has_died(both, how):
    planner, pilot = both
    begin(planner, pilot)
    for child in psutil.Process(planner.process_id).children():
        child.send_signal(how)
    for place in ((0.0, 0.5, 1.0), (0.5, -0.5, 1.0)):
        answer = answer_to(planner.request(Wish.REPLACE, [place]), planner, pilot)
        assert answer.verdict is PathVerdict.ACCEPTED, answer


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_nothing_of_a_planner_that_was_killed_goes_on(both, how):
    planner, _ = both
    beside = psutil.Process(planner.process_id).children()
    assert beside
    psutil.Process(planner.process_id).send_signal(how)
    assert not psutil.wait_procs(beside, timeout=10.0)[1]


def test_how_far_ahead_is_planned_follows_how_long_plans_took():
    lead = Lead(1.0)
    for number in range(LEARNED_FROM):
        lead.note(0.020 + 0.001 * number)
    assert lead.ahead() == pytest.approx(0.020 + IN_TIME * 0.014 + SLACK)
    assert lead.ahead() < lead.ahead(1.0) == pytest.approx(0.034 + SLACK)
    lead.note(0.5, 0.45)  # it took long, but began where nothing changed for as long
    assert lead.ahead(1.0) == pytest.approx(0.050 + SLACK)
