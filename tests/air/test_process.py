"""The planner's process: what it proposes verifies, and whatever happens to it the pilot has what is committed."""

import multiprocessing
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import psutil
import pytest
from slow_cases import slow_unless
from waiting import PATIENCE, a_moment, until

from cfplan.air.core import NO_ANSWER, NOT_FLOWN, ON_ITS_WAY
from cfplan.air.process import PLANNER_GONE, AirPlanner
from cfplan.air.replanning import replan
from cfplan.air.requests import PathAnswer, PathVerdict, Wish
from cfplan.air.timeline import hold
from cfplan.errors import RequestRefusedError
from cfplan.flight.clock import REAL_CLOCK
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
        self.silent = False  # answers are kept back until it speaks
        self.kept: list[tuple[Proposal, Commitment | Refusal]] = []
        self.told: list[PathAnswer] = []  # by the planner, and not looked at yet

    def begin(self) -> None:
        self.begun = REAL_CLOCK.now()
        self.proposals.begin(self.begun)

    def tick(self) -> None:
        proposal = self.proposals.newest()
        if proposal is not None:
            now = min(round((REAL_CLOCK.now() - self.begun) * RATE), proposal.splice - LEAST_AHEAD)
            answer = splice(self.commitment, proposal, now, self.limits)
            if isinstance(answer, Commitment):
                self.commitment = answer
            self.given.append(answer)
            self.kept.append((proposal, answer))
        if not self.silent:
            while self.kept:
                self.proposals.answer(*self.kept.pop(0))


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
    """Ask until the answer is not that the plan or the pilot's answer came too late, as on a busy computer.

    A pilot that answered too late has accepted all the same; then that answer is returned.
    """
    answer = PathAnswer(0, PathVerdict.LATE)

    def settled() -> bool:
        nonlocal answer
        answer = answer_to(planner.request(wish, waypoints), planner, pilot)
        return answer.verdict is not PathVerdict.LATE and answer.reason != NO_ANSWER

    assert until(settled), answer
    if answer.reason == ON_ITS_WAY:
        answer = [each for each in pilot.told if each.verdict is PathVerdict.ACCEPTED][-1]
    return answer


def stopped(planner: AirPlanner) -> psutil.Process:
    """Stop the planner's process, and return it once it stands still."""
    process = psutil.Process(planner.process_id)
    process.suspend()
    assert until(lambda: process.status() == psutil.STATUS_STOPPED)
    return process


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
    committed = [each for each in pilot.given if isinstance(each, Commitment)]
    (flown,) = (each for each in committed if each.splices[-1] == answer.splice)
    assert answer.joint == pytest.approx(answer.splice / RATE + LEAD)
    numbers = np.arange(answer.splice, answer.splice + 20)
    setpoints = decode(flown.payloads[numbers - flown.first])
    planned = answer.plan.trajectory.at(numbers / RATE + LEAD - answer.joint)
    np.testing.assert_allclose(setpoints.position, planned.position, atol=QUANTUM)
    np.testing.assert_allclose(setpoints.velocity, planned.velocity, atol=QUANTUM)

    def goes_on() -> bool:
        pilot.tick()
        end = decode(pilot.commitment.payloads[-1:]).position[0]
        return pilot.commitment.splices[-1] > answer.splice or bool(np.abs(end - (0.0, 0.5, 1.0)).max() < 2e-3)

    assert until(goes_on)  # behind its first part
    again = in_time(Wish.EXTEND, [(0.5, -0.5, 1.0)], planner, pilot)
    assert again.verdict is PathVerdict.ACCEPTED, again


def proposed(planner: AirPlanner, pilot: PilotSide) -> Proposal:
    """Ask until there is a proposal, which the pilot has not answered."""
    asked, found = None, None

    def there_is_one() -> bool:
        nonlocal asked, found
        pilot.told.extend(planner.answers())
        if asked is None or any(each.number == asked for each in pilot.told):  # it came too late
            asked = planner.request(Wish.REPLACE, [(0.0, 0.5, 1.0)])
        found = pilot.proposals.newest()
        return found is not None

    assert until(there_is_one)
    assert found is not None
    return found


def test_a_request_that_comes_while_a_proposal_is_with_the_pilot_is_answered(both):
    planner, pilot = both
    begin(planner, pilot)
    reason = NO_ANSWER
    while reason == NO_ANSWER:  # where this computer is so busy that the planner gives up meanwhile
        proposal = proposed(planner, pilot)
        read, another = (planner.request(Wish.REPLACE, [(0.0, 7.0, 1.0)]) for _ in range(2))
        answer_to(read, planner, pilot)  # it is superseded: the planner has read both, and waits for the pilot
        pilot.proposals.answer(proposal, Refusal(Fault.MOTION, ""))
        reason = answer_to(another, planner, pilot).reason
    assert "waypoint 1" in reason


def test_the_latest_request_wins(both):
    planner, pilot = both
    begin(planner, pilot)
    process = stopped(planner)  # so that it finds all of them, however slowly they are asked for
    numbers = [planner.request(Wish.REPLACE, [(0.0, 0.1 * k, 1.0)]) for k in range(6)]
    process.resume()
    answers: list[PathAnswer] = []

    def all_answered() -> bool:
        pilot.tick()
        answers.extend(planner.answers())
        return {answer.number for answer in answers} >= set(numbers)

    assert until(all_answered)
    verdicts = {answer.number: answer.verdict for answer in answers}
    last = next(answer for answer in answers if answer.number == numbers[-1])
    assert [verdicts[number] for number in numbers[:-1]] == [PathVerdict.SUPERSEDED] * 5
    assert last.verdict is not PathVerdict.SUPERSEDED, last


def test_an_answer_that_comes_late_leaves_both_sides_with_the_same_commitment(both):
    """Longer than the planner waits for it: it must not plan on from what the pilot has left meanwhile."""
    planner, pilot = both
    begin(planner, pilot)
    pilot.silent = True
    while not pilot.kept:
        number = planner.request(Wish.REPLACE, FAR[:4])
        told = answer_to(number, planner, pilot)
    assert (told.number, told.verdict) == (number, PathVerdict.REFUSED)
    assert "the pilot does not answer" in told.reason
    pilot.silent = False
    while told.verdict is not PathVerdict.ACCEPTED:  # it is flown after all
        told = answer_to(number, planner, pilot)
    later = [in_time(Wish.REPLACE, [(0.0, y, 1.0)], planner, pilot) for y in (0.5, -0.5)]
    assert [answer.verdict for answer in later] == [PathVerdict.ACCEPTED] * 2, later
    assert all(isinstance(answer, Commitment) for answer in pilot.given)


@pytest.mark.parametrize("how", slow_unless([signal.SIGSTOP], [signal.SIGKILL, signal.SIGSTOP]))
def test_a_planner_that_is_killed_or_stopped_leaves_the_pilot_its_commitment(both, held, how):
    planner, pilot = both
    begin(planner, pilot)
    process = stopped(planner)
    process.send_signal(how)
    killed = how is signal.SIGKILL
    assert until(lambda: planner.alive is not killed)
    for wish, waypoints in ((Wish.REPLACE, [(0.0, 0.5, 1.0)]), (Wish.STOP, ())):
        number = planner.request(wish, waypoints)
        a_moment()
        pilot.tick()
        assert planner.answers() == ([PathAnswer(number, PathVerdict.REFUSED, PLANNER_GONE)] if killed else [])
    assert pilot.commitment is held.commitment


def test_a_hung_planner_refuses_a_request_and_its_death_refuses_those_it_has_not_read(both):
    planner, _ = both
    process = stopped(planner)
    numbers: list[int] = []

    def fill() -> None:
        while len(numbers) < 1000:  # far more than the pipe holds
            numbers.append(planner.request(Wish.REPLACE, 100 * FAR))

    with pytest.raises(RequestRefusedError, match="has read no request for"):
        fill()
    assert numbers
    assert planner.answers() == []
    process.kill()
    assert until(lambda: not planner.alive)
    assert planner.answers() == [PathAnswer(number, PathVerdict.REFUSED, PLANNER_GONE) for number in numbers]


def test_requests_wait_for_a_busy_planner_while_its_answers_are_read(both):
    planner, _ = both
    process = stopped(planner)
    resume = threading.Timer(0.5, process.resume)
    resume.start()
    with ThreadPoolExecutor(2) as threads:
        asked = [threads.submit(planner.request, Wish.REPLACE, 100 * FAR) for _ in range(400)]  # the pipe holds fewer
        answered: set[int] = set()

        def all_answered() -> bool:
            answered.update(answer.number for answer in planner.answers())
            return len(answered) == len(asked)

        assert until(all_answered)
    resume.join()
    assert answered == {each.result() for each in asked}


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
    stops = np.broadcast_to(good.payloads[0], (900, 10_000, *good.payloads.shape[1:]))
    long = replace(good, payloads=payloads[:900], stops=stops, ending=899).to_bytes()
    assert len(long) < 1e6
    assert Proposal.of_bytes(long) is None


def test_what_is_committed_far_ahead_of_the_vehicle_is_replaced_from_near(both):
    """A plan is committed in parts, the last of them long before it is flown; then another one replaces it."""
    planner, pilot = both
    begin(planner, pilot)

    def all_of_it() -> bool:
        pilot.tick()
        end = decode(pilot.commitment.payloads[-1:]).position[0]
        return bool(np.abs(end - FAR[-1]).max() < 2e-3)

    def replaced_from_near() -> bool:
        first = in_time(Wish.REPLACE, FAR, planner, pilot)
        assert first.verdict is PathVerdict.ACCEPTED, first
        assert until(all_of_it)
        ends = pilot.commitment.motion_ends / RATE
        second = in_time(Wish.REPLACE, [(0.0, 0.5, 1.0)], planner, pilot)
        assert second.verdict is PathVerdict.ACCEPTED, second
        return second.joint < ends

    assert until(replaced_from_near)  # on a busy computer the vehicle may have arrived meanwhile


@pytest.mark.parametrize("how", slow_unless([signal.SIGKILL], [signal.SIGKILL, signal.SIGTERM]))
def test_plans_are_checked_all_the_same_where_the_process_beside_the_planner_has_died(both, how):
    planner, pilot = both
    begin(planner, pilot)
    for child in psutil.Process(planner.process_id).children():
        child.send_signal(how)
    for place in ((0.0, 0.5, 1.0), (0.5, -0.5, 1.0)):
        answer = in_time(Wish.REPLACE, [place], planner, pilot)
        assert answer.verdict is PathVerdict.ACCEPTED, answer


@pytest.mark.parametrize("how", slow_unless([signal.SIGTERM], [signal.SIGKILL, signal.SIGTERM]))
def test_nothing_of_a_planner_that_was_killed_goes_on(both, how):
    planner, _ = both
    beside = psutil.Process(planner.process_id).children()
    assert beside
    psutil.Process(planner.process_id).send_signal(how)
    assert not psutil.wait_procs(beside, timeout=PATIENCE)[1]
