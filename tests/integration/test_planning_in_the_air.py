"""The path changes while it is flown: requests of all kinds, at any moment, on the stepped clock."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from stepped_flight import Flight, fly_stepped

from cfplan.air.replanning import replan
from cfplan.air.stopping import halt
from cfplan.air.timeline import Replanned, Timeline, hold, joint_of
from cfplan.errors import CfplanError, ExitCode
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.proposals import HeldProposals
from cfplan.flight.setpoints.byte_check import check_bytes
from cfplan.flight.setpoints.commitment import Commitment, Proposal, Refusal, checksum_of
from cfplan.flight.setpoints.encoding import RATE, encode_trajectory
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.setpoints.stops import DURATION
from cfplan.flight.telemetry import Phase, PhaseEntered, SetpointSent, Telemetry
from cfplan.geometry.min_snap import centripetal_times, min_snap
from cfplan.planning.continuation import with_room
from cfplan.planning.plan import plan
from cfplan.safety.certificate import certify
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.vehicle.joint import JoinedTrajectory

pytestmark = pytest.mark.integration

WAYPOINTS = np.array([[-1.0, -2.0, 0.8], [0.8, -1.0, 1.1], [-0.6, 0.6, 0.9], [0.7, 1.8, 1.1]])
LOW, HIGH = np.array([-1.0, -2.4, 0.8]), np.array([1.0, 2.4, 1.2])
TAKES = 12  # setpoints from a request to the splice of its plan
TRAVELS = 8  # setpoints from a request to the arrival of the proposal


@dataclass
class Planner:
    """A planner in the pilot's thread: it plans at once, and its proposal arrives some setpoints later."""

    timeline: Timeline
    request: Callable[["Planner", int], Replanned | Proposal | None]  # what to propose, with this setpoint sent
    travels: int = TRAVELS
    answers: list[Commitment | Refusal] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)  # by the planner itself
    plans: list[Replanned] = field(default_factory=list)  # accepted
    _waiting: tuple[int, Replanned | Proposal] | None = None
    _given: Replanned | None = None
    _streams: bool = False
    _begun: float = math.nan  # s, when setpoint 0 was due

    def __post_init__(self) -> None:
        self.proposals = HeldProposals(self._hear)

    def _hear(self, _: Proposal, answer: Commitment | Refusal) -> None:
        self.answers.append(answer)
        if isinstance(answer, Commitment) and self._given is not None:
            self.timeline = self._given.accepted(answer)
            self.plans.append(self._given)

    def react(self, message: Telemetry) -> None:
        if isinstance(message, PhaseEntered):
            self._streams = message.phase in (Phase.STREAM, Phase.HOLD)
        if not self._streams or not isinstance(message, SetpointSent):
            return
        if math.isnan(self._begun):
            self._begun = message.due
        now = round((message.due - self._begun) * RATE)
        if self._waiting is not None and now >= self._waiting[0]:
            what, self._waiting = self._waiting[1], None
            self._given = what if isinstance(what, Replanned) else None
            self.proposals.give(what.proposal if isinstance(what, Replanned) else what)
        elif self._waiting is None:
            try:
                what = self.request(self, now)
            except CfplanError as error:
                self.refused.append(str(error))
                return
            if what is not None:
                self._waiting = now + self.travels, what


@pytest.fixture(scope="module")
def held(limits):
    """A plan with as much room to its limits as plans in the air have."""
    path = min_snap(WAYPOINTS, times=centripetal_times(WAYPOINTS))
    roomy = replace(limits, plan=with_room(limits.plan, limits.airframe))
    return hold(plan(path, limits.airframe, roomy, planner="expert"), WAYPOINTS)


@pytest.fixture(scope="module")
def mission(held, limits):
    return Mission(held.commitment.payloads, held.commitment.stops, limits, hold_time=1.0)


def once_at(number: int, make: Callable[[Planner, int], Replanned | Proposal]):
    """A request that is made once, when that setpoint of the plan has been sent."""
    done = False

    def request(planner: Planner, index: int) -> Replanned | Proposal | None:
        nonlocal done
        if done or index < number:
            return None
        done = True
        return make(planner, index)

    return request


def sent_of(flight: Flight) -> dict[int, SetpointSent]:
    """The setpoints of the plan by their numbers, as they were sent."""
    begun = flight.outcome.first_setpoint
    sent: dict[int, SetpointSent] = {}
    for one in flight.of(SetpointSent):
        if one.time >= begun - 1e-6:
            sent.setdefault(one.index, one)  # a stop or a landing counts anew
    return sent


def assert_is_one_motion(flight: Flight, flown: JoinedTrajectory, limits, until: int) -> None:
    """What was sent up to a number is the encoding of one motion, which keeps every limit all along."""
    for trajectory in flown.trajectories:
        assert certify(trajectory, limits.plan, limits.space).passed
    whole = encode_trajectory(flown, gains=gains_under(limits), space=limits.space)
    check_bytes(whole, flown, limits.plan)
    sent, planned = sent_of(flight), decode(whole.payloads)
    numbers = [number for number in sent if number < min(until, len(whole.payloads))]
    assert len(numbers) > 0.99 * min(until, len(whole.payloads))
    for name in ("position", "velocity", "acceleration", "body_rate"):
        got = np.array([getattr(sent[number], name) for number in numbers])
        assert np.abs(got - getattr(planned, name)[numbers]).max() <= 1.001e-3, name


def assert_was_committed(flight: Flight, held: Timeline, plans: list[Replanned], limits) -> None:
    """What was sent is, number by number, what was committed; each plan keeps every limit from its splice on.

    The setpoint at a splice is still that of the motion before.
    """
    sequence = held.commitment.payloads
    for made in plans:
        splice = made.proposal.splice
        hovering = np.repeat(sequence[-1:], max(splice + 1 - len(sequence), 0), axis=0)
        sequence = np.concatenate([sequence, hovering])[: splice + 1]
        np.testing.assert_array_equal(made.proposal.payloads[0], sequence[splice])
        sequence = np.concatenate([sequence, made.proposal.payloads[1:]])
        if made.plan is None:
            continue  # a stop, which is certified as all stops are
        assert certify(made.plan.trajectory, limits.plan, limits.space).passed
        later = made.timeline.motion.since(splice / RATE)
        encoded = encode_trajectory(later, gains=gains_under(limits), space=limits.space)
        check_bytes(encoded, later, limits.plan)
        np.testing.assert_array_equal(encoded.payloads[1:], made.proposal.payloads[1:])
    planned = decode(sequence)
    sent = {number: one for number, one in sent_of(flight).items() if number < len(sequence)}
    assert len(sent) > 0.98 * len(sequence)
    for name in ("position", "velocity", "acceleration", "body_rate"):
        got = [getattr(one, name) for one in sent.values()]
        np.testing.assert_array_equal(got, getattr(planned, name)[list(sent)])


def test_new_waypoints_are_flown_from_the_splice_on_and_the_vehicle_lands_at_their_end(held, mission, limits):
    planner = Planner(
        held, once_at(150, lambda p, now: replan(p.timeline, now + TAKES, [[-0.5, 0.9, 1.0], [0.4, 2.0, 1.0]], limits))
    )
    flight = fly_stepped(mission, planner.react, proposals=planner.proposals)
    assert flight.outcome.exit_code is ExitCode.OK
    assert [type(answer) for answer in planner.answers] == [Commitment]
    np.testing.assert_allclose(flight.truth.position[-1, :2], [0.4, 2.0], atol=0.1)
    assert flight.outcome.deviation.max < 0.1
    assert flight.truth.off_in_air[-1] == 0
    assert_was_committed(flight, held, planner.plans, limits)


def test_in_the_hover_at_its_end_a_flight_goes_on(held, mission, limits):
    planner = Planner(
        held,
        once_at(held.commitment.last + 20, lambda p, now: replan(p.timeline, now + TAKES, [[0.0, 0.5, 1.0]], limits)),
    )
    flight = fly_stepped(replace(mission, hold_time=2.0), planner.react, proposals=planner.proposals)
    assert flight.outcome.exit_code is ExitCode.OK
    assert len(planner.plans) == 1
    np.testing.assert_allclose(flight.truth.position[-1, :2], [0.0, 0.5], atol=0.1)


class BetweenTicks(HeldProposals):
    """A proposal that comes at a time, s, on the clock, between two setpoints."""

    def __init__(self, clock):
        super().__init__()
        self._clock, self._comes, self._coming = clock, math.inf, None

    def send(self, proposal: Proposal, comes: float) -> None:
        self._comes, self._coming = comes, proposal

    def wait(self, patience: float) -> bool:
        self._clock.sleep(max(min(self._comes - self._clock.now(), patience), 0.0))
        return self._clock.now() >= self._comes

    def newest(self) -> Proposal | None:
        if self._clock.now() < self._comes:
            return None
        self._comes = math.inf
        return self._coming


@pytest.mark.parametrize(("before", "in_time"), [(0.006, True), (0.002, False)])
def test_a_proposal_that_comes_well_before_the_next_setpoint_may_begin_with_the_one_just_sent(
    held, mission, limits, before, in_time
):
    """`before` is in s. Later, the pilot looks at it once that setpoint is sent: then it comes too late."""
    lab, answers = SteppedLab(limits.airframe), []
    proposals, streams = BetweenTicks(lab.clock), False
    proposals.on_answer = lambda _, answer: answers.append(answer)
    made = replan(held, 150, [[-0.5, 0.9, 1.0], [0.4, 2.0, 1.0]], limits)
    splice = made.proposal.splice

    def react(message: Telemetry) -> None:
        nonlocal streams
        streams = streams or (isinstance(message, PhaseEntered) and message.phase is Phase.STREAM)
        if streams and not answers and isinstance(message, SetpointSent) and message.index == splice:
            proposals.send(made.proposal, message.due + 1.0 / RATE - before)

    flight = fly_stepped(mission, react, lab=lab, proposals=proposals)
    assert flight.outcome.exit_code is ExitCode.OK
    assert [type(answer) for answer in answers] == [Commitment if in_time else Refusal]
    assert flight.outcome.lateness.max < 1e-6
    assert_was_committed(flight, held, [made] if in_time else [], limits)


def late(planner, now, limits):
    return replan(planner.timeline, now + 2, [[-0.5, 0.9, 1.0]], limits)


def garbage(planner, now, limits):
    good = replan(planner.timeline, now + TAKES, [[-0.5, 0.9, 1.0], [0.4, 2.0, 1.0]], limits).proposal
    return replace(good, payloads=np.roll(good.payloads, 7))


def another_joint(planner, now, limits):
    good = replan(planner.timeline, now + TAKES, [[-0.5, 0.9, 1.0], [0.4, 2.0, 1.0]], limits).proposal
    moved = good.splice + 3
    return replace(good, splice=moved, checksum=checksum_of(moved, good.payloads, good.stops))


def nonsense(planner, now, limits):
    return "not a proposal"


@pytest.mark.parametrize("wrong", [late, garbage, another_joint, nonsense])
def test_a_planner_that_is_late_or_wrong_changes_nothing(held, mission, limits, wrong):
    """The flight is, setpoint by setpoint, the one that was committed before."""
    planner = Planner(held, once_at(150, lambda p, now: wrong(p, now, limits)))
    flight = fly_stepped(mission, planner.react, proposals=planner.proposals)
    assert flight.outcome.exit_code is ExitCode.OK
    assert [type(answer) for answer in planner.answers] == [Refusal]
    assert any("a new plan is refused" in text for text in flight.said)
    assert_is_one_motion(flight, held.motion, limits, held.commitment.last)


def test_an_order_to_land_counts_for_what_is_committed_then(held, mission, limits):
    """Once the new plan is flown, a stop goes along that plan."""
    planner = Planner(
        held, once_at(100, lambda p, now: replan(p.timeline, now + TAKES, [[-0.5, 0.9, 1.0], [0.4, 2.0, 1.0]], limits))
    )
    orders: list[Order] = []

    def react(message: Telemetry) -> None:
        planner.react(message)
        if planner.plans and isinstance(message, SetpointSent) and message.index == 200 and not orders:
            orders.append(Order.LAND)

    given: list[Order] = []

    def more() -> list[Order]:
        new = orders[len(given) :]
        given.extend(new)
        return new

    flight = fly_stepped(mission, react, more_orders=more, proposals=planner.proposals)
    assert flight.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR
    stopped = planner.timeline.motion.at(2.0 + 0.5 * DURATION).position  # as far as the flight goes in half the time
    np.testing.assert_allclose(flight.truth.position[-1, :2], stopped[:2], atol=0.15)
    assert limits.space.beyond(flight.truth.position)[:, :2].max() < 0.0


def test_a_stop_at_full_speed_brakes_as_hard_as_stops_may(held, mission, limits):
    """0.6 m from the setpoint at which it begins: the limit on braking alone would take 0.4 m, without time to lean."""
    moments = np.arange(0.0, held.ends, 0.01)
    speeds = np.linalg.norm(held.motion.at(moments).velocity, axis=1)
    fastest = int(np.argmax(speeds > 0.98 * limits.plan.speed)) or int(np.argmax(speeds))
    planner = Planner(held, once_at(fastest - TAKES, lambda p, now: halt(p.timeline, now + TAKES, limits)))
    flight = fly_stepped(mission, planner.react, proposals=planner.proposals)
    assert len(planner.plans) == 1
    assert flight.outcome.exit_code is ExitCode.OK
    stop = decode(planner.plans[0].proposal.payloads)
    assert np.linalg.norm(stop.velocity[0]) > 0.95 * limits.plan.speed
    assert np.linalg.norm(np.diff(stop.position, axis=0), axis=1).sum() < 0.33 * limits.plan.speed
    braking = np.linalg.norm(np.diff(stop.velocity, axis=0), axis=1).max() * RATE
    assert braking < limits.flight.acceleration.brake
    assert flight.outcome.deviation.max < 0.1
    assert_was_committed(flight, held, planner.plans, limits)


@pytest.mark.parametrize("splice", [148, 156, 188])
def test_a_stop_over_the_top_of_a_climb_is_flown_as_closely_as_others(limits, splice):
    """Motors run slowly there; the shortest stop that certifies turns the vehicle so fast that it sinks by 0.2 m."""
    points = np.array([[-1.0, -2.0, 0.6], [0.0, -0.6, 1.5], [0.2, 1.0, 0.7], [-0.5, 2.0, 1.0]])
    path = min_snap(points, times=centripetal_times(points))
    gentle = plan(path, limits.airframe, limits, planner="expert", speed_factor=0.85)  # a gap loses a faster one
    held = hold(gentle, points)
    planner = Planner(held, once_at(splice - TAKES, lambda p, _: halt(p.timeline, splice, limits)))
    mission = Mission(held.commitment.payloads, held.commitment.stops, limits, hold_time=1.0)
    flight = fly_stepped(mission, planner.react, proposals=planner.proposals)
    assert flight.outcome.exit_code is ExitCode.OK
    assert [type(answer) for answer in planner.answers] == [Commitment]
    stop = decode(planner.plans[0].proposal.payloads)
    assert np.linalg.norm(np.diff(stop.position, axis=0), axis=1).sum() < 0.37 * limits.plan.speed
    assert flight.outcome.deviation.max < 0.05


def random_requests(random: np.random.Generator, limits, count: Counter):
    """Requests of all kinds, some 0.2 s apart."""
    following = 20

    def request(planner: Planner, now: int) -> Replanned | Proposal | None:
        nonlocal following
        if now < following:
            return None
        following = now + int(random.integers(3, 40))
        kind = random.choice(
            ["replace", "extend", "stop", "outside", "garbage", "late", "near"], p=[0.4, 0.25] + [0.07] * 5
        )
        count[kind] += 1
        points = random.uniform(LOW, HIGH, (int(random.integers(1, 4)), 3))
        match kind:
            case "stop":
                return halt(planner.timeline, now + TAKES, limits)
            case "outside":
                points[-1, 2] = 3.0
            case "near":
                points[0] = planner.timeline.motion.at(joint_of(now + TAKES)).position + 0.02
            case "late":
                return replan(planner.timeline, now + 4, points, limits)
            case "extend" if planner.timeline.ends - now / RATE < 8.0:
                return replan(planner.timeline, now + TAKES, points, limits, keep=True)
            case "garbage":
                made = replan(planner.timeline, now + TAKES, points, limits).proposal
                rolled = np.roll(made.payloads, int(random.integers(1, 100)))
                return replace(made, payloads=rolled, checksum=checksum_of(made.splice, rolled, made.stops))
        return replan(planner.timeline, now + TAKES, points, limits)

    return request


def fly_random(held, mission, limits, seed: int, seconds: float) -> tuple[Flight, Planner, Counter]:
    count: Counter = Counter()
    inner = random_requests(np.random.default_rng(seed), limits, count)
    planner = Planner(held, lambda p, now: inner(p, now) if now < seconds * RATE else None)
    flight = fly_stepped(replace(mission, hold_time=3.0), planner.react, proposals=planner.proposals)
    return flight, planner, count


def test_random_requests_keep_every_limit_over_the_flown_sequence(held, mission, limits):
    flight, planner, count = fly_random(held, mission, limits, 1, 10.0)
    assert flight.outcome.exit_code is ExitCode.OK
    assert sum(count.values()) > 20
    assert len(planner.plans) > 8
    assert any(isinstance(answer, Refusal) for answer in planner.answers)
    assert flight.outcome.deviation.max < 0.15
    walls = limits.space.beyond(flight.truth.position)[:, :2]
    assert walls.max() < 0.05  # m, beyond the margin before the walls
    assert flight.truth.off_in_air[-1] == 0
    assert_was_committed(flight, held, planner.plans, limits)


@pytest.mark.slow
@pytest.mark.timeout(1800)  # of a busy computer, too
@pytest.mark.parametrize("seed", range(10, 20))
def test_a_minute_of_random_requests_is_one_certified_motion(held, mission, limits, seed):
    flight, planner, count = fly_random(held, mission, limits, seed, 60.0)
    assert flight.outcome.exit_code is ExitCode.OK
    assert sum(count.values()) > 200
    assert len(planner.plans) > 100
    assert flight.outcome.deviation.max < 0.1
    assert limits.space.beyond(flight.truth.position)[:, :2].max() < 0.05
    assert flight.truth.off_in_air[-1] == 0
    assert_was_committed(flight, held, planner.plans, limits)
