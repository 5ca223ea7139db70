"""The pilot: the phases of one flight in the air, and the abort ladder that ends it early.

Each rung of the abort ladder can only be left for a graver one. Motors never stop between the stream and the on-board
commander: the commander gets its command first, and the priority only when it has answered.
"""

import math
from collections.abc import Callable

import numpy as np

from cfplan.errors import CfplanError, ExitCode, PreflightError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.mocap.poses import PoseSource
from cfplan.flight.pilot.abort_monitor import Abort, safety_abort
from cfplan.flight.pilot.flight_history import FlightHistory
from cfplan.flight.pilot.flight_loop import REPLY, TRIES, AbortRaised, FlightLoop, LinkLost, OrderSource
from cfplan.flight.pilot.mission import Mission, manoeuvre_time
from cfplan.flight.pilot.outcome import FlightOutcome, Rung
from cfplan.flight.pilot.prearm import prepare
from cfplan.flight.pilot.stream import Stream
from cfplan.flight.radio.link import GO_TO, LAND, TAKE_OFF, Link
from cfplan.flight.radio.supervisor_bits import ARMED, FLYING, HIGH_LEVEL_ACTIVE, LOCKED
from cfplan.flight.setpoints.encoding import encode_motion
from cfplan.flight.setpoints.hover_to_hover import hover_to_hover
from cfplan.flight.setpoints.rate_trade import ahead
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.flight.telemetry import Level, Phase, Telemetry, Triple
from cfplan.vehicle.rotations import yaw_of

_AT_START_WITHIN = 0.06  # m
_AT_START_FOR = 0.5  # s
_FOLLOWS_WITHIN = 0.15  # m from its setpoint; a vehicle farther off stops from the setpoint nearest to it
_BRAKE_HOLD = 1.0  # s of hover after a stop
_ON_THE_FLOOR = 0.15  # m above where it took off
_BELOW_FLOOR = 0.03  # m below the floor that landings aim at, so that motors stop on the floor and not above
_BLIND_LAND_SPEED = 0.6  # m/s, mean, at least: without poses the vehicle drifts half a metre in 2 s
_SETTLE_ON_FLOOR = 0.3  # s on the floor before motors stop
_MOTORS_STOP_WITHIN = 4.0  # s; the vehicle reports that it no longer flies 2 s after its motors stopped
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
        clock: Clock = REAL_CLOCK,
    ):
        self._mission, self._limits = mission, mission.limits
        self._connect, self._enter_real_time = connect, enter_real_time
        self._history = FlightHistory(report, clock)
        self._loop = FlightLoop(mission, source, orders, self._history, clock)
        self._floor = 0.0  # m, height of the tracked body before take-off

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
        return self._history.outcome(self._mission, exit_code, reason, loop.recent[-1] if loop.recent else None)

    def _fly(self) -> tuple[ExitCode, str]:
        """Go through the phases; return how the flight counts, and why it ended."""
        loop = self._loop
        try:
            self._floor = prepare(loop, self._connect, self._enter_real_time)
            self._take_off()
            self._go_to_start()
            self._fly_plan()
            self._hand_back()
            self._land()
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
        """Climb by setpoints, once the on-board commander has agreed to take off: it knows whether the vehicle may fly.

        Flown by the on-board commander the vehicle would hover on without this program or its poses; flown by setpoints
        it has time-outs.
        """
        loop = self._loop
        self._history.enter(Phase.TAKE_OFF)
        height, (x, y, _) = self._mission.take_off_height, loop.pose().position
        yaw, climb = yaw_of(loop.pose().quaternion), height - self._floor
        duration = manoeuvre_time(climb, self._limits.ground.take_off_speed)
        way = self._way((x, y, self._floor), yaw, (x, y, height), yaw, duration)
        if way.stop_from is not None:
            way.stop_from(0)  # the first call is slow: make it on the ground
        code = loop.ask(lambda: loop.link.take_off(height, duration), TAKE_OFF)
        if code:
            raise PreflightError(
                f"the vehicle refuses to take off (code {code})", hint="restart the vehicle, and look at its battery"
            )
        loop.lift_off()
        way = loop.begin(way)
        if loop.until(lambda: loop.now() > way.end or self._pose_stays(way), math.inf) and self._pose_stays(way):
            self._stay_down()
        loop.until(lambda: abs(loop.pose().position[2] - height) < _AT_START_WITHIN, 2.0)
        if loop.pose().position[2] - self._floor < climb / 2:
            raise AbortRaised(safety_abort(Rung.LAND, "the vehicle does not rise"))

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
        self._stop_motors()
        self._loop.touch_down()
        self._motors_stop()
        raise PreflightError(
            "the tracked body stays on the floor while the vehicle takes off",
            where="motion capture",
            hint="is it another body than the vehicle, are two of them swapped? Else look at battery and propellers",
        )

    def _way(self, begin: Triple, yaw: float, end: Triple, end_yaw: float, duration: float) -> Stream:
        """Return setpoints from hover to hover, with a way to stop from each."""
        rate = self._mission.rate
        motion = hover_to_hover(begin, yaw, end, end_yaw, duration, rate)
        space = self._limits.space
        payloads = encode_motion(motion, ahead(motion.acceleration, rate), space=space)
        return Stream(
            payloads, rate, stop_from=lambda row: encode_stops(motion, rate, rows=np.array([row]), space=space)[0]
        )

    def _follow(self, stream: Stream) -> None:
        """Fly a stream to its end."""
        end = self._loop.begin(stream).end
        self._loop.until(lambda: self._loop.now() > end, math.inf)

    def _go_to_start(self) -> None:
        """Fly to the plan's first setpoint and wait until the vehicle is there."""
        loop = self._loop
        self._history.enter(Phase.GO_TO_START)
        start, yaw = self._mission.start
        (above, quaternion), here = loop.resting(), loop.pose().position
        duration = manoeuvre_time(math.dist(here, start), self._limits.ground.go_to_speed)
        self._follow(self._way(above, yaw_of(quaternion), start, yaw, duration))
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
        """Stream the plan, then hover for the mission's hold time."""
        loop = self._loop
        self._history.enter(Phase.STREAM)
        skipped = loop.skipped
        loop.begin_plan()
        loop.until(lambda: loop.now() > loop.plan.end, math.inf)
        self._history.skipped = loop.skipped - skipped
        self._history.enter(Phase.HOLD)
        loop.pause(self._mission.hold_time)

    def _hand_back(self) -> None:
        """Let the on-board commander hover at the plan's end."""
        loop = self._loop
        self._history.enter(Phase.HAND_BACK)
        end, yaw = self._mission.end
        if self._hand_over(lambda: loop.link.go_to(end, yaw, 1.0), GO_TO):
            loop.pause(1.0)

    def _hand_over(self, command: Callable[[], None], number: int) -> bool:
        """Hand the vehicle from the stream to the on-board commander; return whether that takes over.

        A setpoint would undo the command, so none is sent meanwhile. The stream goes on if the commander refuses.
        """
        loop = self._loop
        for _ in range(TRIES):
            loop.pause_sending()
            code = loop.ask(command, number, tries=1)
            if code == 0:
                break
            loop.resume_sending()  # hover on while asking again
            loop.pause(0.05)
        else:
            self._history.say(Level.WARNING, f"the on-board commander does not take over (code {code})")
            return False
        loop.end_stream()
        for _ in range(TRIES):
            loop.link.release_priority()
            if loop.until(lambda: bool(loop.bits(HIGH_LEVEL_ACTIVE)), REPLY):
                break
        return True

    def _land(self) -> None:
        """Descend where the vehicle is until it reports that it no longer flies."""
        self._history.enter(Phase.LAND)
        for _ in range(TRIES):
            if self._try_to_land():
                self._loop.touch_down()
                return
        raise AbortRaised(safety_abort(Rung.CUT, "the vehicle does not land"))

    def _try_to_land(self) -> bool:
        """Command a landing, by setpoints if the on-board commander refuses; return whether the motors stopped."""
        loop = self._loop
        height = max(loop.pose().position[2] - self._floor, 0.0)
        blind = loop.now() - loop.pose().time > self._limits.pose.age_brake
        speed = max(self._limits.ground.land_speed, _BLIND_LAND_SPEED if blind else 0.0)
        duration = manoeuvre_time(height, speed)

        def land() -> None:
            loop.link.land(self._floor - _BELOW_FLOOR, duration)

        if not self._commanded(land):
            self._descend(duration)
            return self._motors_stop()
        loop.pause(duration)
        if self._motors_stop():
            return True
        if loop.pose().position[2] - self._floor > _ON_THE_FLOOR:
            return False
        self._history.say(Level.WARNING, "on the floor with turning motors: stopping them")
        loop.link.stop_motors()
        return self._motors_stop()

    def _commanded(self, land: Callable[[], None]) -> bool:
        """Return whether the on-board commander lands; without a stream, no answer counts as yes."""
        if self._loop.stream is not None:
            return self._hand_over(land, LAND)
        return not self._loop.ask(land, LAND)

    def _descend(self, duration: float) -> None:
        """Descend by setpoints from where the vehicle hovers, and stop the motors."""
        loop = self._loop
        place, quaternion = loop.resting()
        yaw = yaw_of(quaternion)
        self._follow(self._way(place, yaw, (*place[:2], self._floor - _BELOW_FLOOR), yaw, duration))
        loop.pause(_SETTLE_ON_FLOOR)
        self._stop_motors()

    def _stop_motors(self) -> None:
        """Stop the motors by stop setpoints, the last setpoints to be sent."""
        loop = self._loop
        loop.end_stream()
        for _ in range(TRIES):
            loop.link.stop_setpoint()
            loop.pause(0.02)
        loop.link.release_priority()

    def _motors_stop(self) -> bool:
        return self._loop.until(lambda: not self._loop.bits(FLYING), _MOTORS_STOP_WITHIN)

    # The abort ladder.

    def _leave_plan(self, abort: Abort) -> tuple[ExitCode, str]:
        """Go down the ladder to the ground; return how the flight counts, and why."""
        loop = self._loop
        exit_code, reasons = abort.exit_code, [abort.text]
        while True:
            self._history.rung = max(self._history.rung, abort.rung)
            loop.tolerate(self._history.rung)
            loop.resume_sending()
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
        self._stop()
        self._history.enter(Phase.HOLD)
        self._loop.pause(_BRAKE_HOLD)
        self._land()

    def _stop_and_land(self) -> None:
        self._stop()
        self._land()

    def _stop(self) -> None:
        """Brake along the path to a hover, or finish a stop that has begun; without a stream do nothing."""
        loop = self._loop
        left = loop.stream
        if left is not None and left.stop_from is not None:
            stop = left.stop_from(self._present_index(left))
            started = loop.begin(Stream(stop, self._mission.rate))
            if left is loop.plan:
                self._history.stopped_at = started.start
        if loop.stream is not None:
            end = loop.stream.end
            loop.until(lambda: loop.now() > end, math.inf)

    def _present_index(self, stream: Stream) -> int:
        """Return the setpoint to stop from: the present one, or the nearest before it if the vehicle fell behind."""
        loop = self._loop
        due = stream.index(loop.now())
        pose = loop.pose()
        if loop.now() - pose.time > self._limits.pose.age_warning:
            return due
        lead = self._mission.lead
        if math.dist(pose.position, stream.position(pose.time - lead)) < _FOLLOWS_WITHIN:
            return due
        nearest, least = due, math.inf
        for index in range(due, -1, -1):
            distance = math.dist(pose.position, stream.states[index][0])
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
            loop.link.close()
        loop.close_poses()
        self._history.enter(Phase.CLOSED)
