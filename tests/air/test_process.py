"""The planner's process: what it proposes verifies, and whatever happens to it the pilot has what is committed."""

import multiprocessing
import os
import signal
from dataclasses import replace

import numpy as np
import psutil
import pytest
from waiting import a_moment, until

from cfplan.air.core import NOT_FLOWN
from cfplan.air.process import AirPlanner
from cfplan.air.replanning import replan
from cfplan.air.requests import PathAnswer, PathVerdict, Wish
from cfplan.air.timeline import hold
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.pilot.proposals import ReceivedProposals
from cfplan.flight.setpoints.commitment import (
    LEAST_AHEAD,
    QUANTUM,
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
from cfplan.planning.plan import plan

LATE = 1.5  # s, longer than a planner waits for an answer
FAR = ((-0.5, 0.8, 1.0), (0.5, 2.0, 1.0), (-0.8, 0.4, 1.2), (0.8, -1.5, 0.9), (-0.8, 1.5, 1.0), (0.0, -2.0, 1.0))
WAYPOINTS = np.array([[-1.0, -2.0, 0.8], [0.8, -1.0, 1.1], [-0.6, 0.6, 0.9], [0.7, 1.8, 1.1]])


class PilotSide:
    """The pilot as the planner sees it: what it is committed to, at which moment.

    Where this computer is slow its time stands still until a proposal is there, so that none is late.
    """

    def __init__(self, commitment, limits, connection, clock: Clock = REAL_CLOCK):
        self.commitment, self.limits, self.clock = commitment, limits, clock
        self.proposals = ReceivedProposals(connection, clock)
        self.begun = 0.0
        self.given: list[Commitment | Refusal] = []
        self.refuses: int | None = None  # number of the proposal that is refused, whatever it is
        self.silent_for: float | None = None  # s, for which the next answer is kept back
        self.told: list[PathAnswer] = []  # by the planner, and not looked at yet

    def begin(self, ago: float = 0.0) -> None:
        self.begun = self.clock.now() - ago
        self.proposals.begin(self.begun)

    def tick(self) -> None:
        proposal = self.proposals.newest()
        if proposal is not None:
            now = min(round((self.clock.now() - self.begun) * RATE), proposal.splice - LEAST_AHEAD)
            answer = splice(self.commitment, proposal, now, self.limits)
            if len(self.given) == self.refuses:
                answer = Refusal(Fault.MOTION, "")
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


def in_time(wish: Wish, waypoints, planner: AirPlanner, pilot: PilotSide) -> PathAnswer:
    """Ask until the answer is not that it came too late, as on a busy computer."""
    for _ in range(5):
        answer = answer_to(planner.request(wish, waypoints), planner, pilot)
        if answer.verdict is not PathVerdict.LATE:
            break
    return answer


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
    answer = in_time(Wish.REPLACE, [(0.0, 0.5, 1.0)], planner, pilot)
    assert answer.verdict is PathVerdict.ACCEPTED, answer
    assert isinstance(pilot.given[-1], Commitment)
    assert answer.splice in pilot.commitment.splices
    assert answer.joint == pytest.approx(answer.splice / RATE + LEAD)

    def goes_on() -> bool:
        pilot.tick()
        end = decode(pilot.commitment.payloads[-1:]).position[0]
        return pilot.commitment.splices[-1] > answer.splice or bool(np.abs(end - (0.0, 0.5, 1.0)).max() < 2e-3)

    assert until(goes_on)  # behind its first part
    numbers = np.arange(answer.splice, answer.splice + 20)
    committed = decode(pilot.commitment.payloads[numbers - pilot.commitment.first])
    planned = answer.plan.trajectory.at(numbers / RATE + LEAD - answer.joint)
    np.testing.assert_allclose(committed.position, planned.position, atol=QUANTUM)
    np.testing.assert_allclose(committed.velocity, planned.velocity, atol=QUANTUM)
    again = in_time(Wish.EXTEND, [(0.5, -0.5, 1.0)], planner, pilot)
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
    assert last.verdict is not PathVerdict.SUPERSEDED, last


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


def test_what_is_committed_far_ahead_of_the_vehicle_is_replaced_from_near(both):
    """A plan is committed in parts, the last of them long before it is flown; then another one replaces it."""
    planner, pilot = both
    begin(planner, pilot)
    first = in_time(Wish.REPLACE, FAR, planner, pilot)
    assert first.verdict is PathVerdict.ACCEPTED, first

    def all_of_it() -> bool:
        pilot.tick()
        end = decode(pilot.commitment.payloads[-1:]).position[0]
        return bool(np.abs(end - FAR[-1]).max() < 2e-3)

    assert until(all_of_it)
    ends = len(pilot.commitment.payloads) / RATE
    second = in_time(Wish.REPLACE, [(0.0, 0.5, 1.0)], planner, pilot)
    assert second.verdict is PathVerdict.ACCEPTED, second
    assert second.joint < ends


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_plans_are_checked_all_the_same_where_the_process_beside_the_planner_has_died(both, how):
    planner, pilot = both
    begin(planner, pilot)
    for child in psutil.Process(planner.process_id).children():
        child.send_signal(how)
    for place in ((0.0, 0.5, 1.0), (0.5, -0.5, 1.0)):
        answer = in_time(Wish.REPLACE, [place], planner, pilot)
        assert answer.verdict is PathVerdict.ACCEPTED, answer


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_nothing_of_a_planner_that_was_killed_goes_on(both, how):
    planner, _ = both
    beside = psutil.Process(planner.process_id).children()
    assert beside
    psutil.Process(planner.process_id).send_signal(how)
    assert not psutil.wait_procs(beside, timeout=10.0)[1]
