"""The pilot's tick loop, the same in every phase.

Everything happens in ticks at the rate of the setpoints. A tick waits for its deadline, sends the setpoint that is due,
forwards the newest good pose, and looks for reasons to end the flight. Whatever the pilot waits for, it waits in ticks,
so poses flow and the abort monitor watches meanwhile. A reason to leave the plan arrives as `AbortRaised` out of any
wait.

Each step of a tick is guarded: if one fails, the vehicle lands, and the other steps continue meanwhile.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.mocap.pose_tracker import PoseTracker
from cfplan.flight.mocap.poses import Pose, PoseSource
from cfplan.flight.pilot.abort_monitor import AbortMonitor, Observation, fault_abort, ordered
from cfplan.flight.pilot.abort_reasons import Abort, AbortReason
from cfplan.flight.pilot.conducted import NO_CONDUCTOR, ConductorSource
from cfplan.flight.pilot.deadlines import Deadlines
from cfplan.flight.pilot.flight_history import FlightHistory
from cfplan.flight.pilot.health import FRESH, GONE, UPLINK_GONE, Descent, Health, HealthMonitor
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.pilot.proposals import LOOKS_UNTIL, NO_PROPOSALS, ProposalSource
from cfplan.flight.pilot.stream import Stream, stream_of
from cfplan.flight.radio.link import Link
from cfplan.flight.setpoints.commitment import Commitment, splice
from cfplan.flight.setpoints.encoding import encode_motion
from cfplan.flight.setpoints.hover_to_hover import hover_to_hover
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.telemetry import Estimate, Level, Phase, PlanCommitted, PoseReceived, Triple, VehicleStatus
from cfplan.safety.space import Space
from cfplan.vehicle.rotations import yaw_of

ATTEMPTS = 3
_KEEP_ALIVE_PERIOD = 0.1  # s; the vehicle's watchdog stops the motors after 1 s without a keep-alive packet
MOTOR_TEST_PERIOD = 0.1  # s between queries for a motor test
LINK_LOST_AFTER = 10.0  # s without an acknowledgement, in flight; until then the link may come back
_BRAKING_TIME = 0.2  # s; a vehicle that levels out stops its velocity times this ahead
_MAX_STREAMS = 8  # streams to keep: a late pose is compared with the stream of its time


class OrderSource(Protocol):
    """The operator's orders and the state of the main process."""

    worst: Order | None  # the gravest order so far that ends the flight early
    finishing: bool  # the vehicle is to land where its plan ends
    gone: bool  # the main process has ended


class AbortRaised(Exception):
    """Raised when there is a reason to leave the plan."""

    def __init__(self, abort: Abort):
        self.abort = abort
        super().__init__(abort.text)


class LinkLost(Exception):
    """Raised when nothing more can be sent."""


class FlightLoop:
    """Serves one flight's link, poses, orders and abort monitor at every deadline.

    Its attributes are for reading; methods change them.
    """

    def __init__(
        self,
        mission: Mission,
        source: PoseSource,
        orders: OrderSource,
        history: FlightHistory,
        proposals: ProposalSource = NO_PROPOSALS,
        clock: Clock = REAL_CLOCK,
        *,
        conductor: ConductorSource = NO_CONDUCTOR,
    ):
        self.mission, self.limits, self.history, self.now = mission, mission.limits, history, clock.now
        self._conductor = conductor
        self._source, self._orders, self._proposals, self._clock = source, orders, proposals, clock
        self._monitor, self.tracker = AbortMonitor(mission.limits), PoseTracker(mission.limits.pose)
        self._health_monitor, self.health = HealthMonitor(mission.limits.pose), Health()
        self._deadlines = Deadlines(mission.rate, clock)
        self._link: Link | None = None
        self._feeding = False  # poses are read and forwarded
        self.airborne = False
        self._took_off = False  # from then on a fault of this program lands the vehicle instead of being raised
        self._stop_expected = math.inf  # s, from when on standing motors are expected
        self._tolerated = Rung.NONE  # an abort of this rung or a lesser one changes nothing
        self.commitment = Commitment(0, mission.payloads, mission.stops)
        self.plan = stream_of(self.commitment, mission.rate, on_board=mission.on_board is not None)
        self.stream: Stream | None = None  # what each tick sends
        self._in_doubt = False  # whether the vehicle may have left its stream, by a command that it has not answered
        self._unheard = False
        """Whether the vehicle was without setpoints for so long that it left its stream; until `hold_where_it_is`."""
        self._sent_at = math.inf  # s, when the last setpoint was sent
        self._faults = set[str]()  # steps of a tick that have failed
        self._just_sent = -1  # number of the last setpoint sent of the plan; -1 before the first
        self._begun: deque[Stream] = deque(maxlen=_MAX_STREAMS)  # the last streams, each with its start
        self.pose_fault = ""  # why there is no good pose
        self._forwarded = math.inf  # s, time of the last forwarded pose
        self._kept_alive = -math.inf  # s, time of the last keep-alive packet
        self._motor_test_polled = math.inf  # s, time of the last query for a motor test
        self.waking: deque[float] = deque(maxlen=200)  # s, lateness of the last ticks

    # Connecting, and what the loop serves.

    def connect(self, connect: Callable[[Callable[[], None]], Link]) -> None:
        """Connect to the vehicle; orders count meanwhile. Raises AbortRaised, and what `connect` raises."""
        self._link = connect(self._check_orders)

    @property
    def connected(self) -> bool:
        return self._link is not None

    @property
    def link(self) -> Link:
        """Return the link to the vehicle, after `connect`."""
        assert self._link is not None
        return self._link

    def open_poses(self) -> None:
        """Open the pose source; from now on each tick forwards the newest good pose. Raises what the source raises."""
        self._source.open()
        self._feeding = True
        self.restart_deadlines()

    def close_poses(self) -> None:
        """Close the pose source if it is open."""
        if self._feeding:
            self._source.close()

    def watch_motor_test(self) -> None:
        """From now on, end a motor test that another client starts, and the flight with it."""
        self._motor_test_polled = -math.inf

    def lift_off(self) -> None:
        """From now on every trigger of the abort ladder counts, not only orders."""
        self.airborne = self._took_off = True

    def touch_down(self) -> None:
        """From now on only orders count again."""
        self.airborne = False

    def expect_stop(self) -> None:
        """From now on, only orders count once the motors are off, as is expected."""
        self._stop_expected = self.now()

    def tolerate(self, rung: Rung) -> None:
        """Ignore aborts of this rung and of lesser ones from now on."""
        self._tolerated = rung

    # The stream.

    def begin(self, stream: Stream, commanded: float | None = None) -> Stream:
        """Send this stream from the next deadline on; return it with its start.

        A stream that is flown on board begins when the command, sent at `commanded`, s, or just now, has arrived and
        the commander polls for it, half a period later on average.
        """
        sent = self.now() if commanded is None else commanded
        arrived = sent + 0.5 * self.link.round_trip + 0.5 / stream.rate
        self.stream = stream.starting_at(arrived if stream.on_board else self._deadlines.upcoming)
        self._begun.append(self.stream)
        return self.stream

    @property
    def conducted(self) -> bool:
        """Return whether the vehicle flies in a fleet."""
        return self._conductor is not NO_CONDUCTOR

    def begin_plan(self, commanded: float | None = None) -> None:
        """Send the plan from the next deadline on; on board it began as `begin` says."""
        self.plan = self.begin(self.plan, commanded)
        self.history.first_setpoint = self.plan.start
        self._proposals.begin(self.plan.start)

    def doubt_stream(self, doubt: bool) -> None:
        """While the vehicle may have left its stream, do not compare its position with it."""
        self._in_doubt = doubt

    def end_stream(self) -> None:
        """Stop sending setpoints."""
        self.stream = None

    @property
    def finishing(self) -> bool:
        """Return whether the vehicle is to land at the end of its plan, without waiting for another."""
        return self._orders.finishing

    @property
    def motion_ends(self) -> float:
        """Time, s, from the plan's first setpoint to the first of those that only hover at its end."""
        return self.commitment.motion_ends / self.mission.rate

    def _consider_meanwhile(self, due: float) -> None:
        """Consider proposals that arrive well before the next setpoint of the plan is `due`, s."""
        while self.stream is self.plan and (left := due - LOOKS_UNTIL - self.now()) > 0.0:
            if not self._proposals.wait(left):
                return
            self._consider_proposal(self.now(), self._just_sent)

    def _consider_proposal(self, now: float, sent: int) -> None:
        """Fly a planner's proposal from its splice on if it verifies; answer the planner.

        `sent` is the number of the last setpoint sent.
        """
        proposal = self._proposals.newest()
        if proposal is None:
            return
        answer = splice(self.commitment, proposal, sent, self.limits)
        if isinstance(answer, Commitment):
            if not self.commitment.splices:
                self.history.report(committed(now, self.commitment.first, 0, self.commitment.payloads))
            self.history.report(committed(now, proposal.splice, proposal.checksum, proposal.payloads))
            self.commitment = answer
            self.plan = self.stream = self._begun[-1] = stream_of(answer, self.mission.rate, self.plan.start)
            if not proposal.goes_on:
                self.history.add_event(Level.INFO, f"a new plan is flown from setpoint {answer.splices[-1]} on")
        else:
            self.history.add_event(Level.WARNING, f"a new plan is refused: {answer}")
        self._proposals.answer(proposal, answer)

    def setpoint_position(self, time: float) -> Triple | None:
        """Return the position, m, of the setpoint at a time, s; None before the streams that are kept."""
        moment = time - self.mission.lead
        if self.stream is None:
            return None
        return next((stream.position(moment) for stream in reversed(self._begun) if stream.start <= moment), None)

    def setpoint_now(self) -> tuple[Triple, Triple, float]:
        """Return position, m, velocity, m/s, and yaw, rad, of the present setpoint."""
        assert self.stream is not None
        position, velocity, _, quaternion, _ = self.stream.state(self.stream.index(self.now()))
        return position, velocity, yaw_of(quaternion)

    # A vehicle that was without setpoints: its radio was dead, or this computer stalled.

    @property
    def descent(self) -> Descent:
        """Return how the vehicle comes down now."""
        return Descent.HELD if self._unheard else self.health.reaction.descent

    def hold_where_it_is(self) -> None:
        """Send a hover near the vehicle's position, which it follows once it acknowledges.

        The position is that of fresh poses, else that of the vehicle's estimate, else that of the last pose.
        """
        estimate, space = self.link.estimate, self.limits.space
        position, velocity, yaw = self.tracked_state()
        if self.health.poses is not FRESH:
            velocity = 0.0, 0.0, 0.0
            if estimate is not None and self.health.estimate is FRESH:
                position, velocity, yaw = estimate.position, estimate.velocity, yaw_of(estimate.quaternion)
        (x, y, z), rate = position, self.mission.rate
        place = _between_walls((x + _BRAKING_TIME * velocity[0], y + _BRAKING_TIME * velocity[1], z), space)
        if space.obstacles and not space.holds(place):  # stay here rather than enter an obstacle ahead
            place = _between_walls((x, y, z), space)
        motion = hover_to_hover(place, yaw, place, yaw, 1.0 / rate, rate)
        self.begin(Stream(encode_motion(motion, motion.acceleration, gains_under(self.limits), space=space), rate))
        self._unheard = self.health.uplink is not FRESH

    # Ticks.

    def tick(self) -> float:
        """Serve one deadline: the setpoint, then the poses, then the abort monitor. Return the time after it, s."""
        due = self._deadlines.wait(lambda due: self._guard("proposals", lambda: self._consider_meanwhile(due)))
        now = self.now()
        self.waking.append(now - due)
        late = max(now - due, now - self._sent_at - 1.0 / self.mission.rate)  # wherever this computer stalled
        self._guard("setpoints", lambda: self._send_setpoint(now, due))
        self._guard("watchdog", lambda: self._keep_alive(now))
        self._guard("motor test", lambda: self._end_motor_test(now))
        self._take_poses()
        self._guard("proposals", lambda: self._consider_due_proposal(now))
        self._guard("logs", lambda: self._update_health(now))
        self._check_orders()
        self._guard("abort monitor", lambda: self._monitor_flight(now, late))
        return now

    def _guard(self, step: str, act: Callable[[], None]) -> None:
        """Run one step of a tick. Its first fault lands the vehicle; the other steps continue meanwhile."""
        try:
            act()
        except (AbortRaised, LinkLost):
            raise
        except Exception as error:
            if not self._took_off:
                raise
            if step not in self._faults:
                self._faults.add(step)
                self._leave_for(fault_abort(error))

    def _send_setpoint(self, now: float, due: float) -> None:
        stream = self.stream
        if stream is None:
            return
        index = stream.index(now)
        if not stream.on_board:
            self._unheard |= self.airborne and now - self._sent_at > UPLINK_GONE
            self.link.send(stream.packet(index))
            self._sent_at = now
        if self.history.first_setpoint:
            self.history.report(stream.sent(index, due if stream.on_board else now, due))
        if stream is self.plan and now < stream.end and not stream.on_board:
            self.history.late.append(now - due)

    def _keep_alive(self, now: float) -> None:
        watched = self.airborne or self.watched  # until the link closes; the vehicle locks 1 s later
        due = now - self._kept_alive > _KEEP_ALIVE_PERIOD or self.health.uplink is not FRESH  # most packets are lost
        if watched and self.limits.firmware.watchdog and due:
            self._kept_alive = now
            self.link.keep_alive()

    def _end_motor_test(self, now: float) -> None:
        """End a motor test that was started since preflight, and raise AbortRaised; at each tick until it has ended."""
        if self.health.uplink is FRESH and now - self._motor_test_polled > MOTOR_TEST_PERIOD:
            self._motor_test_polled = now
            self.link.ask_motor_test()
        if self.link.motor_test:
            self.link.end_motor_test()
            self._leave_for(AbortReason.MOTOR_TEST.abort(Rung.LAND))

    def _consider_due_proposal(self, now: float) -> None:
        if self.stream is not None and self.stream is self.plan:
            self._just_sent = self.plan.number(now)
            self._consider_proposal(now, self._just_sent)

    def _update_health(self, now: float) -> None:
        """Compute the health of this tick, and recreate logs that the vehicle no longer sends."""
        link = self.link
        self.health = self._health_monitor.look(
            now,
            uplink=link.acknowledged,
            poses=-math.inf if self.tracker.distrusted else self._forwarded,
            estimate=link.estimate.time if link.estimate is not None else -math.inf,
            status=link.status.time if link.status is not None else -math.inf,
        )
        streams = self.stream is not None and not self.stream.on_board
        self._unheard |= self.airborne and streams and self.health.uplink is GONE
        if self.health.uplink is FRESH and self._feeding:
            for log in ("estimate", "status"):
                if getattr(self.health, log) is GONE:
                    link.recreate_log(log)

    def _take_poses(self) -> None:
        """Forward new poses. After take-off, a fault here counts as no pose: the last one grows old."""
        if not self._feeding:
            return
        try:
            self._forward_poses()
        except Exception as error:
            if not self._took_off:
                raise
            if not self.pose_fault:
                self.pose_fault = f"fault in the pilot: {error!r}"
                self.history.add_event(Level.ERROR, f"pose: {self.pose_fault}")

    def _forward_poses(self) -> None:
        tracker, link, step = self.tracker, self.link, self.tracker.step
        fresh = self.health.estimate is FRESH
        tracker.sense(self.now(), link.estimate, link.status, airborne=self.airborne, fresh=fresh)
        for pose in self._source.poses():
            if tracker.take(pose):
                self.history.report(PoseReceived(pose.time, pose.received, pose.position, pose.quaternion))
            if tracker.last is pose:
                self._note_deviation(pose)
        if tracker.step and not step:
            self.history.add_event(Level.WARNING, f"pose: a step of {tracker.step:.2f} m reaches the vehicle slowly")
        now = self.now()
        sent = tracker.to_send(now)
        if sent is not None and tracker.last is not None:
            link.send_pose(*sent)
            self._forwarded = tracker.last.time
        slow = self._tolerated is Rung.NONE and not (self.history.first_setpoint or self._unheard)
        tracker.compare_motion(now, self.limits.flight.patience, slow=slow)
        why = tracker.distrusted or self._source.fault or tracker.fault
        if why != self.pose_fault:
            self.pose_fault = why
            self.history.add_event(Level.WARNING, f"pose: {why or 'good again'}")

    def _note_deviation(self, pose: Pose) -> None:
        moment = pose.time - self.mission.lead
        if self.stream is not self.plan or moment < self.plan.start:
            return
        distance = math.dist(pose.position, self.plan.position(moment))
        self.history.off_plan.append((pose.time - self.plan.start, distance))

    @property
    def estimate(self) -> Estimate | None:
        """Return the vehicle's estimate, None while its log is gone."""
        return self.link.estimate if self.health.estimate is not GONE else None

    @property
    def status(self) -> VehicleStatus | None:
        """Return the vehicle's status, None while its log is gone."""
        return self.link.status if self.health.status is not GONE else None

    def _monitor_flight(self, now: float, late: float) -> None:
        """Raise LinkLost if the link is lost, and in the air AbortRaised if there is a reason to abort."""
        silent = self._health_monitor.uplink_silent
        if self.link.lost or (self.airborne and silent > LINK_LOST_AFTER):
            raise LinkLost
        if not self.airborne or self._stopped():
            return
        pose, estimate = self.tracker.last, self.estimate
        compared = not self._in_doubt
        observation = Observation(
            now=now,
            uplink_silent=silent,
            logs_silent=now - self.link.log_heard,
            pose=pose,
            pose_fault=self.pose_fault,
            health=self.health,
            setpoint_at_pose=self.setpoint_position(pose.time) if compared and pose is not None else None,
            estimate=estimate,
            setpoint_at_estimate=self.setpoint_position(estimate.time) if compared and estimate is not None else None,
            status=self.status,
            late=late if self.stream is not None and not self.stream.on_board else 0.0,
        )
        abort = self._monitor.gravest(observation)
        if abort is not None:
            self._leave_for(abort)

    def _leave_for(self, abort: Abort) -> None:
        """Raise AbortRaised unless the abort is tolerated."""
        if abort.rung > self._tolerated:
            raise AbortRaised(abort)

    def _stopped(self) -> bool:
        """Return whether the motors are off, as expected."""
        status = self.link.status
        return status is not None and status.time > self._stop_expected and not any(status.motor)

    def _check_orders(self) -> None:
        """Raise AbortRaised for an operator command, the fleet's braking, or the loss of the main process.

        Also without a link.
        """
        abort = ordered(self._orders.worst, main_gone=self._orders.gone)
        if abort is None and (reason := self._conductor.brakes(self.now())):
            abort = AbortReason.FLEET_BRAKES.abort(Rung.BRAKE, reason=reason)
        if abort is not None:
            self._leave_for(abort)

    @property
    def watched(self) -> bool:
        """Return whether the vehicle's watchdog has been started."""
        return self._kept_alive > -math.inf

    # Waiting.

    def restart_deadlines(self) -> None:
        """Count deadlines from now on; those missed during slow work on the ground do not count."""
        self._deadlines = Deadlines(self.mission.rate, self._clock)

    @property
    def skipped(self) -> int:
        """Return how many deadlines have been skipped since `restart_deadlines`."""
        return self._deadlines.skipped

    def until(self, done: Callable[[], bool], patience: float) -> bool:
        """Tick until `done`, at most for `patience`, s; return whether it was done in time."""
        end = self.now() + patience
        while self.tick() < end:
            if done():
                return True
        return done()

    def await_clearance(self, phase: Phase) -> None:
        """Tick until the fleet's conductor lets a phase begin; return at once where there is none."""
        conductor = self._conductor
        conductor.ask(phase)
        if conductor.clearance(phase) > self.now():
            self.until(lambda: conductor.clearance(phase) <= self.now(), math.inf)

    def pause(self, duration: float) -> None:
        """Tick for `duration`, s."""
        self.until(lambda: False, duration)

    # The vehicle's state.

    def pose(self) -> Pose:
        """Return the last good pose; there is one once the feed has begun."""
        pose = self.tracker.last
        assert pose is not None
        return pose

    def tracked_state(self) -> tuple[Triple, Triple, float]:
        """Return position, m, velocity, m/s, and yaw, rad, now, by the last good poses."""
        return self.tracker.position(self.now()), self.tracker.velocity, yaw_of(self.pose().quaternion)

    def heights(self, duration: float) -> list[float]:
        """Return the heights, m, of the good poses of the last `duration`, s; none if they reach back less."""
        return self.tracker.heights(self.now() - duration)

    @property
    def time_without_poses(self) -> float:
        """Return how long, s, the vehicle has been without a pose; late ones are not forwarded."""
        return self.now() - self._forwarded

    def bits(self, mask: int) -> int:
        """Return the bits of `mask` that are set in the log variable supervisor.info; 0 without a log."""
        status = self.link.status
        return status.supervisor & mask if status is not None else 0


def committed(time: float, splice: int, checksum: int, payloads: NDArray) -> PlanCommitted:
    """Return the telemetry of setpoints (K, 29) that are committed from number `splice` on, in a proposal or before."""
    return PlanCommitted(time, splice, checksum, payloads.tobytes())


def _between_walls(place: Triple, space: Space) -> Triple:
    """Return the nearest place, m, that keeps the margin from walls and ceiling."""
    low, high = np.add(space.low, space.margin).tolist(), np.subtract(space.high, space.margin).tolist()
    x, y, z = place
    return min(max(x, low[0]), high[0]), min(max(y, low[1]), high[1]), min(z, high[2])
