"""The pilot: the phases of one flight in the air, and the ways out of it.

Each rung of the abort ladder can only be left for a graver one. Motors never stop between the stream and the on-board
commander: a command to the latter comes first, and only when it has answered is it given the priority.
"""

import math
import time
from collections.abc import Callable

import numpy as np

from cfplan.errors import CfplanError, ExitCode, PreflightError
from cfplan.flight.mocap.poses import PoseSource
from cfplan.flight.pilot.abort_monitor import Abort
from cfplan.flight.pilot.deadlines import Lateness
from cfplan.flight.pilot.flight_loop import REPLY, TRIES, AbortRaised, FlightLoop, LinkLost, OrderSource
from cfplan.flight.pilot.mission import Mission, manoeuvre_time
from cfplan.flight.pilot.outcome import Deviation, FlightOutcome, Rung, settle_time
from cfplan.flight.pilot.prearm import prepare
from cfplan.flight.pilot.stream import Stream
from cfplan.flight.radio.link import GO_TO, LAND, TAKE_OFF, Link
from cfplan.flight.radio.supervisor_bits import ARMED, FLYING, HIGH_LEVEL_ACTIVE, LOCKED
from cfplan.flight.setpoints.hover_to_hover import encode_hover_to_hover
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.flight.telemetry import Level, Phase, Telemetry, Triple
from cfplan.vehicle.rotations import yaw_of

SETTLED_WITHIN = 0.03  # m, from where the motion ended
_AT_START_WITHIN = 0.06  # m
_AT_START_FOR = 0.5  # s
_BEHIND = 0.15  # m from its setpoint, from where on a stop begins where the vehicle is
_BRAKE_HOLD = 1.0  # s of hover after a stop
_ON_THE_FLOOR = 0.15  # m above where it took off
_BELOW_FLOOR = 0.03  # m that landings aim below it, so that motors stop on the floor and not above
_BLIND_LAND_SPEED = 0.6  # m/s, mean, at least: without poses the vehicle drifts half a metre in 2 s
_TOUCH = 0.3  # s on the floor before motors stop
_MOTORS_STOPPED = 4.0  # s; the vehicle calls itself landed 2 s after they did
_ASKED_TO_RISE, _RISEN = 0.12, 0.015  # m above the floor: asked for the first, its pose must have reached the second
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
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self._mission, self._limits = mission, mission.limits
        self._connect, self._enter_real_time = connect, enter_real_time
        self._loop = FlightLoop(mission, source, report, orders, clock, sleep)
        self._reached = Rung.NONE  # how far down the abort ladder
        self._skipped = 0
        self._stopped_at = 0.0  # s, when the plan was left for a stop

    def fly(self) -> FlightOutcome:
        """All phases. Raises a CfplanError where the vehicle or its poses cannot be had; nothing is armed then."""
        loop = self._loop
        try:
            exit_code, reason = self._fly()
        except LinkLost:
            exit_code, reason = ExitCode.LINK_LOST, f"the link was lost: {loop.link.lost or 'the log fell silent'}"
            loop.say(Level.ERROR, reason)
        finally:
            self._finish()
        return self._outcome(exit_code, reason)

    def _fly(self) -> tuple[ExitCode, str]:
        loop = self._loop
        try:
            prepare(loop, self._connect, self._enter_real_time)
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
            if not loop.checks:
                raise
            return error.exit_code, str(error)
        except Exception as error:  # a fault of this program must not end in the air
            if not loop.airborne:
                raise
            return self._leave_plan(_safety(Rung.LAND, f"fault in the pilot: {error!r}"))
        return ExitCode.OK, "landed"

    def _take_off(self) -> None:
        """Up by setpoints, once the on-board commander has said that it would: it knows whether the vehicle may fly.

        In its hands the vehicle would hover on without this program or its poses, wherever that leads; while setpoints
        come, its own time-outs hold.
        """
        loop = self._loop
        loop.enter(Phase.TAKE_OFF)
        height, (x, y, _) = self._mission.take_off_height, loop.pose().position
        yaw, climb = yaw_of(loop.pose().quaternion), height - loop.floor
        duration = manoeuvre_time(climb, self._limits.ground.take_off_speed)
        way = self._way((x, y, loop.floor), yaw, (x, y, height), yaw, duration)
        if way.stop_from is not None:
            way.stop_from(0)  # whatever is slow the first time is slow here, on the ground
        code = loop.ask(lambda: loop.link.take_off(height, duration), TAKE_OFF)
        if code:
            raise PreflightError(
                f"the vehicle refuses to take off (code {code})", hint="restart the vehicle, and look at its battery"
            )
        loop.airborne = True
        self._begin(way)
        if loop.until(lambda: loop.now() > way.end or self._pose_stays(way), math.inf) and self._pose_stays(way):
            self._stay_down()
        loop.until(lambda: abs(loop.pose().position[2] - height) < _AT_START_WITHIN, 2.0)
        if loop.pose().position[2] - loop.floor < climb / 2:
            raise AbortRaised(_safety(Rung.LAND, "the vehicle does not rise"))

    def _pose_stays(self, way: Stream) -> bool:
        """Whether the tracked body stays on the floor while the vehicle must rise.

        Nothing on the ground tells the vehicle from another body that stands still as well. By the pose of that one its
        controller would climb with all its thrust.
        """
        loop = self._loop
        pose = loop.pose()
        asked = way.position(pose.time - self._mission.lead)[2]
        return asked - loop.floor > _ASKED_TO_RISE and pose.position[2] - loop.floor < _RISEN

    def _stay_down(self) -> None:
        """Motors off, a quarter of a metre up at most."""
        self._stop_motors()
        self._loop.airborne = False
        self._motors_stop()
        raise PreflightError(
            "the tracked body stays on the floor while the vehicle takes off",
            where="motion capture",
            hint="is it another body than the vehicle, are two of them swapped? Else look at battery and propellers",
        )

    def _way(self, begin: Triple, yaw: float, end: Triple, end_yaw: float, duration: float) -> Stream:
        """From hover to hover, with a way to stop from each setpoint."""
        rate = self._mission.rate
        payloads = encode_hover_to_hover(begin, yaw, end, end_yaw, duration, rate)
        return Stream(payloads, rate, stop_from=lambda row: encode_stops(payloads, rate, rows=np.array([row]))[0])

    def _begin(self, way: Stream) -> None:
        way.start = self._loop.deadlines.upcoming
        self._loop.stream = way

    def _follow(self, way: Stream) -> None:
        self._begin(way)
        self._loop.until(lambda: self._loop.now() > way.end, math.inf)

    def _go_to_start(self) -> None:
        loop = self._loop
        loop.enter(Phase.GO_TO_START)
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
            raise AbortRaised(_safety(Rung.LAND, f"still {away:.2f} m from the start"))

    def _fly_plan(self) -> None:
        loop = self._loop
        loop.enter(Phase.STREAM)
        skipped = loop.deadlines.skipped
        loop.plan.start = loop.deadlines.upcoming
        loop.stream = loop.plan
        loop.until(lambda: loop.now() > loop.plan.end, math.inf)
        self._skipped = loop.deadlines.skipped - skipped
        loop.enter(Phase.HOLD)
        loop.pause(self._mission.hold_time)

    def _hand_back(self) -> None:
        loop = self._loop
        loop.enter(Phase.HAND_BACK)
        end, yaw = self._mission.end
        if self._hand_over(lambda: loop.link.go_to(end, yaw, 1.0), GO_TO):
            loop.pause(1.0)

    def _hand_over(self, command: Callable[[], None], number: int) -> bool:
        """From the stream to the on-board commander; whether it takes over. Where not, the stream goes on.

        A setpoint would undo the command, so none is sent meanwhile.
        """
        loop = self._loop
        for _ in range(TRIES):
            loop.sending_paused = True
            code = loop.ask(command, number, tries=1)
            if code == 0:
                break
            loop.sending_paused = False  # hover on while asking again
            loop.pause(0.05)
        else:
            loop.say(Level.WARNING, f"the on-board commander does not take over (code {code})")
            return False
        loop.stream, loop.sending_paused = None, False
        for _ in range(TRIES):
            loop.link.release_priority()
            if loop.until(lambda: bool(loop.bits(HIGH_LEVEL_ACTIVE)), REPLY):
                break
        return True

    def _land(self) -> None:
        """Down, where it is, until the vehicle says that it no longer flies."""
        self._loop.enter(Phase.LAND)
        for _ in range(TRIES):
            if self._touch_down():
                self._loop.airborne = False
                return
        raise AbortRaised(_safety(Rung.CUT, "the vehicle does not land"))

    def _touch_down(self) -> bool:
        loop = self._loop
        height = max(loop.pose().position[2] - loop.floor, 0.0)
        blind = loop.now() - loop.pose().time > self._limits.pose.age_brake
        speed = max(self._limits.ground.land_speed, _BLIND_LAND_SPEED if blind else 0.0)
        duration = manoeuvre_time(height, speed)

        def land() -> None:
            loop.link.land(loop.floor - _BELOW_FLOOR, duration)

        if not self._commanded(land):
            self._descend(duration)
            return self._motors_stop()
        loop.pause(duration)
        if self._motors_stop():
            return True
        if loop.pose().position[2] - loop.floor > _ON_THE_FLOOR:
            return False
        loop.say(Level.WARNING, "on the floor with turning motors: stopping them")
        loop.link.stop_motors()
        return self._motors_stop()

    def _commanded(self, land: Callable[[], None]) -> bool:
        """Whether the on-board commander lands; one that does not answer may."""
        if self._loop.stream is not None:
            return self._hand_over(land, LAND)
        return not self._loop.ask(land, LAND)

    def _descend(self, duration: float) -> None:
        """Down by setpoints from where it hovers, and motors off at the end."""
        loop = self._loop
        place, quaternion = loop.resting()
        yaw = yaw_of(quaternion)
        self._follow(self._way(place, yaw, (*place[:2], loop.floor - _BELOW_FLOOR), yaw, duration))
        loop.pause(_TOUCH)
        self._stop_motors()

    def _stop_motors(self) -> None:
        """By setpoints: none but these are sent any more."""
        loop = self._loop
        loop.stream = None
        for _ in range(TRIES):
            loop.link.stop_setpoint()
            loop.pause(0.02)
        loop.link.release_priority()

    def _motors_stop(self) -> bool:
        return self._loop.until(lambda: not self._loop.bits(FLYING), _MOTORS_STOPPED)

    # The abort ladder.

    def _leave_plan(self, abort: Abort) -> tuple[ExitCode, str]:
        """Down the ladder, to the ground; how the flight counts, and why."""
        loop = self._loop
        exit_code, reasons = abort.exit_code, [abort.text]
        while True:
            loop.rung = self._reached = max(loop.rung, abort.rung)
            loop.sending_paused = False
            level = Level.ERROR if abort.rung is Rung.CUT else Level.WARNING
            loop.say(level, f"{abort.rung.name.lower()}: {abort.text}")
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
                abort = _safety(Rung.CUT, f"fault in the pilot: {error!r}")
            reasons.append(abort.text)

    def _brake(self) -> None:
        self._stop()
        self._loop.enter(Phase.HOLD)
        self._loop.pause(_BRAKE_HOLD)
        self._land()

    def _stop_and_land(self) -> None:
        self._stop()
        self._land()

    def _stop(self) -> None:
        """Along the path to a hover, or to the end of a stop that has begun; without a stream it is slow already."""
        loop = self._loop
        left = loop.stream
        if left is not None and left.stop_from is not None:
            stop = left.stop_from(self._present_index(left))
            loop.stream = Stream(stop, self._mission.rate, loop.deadlines.upcoming)
            if left is loop.plan:
                self._stopped_at = loop.stream.start
        if loop.stream is not None:
            end = loop.stream.end
            loop.until(lambda: loop.now() > end, math.inf)

    def _present_index(self, stream: Stream) -> int:
        """The setpoint from which to stop: that of the moment, or the nearest before it if the vehicle fell behind."""
        loop = self._loop
        due = stream.index(loop.now())
        pose = loop.pose()
        if loop.now() - pose.time > self._limits.pose.age_warning:
            return due
        lead = self._mission.lead
        if math.dist(pose.position, stream.position(pose.time - lead)) < _BEHIND:
            return due
        nearest, least = due, math.inf
        for index in range(due, -1, -1):
            distance = math.dist(pose.position, stream.states[index][0])
            if distance < least:
                nearest, least = index, distance
            elif distance > least + _BEHIND:  # what comes nearer again is another turn of the path
                break
        return nearest

    def _cut(self) -> None:
        """Again with every tick until the vehicle says that it is locked: a radio may lose the first ones."""
        loop = self._loop
        loop.stream = None

        def locked() -> bool:
            loop.link.emergency_stop()
            return bool(loop.bits(LOCKED))

        if not locked() and not loop.until(locked, _LOCKED_WITHIN):
            loop.say(Level.ERROR, "the vehicle does not say that its motors were cut")
        loop.airborne = False

    # The end.

    def _finish(self) -> None:
        """Disarm and close, on the ground; in the air only a lost link brings the pilot here, and it closes nothing."""
        loop = self._loop
        if loop.connected and not loop.airborne:
            loop.enter(Phase.DISARM)
            loop.rung, loop.stream = Rung.CUT, None  # nothing ends what is over
            try:
                for _ in range(TRIES):
                    loop.link.arm(False)
                    if loop.until(lambda: not loop.bits(ARMED), 0.2):
                        break
            except (LinkLost, AbortRaised):
                loop.say(Level.WARNING, "the link went before the vehicle was disarmed")
            loop.link.close()
        if loop.feeding:
            loop.source.close()
        loop.enter(Phase.CLOSED)

    def _outcome(self, exit_code: ExitCode, reason: str) -> FlightOutcome:
        loop = self._loop
        start, ends = loop.plan.start, self._mission.motion_ends + self._mission.lead
        moved = min((self._stopped_at or loop.now()) - start, ends) if start else 0.0
        return FlightOutcome(
            exit_code=exit_code,
            reason=reason,
            rung=self._reached,
            checks=loop.checks,
            phases=tuple(loop.phases),
            first_setpoint=start,
            flown=moved,
            lateness=Lateness.of(loop.late, self._skipped),
            deviation=Deviation.of([sample for sample in loop.off_plan if sample[0] <= ends]),
            settled_after=settle_time([(t - ends, off) for t, off in loop.off_plan if t > ends], SETTLED_WITHIN),
            end_position=loop.recent[-1].position if loop.recent else (math.nan, math.nan, math.nan),
        )


def _safety(rung: Rung, text: str) -> Abort:
    return Abort(rung, ExitCode.ENDED_BY_SAFETY, text)
