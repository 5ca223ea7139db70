"""The landing: down by setpoints, and motors off once the vehicle stands.

The vehicle is never handed to its on-board commander, which has no time-out: a vehicle flown by setpoints whose pilot
or radio dies levels out after 0.5 s and stops its motors after a second, at any height.

The setpoints continue below the floor. A vehicle that no longer follows them is standing, perhaps on a box or lower
than its take-off position, and its motors are stopped. Without poses only its own estimate is left, whose height error
grows with the square of time; so the vehicle descends as fast as it may touch the floor. Its estimate still shows the
touchdown. If neither that nor a pose arrives in time, the motors stop wherever the vehicle is: it falls, but does not
fly away. If poses stop when its setpoint is already on the floor, the motors stop at once, as with a wrong estimate the
vehicle would fly off.
"""

import math
from collections.abc import Callable

from cfplan.flight.pilot.abort_monitor import FALLEN
from cfplan.flight.pilot.abort_reasons import AbortReason
from cfplan.flight.pilot.flight_loop import ATTEMPTS, AbortRaised, FlightLoop
from cfplan.flight.pilot.health import FRESH, Descent
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.pilot.stream import Stream
from cfplan.flight.radio.supervisor_bits import FLYING
from cfplan.flight.setpoints.descent import MIN_HEIGHT_ASIDE, QUICK, Pace, descent, gentle, off_walls, sinking
from cfplan.flight.telemetry import Level, Phase, Triple

_DEPTH_BELOW_FLOOR = 0.3  # m below the take-off position and below the space, where setpoints end
_NEAR_FLOOR = 0.15  # m above the take-off position
_STANDING_GAP = 0.05  # m above its setpoint, from which a vehicle near the floor counts as standing
_NO_THRUST_GAP = (
    0.25  # m above its setpoint: the controller commands no thrust, so a vehicle that does not fall is standing
)
_AT_REST_FOR, _AT_REST_WITHIN = (
    0.08,
    0.02,
)  # s and m: poses this near to the take-off position show that it is on the floor
_STANDS_FOR = 0.3  # s
_STANDS_WITHIN = 0.015  # m, range of the heights of a standing body's poses
_SETTLE_TIME = 0.3  # s at the end of a descent before the motors stop
_BLIND_DEPTH_BELOW_FLOOR = 2.0  # m below the floor, where setpoints end without poses, later than MAX_BLIND_LANDING
MAX_BLIND_LANDING = 3.0  # s without poses until the motors stop, as the estimate may be wrong by metres
_MIN_SINKING_HEIGHT = 0.4  # m above the floor, below which a braking vehicle does not sink
POSES_TRUSTED_AFTER = 0.2  # s of fresh poses until they are trusted again
MOTORS_STOP_TIMEOUT = 2.5  # s; the vehicle reports that it no longer flies 2 s after its motors stopped
_RETRY_PERIOD = 0.05  # s
_ESTIMATE_DEPTH = 0.3  # m below the floor, where the estimate must be wrong
_IDLE_FOR = 0.2  # s without thrust; no descent commands that


class Landing:
    """Lands once. If an abort interrupts it, the next call of `land` continues."""

    def __init__(self, loop: FlightLoop, floor: float):
        self._loop, self._floor = loop, floor  # m, height of the tracked body on the floor
        self.begun = False
        self._stands = False
        self._was_blind = False  # setpoints may be far from the vehicle
        self._idle_since = math.inf  # s, since when the controller has commanded no thrust

    def begin(self) -> None:
        """Enter the phase, once."""
        if not self.begun:
            self.begun = True
            self._loop.history.enter(Phase.LAND)

    def sink_while_stopping(self) -> None:
        """Begin while the vehicle still brakes: let the rest of the stop also sink and move away from the walls."""
        self.begin()
        loop, stream = self._loop, self._loop.stream
        if stream is not None:
            left = stream.payloads[stream.index(loop.now()) - stream.first :]
            low = loop.setpoint_now()[0][2] - self._floor < MIN_HEIGHT_ASIDE  # as at the beginning of a take-off
            aside = _not_aside if low else self._aside
            sinks = sinking(left, self._floor + _MIN_SINKING_HEIGHT, QUICK.speed, stream.rate, aside)
            loop.begin(Stream(sinks, stream.rate))

    def land(self) -> None:
        """Descend from the present setpoint, and stop the motors. Raises AbortRaised if they do not stop."""
        self.begin()
        self._stands |= self._loop.stream is None  # its motors are already being stopped, on the floor
        while not self._stands:
            if self._loop.descent is Descent.HELD:
                self._loop.hold_where_it_is()
                self._loop.pause(_RETRY_PERIOD)
            elif self._blind_on_floor():
                self._conclude(True)
            elif self._loop.descent is Descent.BLIND:
                self._descend_blindly()
            else:
                self._descend()
        if not stop_motors(self._loop):
            raise AbortRaised(AbortReason.MOTORS_DO_NOT_STOP.abort(Rung.CUT))
        self._loop.touch_down()

    def _descend(self) -> None:
        """Sink until the vehicle stands or poses are gone; from the last pose if they have just returned."""
        loop = self._loop
        lowest = min(self._floor, loop.limits.space.low[2]) - _DEPTH_BELOW_FLOOR
        pace = gentle(loop.limits.ground.land_speed)
        self._sink(loop.tracked_state() if self._was_blind else loop.setpoint_now(), pace, lowest)
        self._was_blind = False

        def interrupted() -> bool:
            return self._blind_on_floor() or loop.descent is not Descent.BY_POSES

        def stands() -> bool:
            return stands_by_poses(loop, self._floor, _NO_THRUST_GAP) or self._at_take_off_place()

        loop.until(lambda: stands() or self._setpoint_at_end() or interrupted(), math.inf)
        if not interrupted():
            self._conclude(stands())

    def _descend_blindly(self) -> None:
        """Sink quickly and away from the walls, until the estimate shows touchdown, time is up, or poses are back."""
        loop = self._loop
        begin = loop.setpoint_now()
        self._sink(begin, QUICK, self._floor - _BLIND_DEPTH_BELOW_FLOOR, self._aside(begin[0]))
        self._was_blind = True
        fresh_since = math.inf

        def poses_back() -> bool:
            nonlocal fresh_since
            fresh_since = min(fresh_since, loop.now()) if loop.health.poses is FRESH else math.inf
            return loop.now() - fresh_since > POSES_TRUSTED_AFTER

        def over() -> bool:
            return self._setpoint_at_end() or loop.time_without_poses > MAX_BLIND_LANDING or self._beneath_floor()

        def interrupted() -> bool:
            return poses_back() or loop.descent is Descent.HELD

        loop.until(lambda: self._stands_by_estimate() or over() or interrupted(), math.inf)
        if not interrupted():
            self._conclude(self._stands_by_estimate())

    def _aside(self, place: Triple) -> tuple[float, float]:
        """Return the displacement, m, of a descent without poses: away from walls, but not in a fleet.

        Another vehicle may be there, and the fleet is certified for vehicles that come straight down.
        """
        return (0.0, 0.0) if self._loop.conducted else off_walls(place, self._loop.limits.space)

    def _sink(
        self,
        begin: tuple[Triple, Triple, float],
        pace: Pace,
        lowest: float,
        aside: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Send a descent from a position, m, velocity, m/s, and yaw, rad, to a height, m, that goes `aside`, m."""
        loop, (position, velocity, yaw) = self._loop, begin
        rate = loop.mission.rate
        sinks = descent(
            position, yaw, -velocity[2], pace, self._floor, lowest, limits=loop.limits, rate=rate, aside=aside
        )
        loop.begin(Stream(sinks, rate))

    def _at_take_off_place(self) -> bool:
        """Return whether poses show the vehicle on the floor, far below its setpoint: it fell there.

        Its estimate still contains the fall, so it would fly off when a setpoint lifts it again.
        """
        heights = self._loop.heights(_AT_REST_FOR)
        on_floor = bool(heights) and max(heights) - self._floor < _AT_REST_WITHIN
        return on_floor and self._loop.setpoint_now()[0][2] - self._floor > FALLEN

    def _setpoint_at_end(self) -> bool:
        stream = self._loop.stream
        return stream is None or self._loop.now() > stream.end + _SETTLE_TIME

    def _blind_on_floor(self) -> bool:
        """Return whether good poses are missing while the setpoint, reached with poses, is on the floor."""
        loop = self._loop
        if loop.stream is None or self._was_blind or loop.descent is Descent.HELD:
            return False
        return loop.health.poses is not FRESH and loop.setpoint_now()[0][2] < self._floor

    def _conclude(self, shown: bool) -> None:
        self._stands = True
        if not shown:
            self._loop.history.add_event(Level.WARNING, "touchdown is not confirmed; the motors are stopped")

    def _beneath_floor(self) -> bool:
        """Return whether the vehicle's estimate is far below the floor, from where it would climb.

        It stands then, after a fall that its sensors did not follow, or is low. Where its log is silent, the setpoint
        shows it: the estimate of a vehicle that stands blind and unheard sinks on until it flies off.
        """
        loop, lowest = self._loop, self._floor - _ESTIMATE_DEPTH
        if loop.estimate is not None and loop.estimate.position[2] < lowest:
            return True
        return loop.health.estimate is not FRESH and loop.setpoint_now()[0][2] < lowest

    def _stands_by_estimate(self) -> bool:
        """Return whether the vehicle stands, as its estimate is far above its setpoint, or its motors have been off.

        After a touchdown at a tilt the estimate may be anything, but the controller then commands no thrust.
        """
        loop, estimate, status = self._loop, self._loop.estimate, self._loop.status
        if status is not None:
            self._idle_since = min(self._idle_since, status.time) if not any(status.motor) else math.inf
            if status.time - self._idle_since > _IDLE_FOR:
                return True
        if estimate is None or loop.health.estimate is not FRESH:
            return False
        setpoint_position = loop.setpoint_position(estimate.time)
        return setpoint_position is not None and estimate.position[2] - setpoint_position[2] > _NO_THRUST_GAP


def _not_aside(place: Triple) -> tuple[float, float]:
    """Return no displacement, m: straight down."""
    return 0.0, 0.0


def stands_by_poses(loop: FlightLoop, floor: float, not_held: float = math.inf) -> bool:
    """Return whether the tracked body stays where it is although its setpoint has sunk on.

    It must be `not_held`, m, above its setpoint; near the `floor`, m, less is enough.
    """
    pose = loop.pose()
    setpoint_position, heights = loop.setpoint_position(pose.time), loop.heights(_STANDS_FOR)
    if setpoint_position is None or not heights or max(heights) - min(heights) > _STANDS_WITHIN:
        return False
    height = pose.position[2]
    near = height - floor < _NEAR_FLOOR
    return height - setpoint_position[2] > (_STANDING_GAP if near else not_held)


def stop_motors(loop: FlightLoop) -> bool:
    """Stop the motors by stop setpoints, the last setpoints sent; return whether the vehicle confirms it.

    Afterwards the vehicle's own null setpoints must take over, or its supervisor would lock.
    """

    def send() -> None:
        for _ in range(ATTEMPTS):
            loop.link.stop_setpoint()
            loop.pause(0.02)
        for _ in range(ATTEMPTS):
            loop.link.release_priority()
            loop.pause(0.02)

    return stop_until_confirmed(loop, send)


def stop_until_confirmed(loop: FlightLoop, send: Callable[[], object]) -> bool:
    """Call `send`, which stops the motors, until the vehicle reports that it no longer flies; return whether they stop.

    There are at most ATTEMPTS calls. If the vehicle then acknowledges but does not report its status, its motors count
    as stopped.
    """

    def stopped() -> bool:
        status = loop.status
        return status is not None and status.time > asked and not loop.bits(FLYING)

    loop.end_stream()
    loop.expect_stop()
    for _ in range(ATTEMPTS):
        asked = loop.now()
        send()
        loop.until(lambda: stopped() or loop.health.status_unknown, MOTORS_STOP_TIMEOUT)
        if stopped():
            return True
    return loop.health.status_unknown
