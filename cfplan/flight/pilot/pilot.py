"""The pilot: the phases of one flight in the air, and the abort ladder that ends it early.

Each rung of the abort ladder can only be left for a graver one. From lift-off to the floor the vehicle flies by
setpoints alone: it has time-outs for these, and none for what its on-board commander flies.
"""

import math
from collections.abc import Callable

import numpy as np

from cfplan.errors import CfplanError, ExitCode, LinkError, PreflightError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.mocap.poses import PoseSource
from cfplan.flight.pilot.abort_monitor import Abort, safety_abort
from cfplan.flight.pilot.flight_history import FlightHistory
from cfplan.flight.pilot.flight_loop import TRIES, AbortRaised, FlightLoop, LinkLost, OrderSource
from cfplan.flight.pilot.landing import Landing, stop_motors
from cfplan.flight.pilot.mission import Mission, manoeuvre_time
from cfplan.flight.pilot.outcome import FlightOutcome, Rung
from cfplan.flight.pilot.prearm import prepare
from cfplan.flight.pilot.proposals import NO_PROPOSALS, ProposalSource
from cfplan.flight.pilot.stream import Stream
from cfplan.flight.radio.link import Link
from cfplan.flight.radio.supervisor_bits import ARMED, CAN_FLY, FAULTS, FLYING, LOCKED
from cfplan.flight.setpoints.encoding import encode_motion
from cfplan.flight.setpoints.hover_to_hover import hover_to_hover
from cfplan.flight.setpoints.rate_trade import ahead, gains_under
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.flight.telemetry import Level, Phase, Telemetry, Triple
from cfplan.vehicle.rotations import yaw_of

_AT_START_WITHIN = 0.06  # m
_AT_START_FOR = 0.5  # s
_FOLLOWS_WITHIN = 0.15  # m from its setpoint; a vehicle farther off stops from the setpoint nearest to it
_BRAKE_HOLD = 1.0  # s of hover after a stop
_READY_WITHIN = 1.0  # s; a vehicle that arms itself is briefly not ready now and then
# m above the floor: when the setpoint has reached the first, the pose must have reached the second
_ASKED_TO_RISE, _RISEN = 0.12, 0.015
_LOCKED_WITHIN = 2.5  # s for a cut to arrive; without setpoints the vehicle stops its motors after 2 s by itself


class Pilot:
    """Flies one mission, once."""

    def __init__(
        self,
        mission: Mission,
        *,
        connect: Callable[[Callable[[], None]], Link],
        source: PoseSource,
        report: Callable[[Telemetry], None],
        orders: OrderSource,
        enter_real_time: Callable[[], None] = lambda: None,
        proposals: ProposalSource = NO_PROPOSALS,
        clock: Clock = REAL_CLOCK,
    ):
        self._mission, self._limits = mission, mission.limits
        self._connect, self._enter_real_time = connect, enter_real_time
        self._history = FlightHistory(report, clock)
        self._loop = FlightLoop(mission, source, orders, self._history, proposals, clock)
        self._floor = 0.0  # m, height of the tracked body before take-off
        self._landing = Landing(self._loop, self._floor)

    def fly(self) -> FlightOutcome:
        """Fly all phases. Raises a CfplanError if the vehicle or its poses are not available; nothing is armed then."""
        loop = self._loop
        try:
            exit_code, reason = self._fly()
        except LinkLost:
            exit_code, reason = ExitCode.LINK_LOST, f"the link was lost: {loop.link.lost or 'the log fell silent'}"
            self._history.say(Level.ERROR, reason)
        finally:
            self._finish()
        last_pose = loop.recent[-1] if loop.recent else None
        return self._history.outcome(loop.motion_ends + self._mission.lead, exit_code, reason, last_pose)

    def _fly(self) -> tuple[ExitCode, str]:
        """Go through the phases; return how the flight counts, and why it ended."""
        loop = self._loop
        try:
            self._floor = prepare(loop, self._connect, self._enter_real_time)
            self._landing = Landing(loop, self._floor)
            self._take_off()
            self._go_to_start()
            self._fly_plan()
            self._landing.land()
        except AbortRaised as raised:
            return self._leave_plan(raised.abort)
        except LinkLost:
            raise
        except CfplanError as error:
            if not self._history.checks:
                raise
            return error.exit_code, str(error)
        except Exception as error:  # a fault of this program must not end in the air
            if not loop.airborne:
                raise
            return self._leave_plan(safety_abort(Rung.LAND, f"fault in the pilot: {error!r}"))
        return ExitCode.OK, "landed"

    def _take_off(self) -> None:
        """Climb by setpoints."""
        loop = self._loop
        self._history.enter(Phase.TAKE_OFF)
        height, (x, y, _) = self._mission.take_off_height, loop.pose().position
        yaw, climb = yaw_of(loop.pose().quaternion), height - self._floor
        duration = manoeuvre_time(climb, self._limits.ground.take_off_speed)
        way = self._way((x, y, self._floor), yaw, (x, y, height), yaw, duration)
        if way.stop_from is not None:
            way.stop_from(0)  # the first call is slow: make it on the ground
        self._require_ready()
        loop.lift_off()
        way = loop.begin(way)
        if loop.until(lambda: loop.now() > way.end or self._pose_stays(way), math.inf) and self._pose_stays(way):
            self._stay_down()
        loop.until(lambda: abs(loop.pose().position[2] - height) < _AT_START_WITHIN, 2.0)
        if loop.pose().position[2] - self._floor < climb / 2:
            raise AbortRaised(safety_abort(Rung.LAND, "the vehicle does not rise"))

    def _require_ready(self) -> None:
        """Wait until the vehicle's supervisor says that it may fly: it ignores setpoints until then.

        Raises PreflightError if it does not say so.
        """
        loop = self._loop
        if loop.until(lambda: loop.bits(ARMED | CAN_FLY) == ARMED | CAN_FLY, _READY_WITHIN):
            return
        faults = " and ".join(fault for bit, fault in FAULTS.items() if loop.bits(bit))
        armed = "is armed and not ready to fly" if loop.bits(ARMED) else "is no longer armed"
        raise PreflightError(
            f"the vehicle may not take off: it {faults or armed}",
            where="vehicle",
            hint="restart it on a level floor; its console says more",
        )

    def _pose_stays(self, way: Stream) -> bool:
        """Return whether the tracked body stays on the floor while the vehicle must rise.

        On the ground the vehicle cannot be told from another body that stands still. With that body's pose the
        vehicle's controller would climb at full thrust.
        """
        loop = self._loop
        pose = loop.pose()
        asked = way.position(pose.time - self._mission.lead)[2]
        return asked - self._floor > _ASKED_TO_RISE and pose.position[2] - self._floor < _RISEN

    def _stay_down(self) -> None:
        """Stop the motors, at most a quarter of a metre above the floor, and raise PreflightError."""
        loop = self._loop
        turning = bool(loop.bits(FLYING))
        stop_motors(loop)
        loop.touch_down()
        if not turning:
            raise PreflightError(
                "the vehicle does not start its motors",
                where="vehicle",
                hint="restart it; its console may say why its supervisor ignores setpoints",
            )
        raise PreflightError(
            "the tracked body stays on the floor while the vehicle takes off",
            where="motion capture",
            hint="is it another body than the vehicle, are two of them swapped? Else look at battery and propellers",
        )

    def _way(self, begin: Triple, yaw: float, end: Triple, end_yaw: float, duration: float) -> Stream:
        """Return setpoints from hover to hover, with a way to stop from each."""
        rate = self._mission.rate
        motion = hover_to_hover(begin, yaw, end, end_yaw, duration, rate)
        gains, space = gains_under(self._limits), self._limits.space
        payloads = encode_motion(motion, ahead(motion.acceleration, rate), gains, space=space)
        return Stream(
            payloads,
            rate,
            stop_from=lambda row: encode_stops(motion, rate, rows=np.array([row]), gains=gains, space=space)[0],
        )

    def _go_to_start(self) -> None:
        """Fly to the plan's first setpoint and wait until the vehicle is there."""
        loop = self._loop
        self._history.enter(Phase.GO_TO_START)
        start, yaw = self._mission.start
        above, _, yaw_above = loop.asked()
        duration = manoeuvre_time(math.dist(loop.pose().position, start), self._limits.ground.go_to_speed)
        way = loop.begin(self._way(above, yaw_above, start, yaw, duration))
        loop.until(lambda: loop.now() > way.end, math.inf)
        near_since = math.inf

        def settled() -> bool:
            nonlocal near_since
            now = loop.now()
            near = math.dist(loop.pose().position, start) < _AT_START_WITHIN
            near_since = min(near_since, now) if near else math.inf
            return now - near_since > _AT_START_FOR

        if not loop.until(settled, 5.0):
            away = math.dist(loop.pose().position, start)
            raise AbortRaised(safety_abort(Rung.LAND, f"still {away:.2f} m from the start"))

    def _fly_plan(self) -> None:
        """Stream the plan, then hover for the mission's hold time; a new plan that comes meanwhile is flown too."""
        loop = self._loop
        skipped = loop.skipped
        loop.begin_plan()
        while True:
            self._history.enter(Phase.STREAM)
            loop.until(lambda: loop.now() > loop.plan.end, math.inf)
            self._history.skipped = loop.skipped - skipped
            self._history.enter(Phase.HOLD)
            if not loop.until(lambda: loop.finishing or loop.now() < loop.plan.end, self._mission.hold_time):
                break
            if loop.finishing and loop.now() >= loop.plan.end:
                break

    # The abort ladder.

    def _leave_plan(self, abort: Abort) -> tuple[ExitCode, str]:
        """Go down the ladder to the ground; return how the flight counts, and why."""
        loop = self._loop
        exit_code, reasons = abort.exit_code, [abort.text]
        while True:
            self._history.rung = max(self._history.rung, abort.rung)
            loop.tolerate(self._history.rung)
            level = Level.ERROR if abort.rung is Rung.CUT else Level.WARNING
            self._history.say(level, f"{abort.rung.name.lower()}: {abort.text}")
            try:
                if loop.airborne:
                    {Rung.BRAKE: self._brake, Rung.LAND: self._stop_and_land, Rung.CUT: self._cut}[abort.rung]()
                return exit_code, ", then ".join(reasons)
            except AbortRaised as graver:
                abort = graver.abort
            except LinkLost:
                raise
            except Exception as error:  # where landing breaks, only cutting is left
                if abort.rung is Rung.CUT:
                    raise
                abort = safety_abort(Rung.CUT, f"fault in the pilot: {error!r}")
            reasons.append(abort.text)

    def _brake(self) -> None:
        loop = self._loop
        self._stop()
        if not (self._landing.begun or loop.left_alone):
            self._history.enter(Phase.HOLD)
            loop.until(lambda: loop.left_alone, _BRAKE_HOLD)
        self._landing.land()

    def _stop_and_land(self) -> None:
        self._stop()
        self._landing.land()

    def _stop(self) -> None:
        """Brake along the path to a hover, or finish a stop that has begun; sink besides where poses are gone.

        A vehicle that was left alone is no longer on its path.
        """
        loop, left = self._loop, self._loop.stream
        if left is None or self._landing.begun or loop.left_alone:
            return
        if left.stop_from is not None:
            stop = left.stop_from(self._present_index(left))
            started = loop.begin(Stream(stop, self._mission.rate))
            if left is loop.plan:
                self._history.stopped_at = started.start
        end = loop.stream.end if loop.stream is not None else 0.0
        loop.until(lambda: loop.now() > end or loop.blind or loop.left_alone, math.inf)
        if loop.now() < end and not loop.left_alone:
            self._landing.sink_while_stopping()
            loop.until(lambda: loop.now() > end or loop.left_alone, math.inf)

    def _present_index(self, stream: Stream) -> int:
        """Return the setpoint to stop from: the present one, or the nearest before it if the vehicle fell behind."""
        loop = self._loop
        due = stream.index(loop.now())
        pose = loop.pose()
        if loop.now() - pose.time > self._limits.pose.age_warning:
            return due
        wanted = loop.wanted(pose.time)
        if wanted is None or math.dist(pose.position, wanted) < _FOLLOWS_WITHIN:
            return due
        nearest, least = due, math.inf
        for index in range(due, stream.first - 1, -1):
            distance = math.dist(pose.position, stream.state(index)[0])
            if distance < least:
                nearest, least = index, distance
            elif distance > least + _FOLLOWS_WITHIN:  # what comes nearer again is another turn of the path
                break
        return nearest

    def _cut(self) -> None:
        """Cut the motors, at every tick until the vehicle reports that it is locked: the radio may lose packets."""
        loop = self._loop
        loop.end_stream()

        def locked() -> bool:
            loop.link.emergency_stop()
            return bool(loop.bits(LOCKED))

        if not locked() and not loop.until(locked, _LOCKED_WITHIN):
            self._history.say(Level.ERROR, "the vehicle does not say that its motors were cut")
        loop.touch_down()

    # The end.

    def _finish(self) -> None:
        """Disarm and close the link on the ground; in the air the link is lost, and stays open."""
        loop = self._loop
        if loop.connected and not loop.airborne:
            self._history.enter(Phase.DISARM)
            loop.tolerate(Rung.CUT)  # the flight is over: nothing can end it any more
            loop.end_stream()
            try:
                for _ in range(TRIES):
                    loop.link.arm(False)
                    if loop.until(lambda: not loop.bits(ARMED), 0.2):
                        break
            except (LinkLost, AbortRaised):
                self._history.say(Level.WARNING, "the link went before the vehicle was disarmed")
            locked = loop.bits(LOCKED)
            loop.link.close()
            if loop.watched and not locked:
                self._restart()
        loop.close_poses()
        self._history.enter(Phase.CLOSED)

    def _restart(self) -> None:
        """Restart the vehicle, which its watchdog locks now that nothing feeds it, for the next flight."""
        self._history.say(Level.INFO, "the vehicle restarts for the next flight")
        try:
            self._loop.link.restart()
        except LinkError as error:
            self._history.say(Level.WARNING, str(error))
