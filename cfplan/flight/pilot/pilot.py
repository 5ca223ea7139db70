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
from cfplan.flight.pilot.abort_monitor import Trip
from cfplan.flight.pilot.deadlines import Lateness
from cfplan.flight.pilot.flight_loop import REPLY, TRIES, Cockpit, LinkLost, OrdersFrom, Tripped
from cfplan.flight.pilot.mission import Mission, manoeuvre_time, yaw_of
from cfplan.flight.pilot.outcome import Deviation, FlightOutcome, Rung, settle_time
from cfplan.flight.pilot.prearm import prepare
from cfplan.flight.pilot.stream import Stream
from cfplan.flight.radio.link import GO_TO, LAND, TAKE_OFF, Link
from cfplan.flight.radio.supervisor_bits import ARMED, FLYING, HIGH_LEVEL_ACTIVE, LOCKED
from cfplan.flight.setpoints.hover_to_hover import encode_transfer
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.flight.telemetry import Level, Phase, Telemetry, Triple

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
        orders: OrdersFrom,
        enter_real_time: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self._mission, self._limits = mission, mission.limits
        self._connect, self._enter_real_time = connect, enter_real_time
        self._cockpit = Cockpit(mission, source, report, orders, clock, sleep)
        self._reached = Rung.NONE
        # how far down the abort ladder
        self._skipped = 0
        self._stopped_at = 0.0
        # s, when the plan was left for a stop

    def fly(self) -> FlightOutcome:
        """All phases. Raises a CfplanError where the vehicle or its poses cannot be had; nothing is armed then."""
        cockpit = self._cockpit
        try:
            exit_code, reason = self._fly()
        except LinkLost:
            exit_code, reason = ExitCode.LINK_LOST, f"the link was lost: {cockpit.link.lost or 'the log fell silent'}"
            cockpit.say(Level.ERROR, reason)
        finally:
            self._finish()
        return self._outcome(exit_code, reason)

    def _fly(self) -> tuple[ExitCode, str]:
        cockpit = self._cockpit
        try:
            prepare(cockpit, self._connect, self._enter_real_time)
            self._take_off()
            self._go_to_start()
            self._fly_plan()
            self._hand_back()
            self._land()
        except Tripped as tripped:
            return self._leave_plan(tripped.trip)
        except LinkLost:
            raise
        except CfplanError as error:
            if not cockpit.checks:
                raise
            return error.exit_code, str(error)
        except Exception as error:  # a fault of this program must not end in the air
            if not cockpit.airborne:
                raise
            return self._leave_plan(_safety(Rung.LAND, f"fault in the pilot: {error!r}"))
        return ExitCode.OK, "landed"

    def _take_off(self) -> None:
        """Up by setpoints, once the on-board commander has said that it would: it knows whether the vehicle may fly.

        In its hands the vehicle would hover on without this program or its poses, wherever that leads; while setpoints
        come, its own time-outs hold.
        """
        cockpit = self._cockpit
        cockpit.enter(Phase.TAKE_OFF)
        height, (x, y, _) = self._mission.take_off_height, cockpit.pose().position
        yaw, climb = yaw_of(cockpit.pose().quaternion), height - cockpit.floor
        duration = manoeuvre_time(climb, self._limits.ground.take_off_speed)
        way = self._way((x, y, cockpit.floor), yaw, (x, y, height), yaw, duration)
        if way.stop_from is not None:
            way.stop_from(0)  # whatever is slow the first time is slow here, on the ground
        code = cockpit.ask(lambda: cockpit.link.take_off(height, duration), TAKE_OFF)
        if code:
            raise PreflightError(
                f"the vehicle refuses to take off (code {code})", hint="restart the vehicle, and look at its battery"
            )
        cockpit.airborne = True
        self._begin(way)
        if cockpit.until(lambda: cockpit.now() > way.end or self._pose_stays(way), math.inf) and self._pose_stays(way):
            self._stay_down()
        cockpit.until(lambda: abs(cockpit.pose().position[2] - height) < _AT_START_WITHIN, 2.0)
        if cockpit.pose().position[2] - cockpit.floor < climb / 2:
            raise Tripped(_safety(Rung.LAND, "the vehicle does not rise"))

    def _pose_stays(self, way: Stream) -> bool:
        """Whether the tracked body stays on the floor while the vehicle must rise.

        Nothing on the ground tells the vehicle from another body that stands still as well. By the pose of that one its
        controller would climb with all its thrust.
        """
        cockpit = self._cockpit
        pose = cockpit.pose()
        asked = way.position(pose.time - self._mission.lead)[2]
        return asked - cockpit.floor > _ASKED_TO_RISE and pose.position[2] - cockpit.floor < _RISEN

    def _stay_down(self) -> None:
        """Motors off, a quarter of a metre up at most."""
        self._stop_motors()
        self._cockpit.airborne = False
        self._motors_stop()
        raise PreflightError(
            "the tracked body stays on the floor while the vehicle takes off",
            where="motion capture",
            hint="is it another body than the vehicle, are two of them swapped? Else look at battery and propellers",
        )

    def _way(self, begin: Triple, yaw: float, end: Triple, end_yaw: float, duration: float) -> Stream:
        """From hover to hover, with a way to stop from each setpoint."""
        rate = self._mission.rate
        payloads = encode_transfer(begin, yaw, end, end_yaw, duration, rate)
        return Stream(payloads, rate, stop_from=lambda row: encode_stops(payloads, rate, rows=np.array([row]))[0])

    def _begin(self, way: Stream) -> None:
        way.start = self._cockpit.pace.upcoming
        self._cockpit.stream = way

    def _follow(self, way: Stream) -> None:
        self._begin(way)
        self._cockpit.until(lambda: self._cockpit.now() > way.end, math.inf)

    def _go_to_start(self) -> None:
        cockpit = self._cockpit
        cockpit.enter(Phase.GO_TO_START)
        start, yaw = self._mission.start
        (above, quaternion), here = cockpit.resting(), cockpit.pose().position
        duration = manoeuvre_time(math.dist(here, start), self._limits.ground.go_to_speed)
        self._follow(self._way(above, yaw_of(quaternion), start, yaw, duration))
        near_since = math.inf

        def settled() -> bool:
            nonlocal near_since
            now = cockpit.now()
            near = math.dist(cockpit.pose().position, start) < _AT_START_WITHIN
            near_since = min(near_since, now) if near else math.inf
            return now - near_since > _AT_START_FOR

        if not cockpit.until(settled, 5.0):
            away = math.dist(cockpit.pose().position, start)
            raise Tripped(_safety(Rung.LAND, f"still {away:.2f} m from the start"))

    def _fly_plan(self) -> None:
        cockpit = self._cockpit
        cockpit.enter(Phase.STREAM)
        skipped = cockpit.pace.skipped
        cockpit.plan.start = cockpit.pace.upcoming
        cockpit.stream = cockpit.plan
        cockpit.until(lambda: cockpit.now() > cockpit.plan.end, math.inf)
        self._skipped = cockpit.pace.skipped - skipped
        cockpit.enter(Phase.HOLD)
        cockpit.pause(self._mission.hold_time)

    def _hand_back(self) -> None:
        cockpit = self._cockpit
        cockpit.enter(Phase.HAND_BACK)
        end, yaw = self._mission.end
        if self._hand_over(lambda: cockpit.link.go_to(end, yaw, 1.0), GO_TO):
            cockpit.pause(1.0)

    def _hand_over(self, command: Callable[[], None], number: int) -> bool:
        """From the stream to the on-board commander; whether it takes over. Where not, the stream goes on.

        A setpoint would undo the command, so none is sent meanwhile.
        """
        cockpit = self._cockpit
        for _ in range(TRIES):
            cockpit.muted = True
            code = cockpit.ask(command, number, tries=1)
            if code == 0:
                break
            cockpit.muted = False  # hover on while asking again
            cockpit.pause(0.05)
        else:
            cockpit.say(Level.WARNING, f"the on-board commander does not take over (code {code})")
            return False
        cockpit.stream, cockpit.muted = None, False
        for _ in range(TRIES):
            cockpit.link.release_priority()
            if cockpit.until(lambda: bool(cockpit.bits(HIGH_LEVEL_ACTIVE)), REPLY):
                break
        return True

    def _land(self) -> None:
        """Down, where it is, until the vehicle says that it no longer flies."""
        self._cockpit.enter(Phase.LAND)
        for _ in range(TRIES):
            if self._touch_down():
                self._cockpit.airborne = False
                return
        raise Tripped(_safety(Rung.CUT, "the vehicle does not land"))

    def _touch_down(self) -> bool:
        cockpit = self._cockpit
        height = max(cockpit.pose().position[2] - cockpit.floor, 0.0)
        blind = cockpit.now() - cockpit.pose().time > self._limits.pose.age_brake
        speed = max(self._limits.ground.land_speed, _BLIND_LAND_SPEED if blind else 0.0)
        duration = manoeuvre_time(height, speed)

        def land() -> None:
            cockpit.link.land(cockpit.floor - _BELOW_FLOOR, duration)

        if not self._commanded(land):
            self._descend(duration)
            return self._motors_stop()
        cockpit.pause(duration)
        if self._motors_stop():
            return True
        if cockpit.pose().position[2] - cockpit.floor > _ON_THE_FLOOR:
            return False
        cockpit.say(Level.WARNING, "on the floor with turning motors: stopping them")
        cockpit.link.stop_motors()
        return self._motors_stop()

    def _commanded(self, land: Callable[[], None]) -> bool:
        """Whether the on-board commander lands; one that does not answer may."""
        if self._cockpit.stream is not None:
            return self._hand_over(land, LAND)
        return not self._cockpit.ask(land, LAND)

    def _descend(self, duration: float) -> None:
        """Down by setpoints from where it hovers, and motors off at the end."""
        cockpit = self._cockpit
        place, quaternion = cockpit.resting()
        yaw = yaw_of(quaternion)
        self._follow(self._way(place, yaw, (*place[:2], cockpit.floor - _BELOW_FLOOR), yaw, duration))
        cockpit.pause(_TOUCH)
        self._stop_motors()

    def _stop_motors(self) -> None:
        """By setpoints: none but these are sent any more."""
        cockpit = self._cockpit
        cockpit.stream = None
        for _ in range(TRIES):
            cockpit.link.stop_setpoint()
            cockpit.pause(0.02)
        cockpit.link.release_priority()

    def _motors_stop(self) -> bool:
        return self._cockpit.until(lambda: not self._cockpit.bits(FLYING), _MOTORS_STOPPED)

    # The abort ladder.

    def _leave_plan(self, trip: Trip) -> tuple[ExitCode, str]:
        """Down the ladder, to the ground; how the flight counts, and why."""
        cockpit = self._cockpit
        exit_code, reasons = trip.exit_code, [trip.text]
        while True:
            cockpit.rung = self._reached = max(cockpit.rung, trip.rung)
            cockpit.muted = False
            level = Level.ERROR if trip.rung is Rung.CUT else Level.WARNING
            cockpit.say(level, f"{trip.rung.name.lower()}: {trip.text}")
            try:
                if cockpit.airborne:
                    {Rung.BRAKE: self._brake, Rung.LAND: self._stop_and_land, Rung.CUT: self._cut}[trip.rung]()
                return exit_code, ", then ".join(reasons)
            except Tripped as graver:
                trip = graver.trip
            except LinkLost:
                raise
            except Exception as error:  # where landing breaks, only cutting is left
                if trip.rung is Rung.CUT:
                    raise
                trip = _safety(Rung.CUT, f"fault in the pilot: {error!r}")
            reasons.append(trip.text)

    def _brake(self) -> None:
        self._stop()
        self._cockpit.enter(Phase.HOLD)
        self._cockpit.pause(_BRAKE_HOLD)
        self._land()

    def _stop_and_land(self) -> None:
        self._stop()
        self._land()

    def _stop(self) -> None:
        """Along the path to a hover, or to the end of a stop that has begun; without a stream it is slow already."""
        cockpit = self._cockpit
        left = cockpit.stream
        if left is not None and left.stop_from is not None:
            stop = left.stop_from(self._present_index(left))
            cockpit.stream = Stream(stop, self._mission.rate, cockpit.pace.upcoming)
            if left is cockpit.plan:
                self._stopped_at = cockpit.stream.start
        if cockpit.stream is not None:
            end = cockpit.stream.end
            cockpit.until(lambda: cockpit.now() > end, math.inf)

    def _present_index(self, stream: Stream) -> int:
        """The setpoint from which to stop: that of the moment, or the nearest before it if the vehicle fell behind."""
        cockpit = self._cockpit
        due = stream.index(cockpit.now())
        pose = cockpit.pose()
        if cockpit.now() - pose.time > self._limits.pose.age_warning:
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
        cockpit = self._cockpit
        cockpit.stream = None

        def locked() -> bool:
            cockpit.link.emergency_stop()
            return bool(cockpit.bits(LOCKED))

        if not locked() and not cockpit.until(locked, _LOCKED_WITHIN):
            cockpit.say(Level.ERROR, "the vehicle does not say that its motors were cut")
        cockpit.airborne = False

    # The end.

    def _finish(self) -> None:
        """Disarm and close, on the ground; in the air only a lost link brings the pilot here, and it closes nothing."""
        cockpit = self._cockpit
        if cockpit.connected and not cockpit.airborne:
            cockpit.enter(Phase.DISARM)
            cockpit.rung, cockpit.stream = Rung.CUT, None  # nothing ends what is over
            try:
                for _ in range(TRIES):
                    cockpit.link.arm(False)
                    if cockpit.until(lambda: not cockpit.bits(ARMED), 0.2):
                        break
            except (LinkLost, Tripped):
                cockpit.say(Level.WARNING, "the link went before the vehicle was disarmed")
            cockpit.link.close()
        if cockpit.feeding:
            cockpit.source.close()
        cockpit.enter(Phase.CLOSED)

    def _outcome(self, exit_code: ExitCode, reason: str) -> FlightOutcome:
        cockpit = self._cockpit
        start, ends = cockpit.plan.start, self._mission.motion_ends + self._mission.lead
        moved = min((self._stopped_at or cockpit.now()) - start, ends) if start else 0.0
        return FlightOutcome(
            exit_code=exit_code,
            reason=reason,
            rung=self._reached,
            checks=cockpit.checks,
            phases=tuple(cockpit.phases),
            first_setpoint=start,
            flown=moved,
            lateness=Lateness.of(cockpit.late, self._skipped),
            deviation=Deviation.of([sample for sample in cockpit.off_plan if sample[0] <= ends]),
            settled_after=settle_time([(t - ends, off) for t, off in cockpit.off_plan if t > ends], SETTLED_WITHIN),
            end_position=cockpit.recent[-1].position if cockpit.recent else (math.nan, math.nan, math.nan),
        )


def _safety(rung: Rung, text: str) -> Trip:
    return Trip(rung, ExitCode.ENDED_BY_SAFETY, text)
