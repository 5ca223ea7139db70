"""The planner's process: what it proposes verifies, and whatever happens to it the pilot has what is committed."""

import contextlib
import multiprocessing
import os
import signal
import threading
from dataclasses import replace

import numpy as np
import psutil
import pytest
from waiting import PATIENCE, a_moment, until

from cfplan.errors import InfeasibleError
from cfplan.flight.clock import REAL_CLOCK, Clock, SteppedClock
from cfplan.flight.pilot.proposals import ReceivedProposals
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
from cfplan.planning.continuation import TooLateError
from cfplan.planning.plan import plan
from cfplan.preparation import certified_flight, planner_worker
from cfplan.preparation import replan as replanning
from cfplan.preparation.air_planner import FIRST_PART, SLACK, PathAnswer, PathRequest, PathVerdict, Wish
from cfplan.preparation.certified_flight import STOP, EndsBadlyError
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


class NearlyStill(SteppedClock):
    """A clock that goes on by a µs at each look, so that no plan is late however slow this computer is."""

    def now(self) -> float:
        self.reach(super().now() + 1e-6)
        return super().now()


class Planner:
    """A worker that plans by a clock of the test for a flight that has begun, served by a thread, and its pilot."""

    def __init__(self, held, limits):
        self.clock = NearlyStill()
        (self.main, requests), (self.pilots_end, ours) = multiprocessing.Pipe(), multiprocessing.Pipe()
        self.pilot = PilotSide(held.commitment, limits, self.pilots_end, self.clock)
        self.told: list[PathAnswer] = []
        self.number = 0
        worker = PlannerWorker(held, limits, requests, ours, self.clock)
        worker.warm_up()

        def serve() -> None:
            with contextlib.suppress(EOFError, OSError):
                worker.serve()

        self.thread = threading.Thread(target=serve)
        self.thread.start()

    def begin(self, ago: float = 0.0) -> None:
        """Begin the flight, and wait until the planner knows."""
        self.pilot.begin(ago)
        assert until(lambda: self.ask(Wish.EXTEND).reason != NOT_FLOWN)

    def request(self, wish: Wish, waypoints=()) -> int:
        self.number = number = self.number + 1
        self.main.send(PathRequest(number, wish, tuple(waypoints)))
        return number

    def hear(self) -> list[PathAnswer]:
        """Let the pilot look for a proposal; return all answers so far."""
        self.pilot.tick()
        while self.main.poll():
            self.told.append(self.main.recv())
        return self.told

    def answers(self, count: int) -> list[PathAnswer]:
        """Wait for a number of answers; return and remove them."""
        assert until(lambda: len(self.hear()) >= count)
        found, self.told = self.told, []
        return found

    def ask(self, wish: Wish, waypoints=()) -> PathAnswer:
        number = self.request(wish, waypoints)
        (answer,) = self.answers(1)
        assert answer.number == number
        return answer

    def agrees(self) -> bool:
        """Return whether the planner holds what the pilot is committed to: else the pilot refuses what follows."""
        return self.ask(Wish.REPLACE, [(0.0, 0.5, 1.0)]).verdict is PathVerdict.ACCEPTED

    def end(self) -> None:
        self.main.close()
        self.pilots_end.close()
        self.thread.join()


@pytest.fixture
def idle(held, limits):
    planner = Planner(held, limits)
    yield planner
    planner.end()


@pytest.fixture
def in_flight(idle):
    idle.begin()
    return idle


@pytest.fixture
def while_planning(monkeypatch):
    """Call it with acts: one is done each time that a request begins to be planned; return the list of those left."""
    plan_request, acts = planner_worker.plan_request, []

    def plan_after_act(*given):
        if acts:
            acts.pop(0)()
        return plan_request(*given)

    monkeypatch.setattr(planner_worker, "plan_request", plan_after_act)

    def set_acts(*given):
        acts.extend(given)
        return acts

    return set_acts


@pytest.fixture
def simulation(monkeypatch):
    """Acts that are done before the next simulations of link loss; they may fail."""
    link_loss, acts = certified_flight.link_loss_at_walls, []

    def simulate_after_act(*given, **named):
        if acts:
            acts.pop(0)()
        return link_loss(*given, **named)

    monkeypatch.setattr(certified_flight, "link_loss_at_walls", simulate_after_act)
    return acts


def ends_badly() -> None:
    raise EndsBadlyError("it ends outside", where="link loss")


PLACES = [(0.5, 0.9, 1.0)]
WAITS = [(0.0, 0.5, 1.0)]


@pytest.mark.parametrize("accepted", [True, False])
def test_another_request_is_planned_while_the_pilot_looks_at_the_last_proposal(in_flight, while_planning, accepted):
    planner = in_flight
    left = while_planning(lambda: planner.request(Wish.REPLACE, WAITS), lambda: None)
    if not accepted:
        planner.pilot.refuses = 0
    number = planner.request(Wish.REPLACE, PLACES)
    assert until(lambda: not left)  # the second is planned, though the pilot has not looked
    assert not planner.pilot.given
    first, second = planner.answers(2)
    assert (first.number, first.verdict) == (number, PathVerdict.ACCEPTED if accepted else PathVerdict.REFUSED), first
    assert (second.number, second.verdict) == (number + 1, PathVerdict.ACCEPTED), second
    assert planner.agrees()


@pytest.mark.parametrize("passes", [True, False])
def test_while_requests_press_one_is_planned_on_what_is_simulated_still(in_flight, while_planning, simulation, passes):
    """Where that does not pass, it is planned again on what the pilot is bound to."""
    planner, planned = in_flight, threading.Event()

    def simulate_long():
        assert planned.wait(PATIENCE)  # before that the next request begins to be planned
        if not passes:
            ends_badly()

    def press():
        simulation.append(simulate_long)
        planner.request(Wish.REPLACE, FAR[1:])

    while_planning(lambda: planner.request(Wish.REPLACE, FAR), press, planned.set)
    number = planner.request(Wish.REPLACE, PLACES)
    zeroth, first, second = planner.answers(3)
    assert (zeroth.number, zeroth.verdict) == (number, PathVerdict.ACCEPTED), zeroth
    verdict = PathVerdict.ACCEPTED if passes else PathVerdict.SUPERSEDED
    assert (first.number, first.verdict) == (number + 1, verdict), first
    assert passes or "it ends outside" in first.reason
    assert (second.number, second.verdict) == (number + 2, PathVerdict.ACCEPTED), second
    assert planner.agrees()


def test_several_on_their_way_are_accepted_in_order(in_flight, while_planning):
    planner = in_flight
    while_planning(*(lambda far=far: planner.request(Wish.REPLACE, far) for far in (FAR, FAR[1:], FAR[2:])))
    number = planner.request(Wish.REPLACE, PLACES)
    told = planner.answers(4)
    assert [(each.number, each.verdict) for each in told] == [(number + n, PathVerdict.ACCEPTED) for n in range(4)]
    assert [each.splice for each in told] == [commitment.splices[-1] for commitment in planner.pilot.given]
    assert planner.agrees()


def test_what_was_committed_in_haste_is_committed_to_its_end_once_nobody_presses(in_flight, while_planning):
    planner, commitment = in_flight, lambda: in_flight.pilot.commitment
    while_planning(lambda: planner.request(Wish.REPLACE, FAR))
    planner.request(Wish.REPLACE, PLACES)
    _, pressed = planner.answers(2)
    assert commitment().motion_ends - pressed.joint * RATE <= FIRST_PART * RATE + STOP

    def to_its_end() -> bool:
        planner.clock.sleep(0.01)
        planner.hear()
        return bool(np.abs(decode(commitment().payloads[-1:]).position[0] - FAR[-1]).max() < 2e-3)

    assert until(to_its_end)


LONG = 0.2  # s


@pytest.mark.parametrize("what", ["plan", "checks"])
def test_who_came_late_plans_as_far_ahead_as_plan_or_checks_took(in_flight, monkeypatch, what):
    """They may take longer than those of most plans, and do so again."""
    planner, plan_request, ahead, others, needed = in_flight, planner_worker.plan_request, [], [], []

    def takes_long_once(held, request, first, limits, part, attempt):
        due = (planner.clock.now() - planner.pilot.begun) * RATE
        ahead.append(first - due)
        others.append(attempt.in_time() - due)
        made = plan_request(held, request, first, limits, part, attempt)
        if len(ahead) == 1:
            planner.clock.sleep(LONG)
            # By this computer's clock planning takes time too; once a way is known nobody searches for it again.
            searched = attempt.ways.searched if what == "plan" else 0.0
            needed.extend((LONG - searched, LONG + made.plan.seconds))
            if what == "plan":
                raise TooLateError("the plan was not made in time")
        return made

    monkeypatch.setattr(planner_worker, "plan_request", takes_long_once)
    answer = planner.ask(Wish.REPLACE, FAR)
    assert answer.verdict is PathVerdict.ACCEPTED, answer
    least, most = needed
    assert least * RATE - 2 <= ahead[1] - ahead[0] <= most * RATE + 2
    assert (others[1] - others[0] > LONG * RATE) is (what == "checks")  # other joints must leave time for these too


def test_a_plan_along_the_path_left_has_the_time_that_such_plans_leave_the_motion_as_it_is(in_flight, monkeypatch):
    planner, soonest = in_flight, {}

    def learn(held, request, first, limits, part, attempt):
        for found, equal in (((0, 1), 1), ((2, 0), 5)):
            attempt.ways.found = found
            for _ in range(20):
                attempt.too_late(first, equal)
        for found in ((0, 1), (2, 0)):
            attempt.ways.found = found
            around = range(first - 20, first + 20)
            soonest[found] = next(splice for splice in around if not attempt.too_late(splice, None))
        raise InfeasibleError("it is enough")

    monkeypatch.setattr(planner_worker, "plan_request", learn)
    planner.ask(Wish.STOP)
    assert soonest[0, 1] - soonest[2, 0] == 5 - 1


@pytest.mark.parametrize("falls", ["in its simulation", "as the pilot refuses it"])
def test_the_latest_request_is_planned_again_if_it_was_in_haste(in_flight, while_planning, simulation, falls):
    planner = in_flight
    if falls == "as the pilot refuses it":
        planner.pilot.refuses = 1

    def press():
        if falls == "in its simulation":
            simulation.append(ends_badly)

    left = while_planning(lambda: planner.request(Wish.REPLACE, FAR), press, lambda: None)  # and once more
    number = planner.request(Wish.REPLACE, PLACES)
    told = planner.answers(2)
    assert [(each.number, each.verdict) for each in told] == [(number + n, PathVerdict.ACCEPTED) for n in range(2)]
    assert not left
    assert planner.agrees()


def test_what_ends_badly_far_ahead_is_accepted_and_flown_slower_soon(idle, monkeypatch):
    """Link loss is foreseen to end outside where the vehicle is fast 3 s or more behind what is certified."""

    def foresee(payloads, limits, starts):
        if np.linalg.norm(decode(payloads).velocity, axis=1)[300:].max(initial=0.0) > 1.3:
            ends_badly()

    for module in (certified_flight, replanning):
        monkeypatch.setattr(module, "foresee_link_loss", foresee)

    idle.begin(ago=0.5)  # as soon as it has begun, now and then no way leads on
    number = idle.request(Wish.REPLACE, FAR)
    answers = idle.answers(2)
    told = [(each.number, each.verdict) for each in answers]
    assert told == [(number, PathVerdict.ACCEPTED), (number, PathVerdict.CHANGED)]
    first, slower = (fastest(each.plan.trajectory, 4.0) for each in answers)
    assert slower < 1.3 < first


def fastest(trajectory, begin):
    return np.linalg.norm(trajectory.at(np.arange(begin, trajectory.duration, 0.02)).velocity, axis=1).max()


def test_a_fault_in_planning_is_an_answer_and_what_is_held_stays(in_flight):
    """The process would else be gone for the rest of the flight."""
    answer = in_flight.ask(Wish.REPLACE, ("no", "numbers"))
    assert answer.verdict is PathVerdict.REFUSED
    assert "fault in the planner: ValueError" in answer.reason
    assert in_flight.agrees()


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
