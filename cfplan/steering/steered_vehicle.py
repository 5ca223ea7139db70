"""A vehicle that a program steers: take off, fly through waypoints, change them in the air, land.

For any requests of the program, and even if it dies, the vehicle is committed to setpoints that end in a hover inside
the space, each with a stop. A request is planned during the flight, certified like a plan before take-off, and flown
from a joint ahead of the vehicle without a stop between; if that is impossible, it is refused with a reason and the
flight continues unchanged.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cfplan.air.process import PLANNER_ANSWER_TIMEOUT
from cfplan.air.requests import PathAnswer, PathRequest, PathVerdict, Wish
from cfplan.air.timeline import hold_hover
from cfplan.errors import (
    CfplanError,
    ExitCode,
    FlightEndedError,
    InputError,
    LinkError,
    PreflightError,
    RequestRefusedError,
)
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import FlightOutcome
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.telemetry import Phase, PhaseEntered, PoseReceived, SetpointSent, Telemetry, Triple
from cfplan.geometry.min_snap import MAX_COORDINATE
from cfplan.recording.record import Record
from cfplan.safety.limits import Limits
from cfplan.steering.flight_in_progress import FlightInProgress, Listeners
from cfplan.steering.recorded_steering import SteeringRecord, answer_text

MAX_WAYPOINTS = 200  # per request
_TAKE_OFF_TIMEOUT = 120.0  # s, preflight and its waits included
_LAND_TIMEOUT = 120.0  # s
_FLYING = (Phase.STREAM, Phase.HOLD)


class SteeredVehicle:
    """One flight of a vehicle; a context manager that lands and disarms the vehicle at its end.

    `cfplan.connect` makes it. Its methods raise a FlightEndedError once the flight has ended by anything but `land`:
    by the operator's keys, by a safety rule, or because the link was lost; the error has the reason.
    """

    def __init__(
        self,
        flight: FlightInProgress,
        limits: Limits,
        *,
        uri: str,
        name: str = "steered",
        records: Path | None = None,
        on_record: Callable[[SteeringRecord], None] = lambda _: None,
    ):
        """Steer a flight under these limits. It is recorded as a folder in `records`, if that is given."""
        self._flight, self._limits, self._uri, self._name = flight, limits, uri, name
        self._records, self._on_record = records, on_record
        self._recording: SteeringRecord | None = None
        self._answers: dict[int, PathAnswer] = {}
        self._unread: list[PathAnswer] = []
        self._asked: set[int] = set()
        self._started = False
        self._phase: Phase | None = None
        self._begun = math.nan  # s, when setpoint 0 was due
        self._sent: SetpointSent | None = None
        self._pose: PoseReceived | None = None
        self._ends = 0.0  # s from setpoint 0, when the committed motion ends
        self._closed = False
        self._recorded: tuple[Record, dict[str, Any]] | None = None

    # State.

    @property
    def position(self) -> Triple:
        """Return the last measured position, m; before the flight, where it stands."""
        return self._pose.position if self._pose is not None else self._flight.first_pose()[0]

    @property
    def target(self) -> Triple:
        """Return the position of the last setpoint, m. Raises InputError before take-off."""
        if self._sent is None:
            raise _not_flying()
        return self._sent.position

    @property
    def speed(self) -> float:
        """Return the speed of the last setpoint, m/s; 0 before take-off."""
        return math.hypot(*self._sent.velocity) if self._sent is not None else 0.0

    @property
    def time(self) -> float:
        """Return the time, s, on the flight's clock, whose zero is arbitrary."""
        return self._flight.clock.now()

    @property
    def resting(self) -> bool:
        """Return whether all requests have been flown, and the vehicle hovers."""
        if self._phase not in _FLYING or self._sent is None or self._asked - self._answers.keys():
            return False
        return self._sent.time >= self._begun + self._ends

    @property
    def outcome(self) -> FlightOutcome | None:
        """Return how the flight ended; None during the flight, or if there was none."""
        ended = self._flight.outcome
        return ended if isinstance(ended, FlightOutcome) else None

    @property
    def record(self) -> Path | None:
        """Return the folder of the flight's record; None before take-off, or if none is written."""
        return self._recording.folder if self._recording is not None else None

    @property
    def summary(self) -> dict[str, Any]:
        """Return the figures of `cfplan report`, once the flight is over; empty if there is no record."""
        return self._recorded[1] if self._recorded is not None else {}

    # The flight.

    def take_off(self, height: float | None = None) -> None:
        """Check everything as before any flight, arm, climb to a height, m, and return once the vehicle hovers there.

        Without a height, to that of the limits. Raises a CfplanError if the vehicle cannot take off: a check failed,
        the hover lies outside the space, or there is no link or no pose. The vehicle was not armed then. It also raises
        one if the vehicle does not hover within two minutes or is landed meanwhile; the vehicle is disarmed then.
        """
        if self._started:
            raise InputError("it has taken off already", where="take_off", hint="connect again for another flight")
        limits = self._limits
        if height is not None:
            limits = replace(limits, ground=replace(limits.ground, take_off_height=_checked_height(height)))
        (x, y, _), yaw = self._flight.first_pose()
        timeline = hold_hover((x, y, limits.ground.take_off_height), yaw, limits)
        mission = Mission(timeline.commitment.payloads, timeline.commitment.stops, limits)
        mission = replace(mission, hold_time=max(limits.battery.endurance - mission.duration - 0.01, 0.0))
        self._ends = timeline.ends
        if self._records is not None:
            place = (x, y, limits.ground.take_off_height)
            self._recording = SteeringRecord(
                self._records, self._name, self._uri, limits, place, yaw, clock=self._flight.clock
            )
            self._on_record(self._recording)
        self._started = True
        self._flight.start(mission, timeline, Listeners(self._hear, self._hear_answer))
        if not self._flight.wait(lambda: self._phase in _FLYING and self._sent is not None, _TAKE_OFF_TIMEOUT):
            self._require_flying()
            self._end(Order.LAND)
            raise PreflightError(
                f"it did not hover within {_TAKE_OFF_TIMEOUT:.0f} s, and was landed",
                where=self._uri,
                hint="see the record's events; raise ground.take_off_speed if the climb takes that long",
            )

    def fly(self, waypoints: ArrayLike) -> PathAnswer:
        """Fly through waypoints, (K, 3) m, to rest at the last, instead of what is ahead; the same as `replace`."""
        return self.replace(waypoints)

    def extend(self, waypoints: ArrayLike) -> PathAnswer:
        """Fly on through waypoints, (K, 3) m, after those ahead, without a stop between. Otherwise like `replace`."""
        return self.ask(Wish.EXTEND, waypoints)

    def replace(self, waypoints: ArrayLike) -> PathAnswer:
        """Leave what is ahead at the next joint, and fly through waypoints, (K, 3) m, to rest at the last.

        Returns once the pilot is committed to it, while the vehicle flies on. Raises InputError for invalid waypoints,
        RequestRefusedError if no certified plan leads through them or it came too late.
        """
        return self.ask(Wish.REPLACE, waypoints)

    def stop(self) -> PathAnswer:
        """Come to rest soon, ahead on the path. Raises RequestRefusedError if the committed motion ends as soon."""
        return self.ask(Wish.STOP)

    def slower(self) -> PathAnswer:
        """Fly the rest, and later requests, at three quarters of the speed. Otherwise like `replace`."""
        return self.ask(Wish.SLOWER)

    def faster(self) -> PathAnswer:
        """Undo one `slower`. Otherwise like `replace`."""
        return self.ask(Wish.FASTER)

    def ask(self, wish: Wish | str, waypoints: ArrayLike = ()) -> PathAnswer:
        """Request a change, wait for its answer, and return it. Raises like `replace`."""
        answer = self.answer_to(self.request(wish, waypoints))
        if answer.verdict is not PathVerdict.ACCEPTED:
            raise RequestRefusedError(
                answer_text(answer), where=str(wish), hint="ask for something else; the flight goes on as it was"
            )
        return answer

    def request(self, wish: Wish | str, waypoints: ArrayLike = ()) -> int:
        """Request a change and return the number of its answer, without waiting for the answer.

        The latest request wins: one that waits to be planned is superseded. If many requests are unread, this waits
        until the planner has read some. Raises InputError for an invalid wish or waypoints, and RequestRefusedError if
        the planner reads none for 15 s.
        """
        self._require_flying()
        wish = _checked_wish(wish)
        points = checked_waypoints(waypoints) if wish in (Wish.EXTEND, Wish.REPLACE) else ()
        number = self._flight.ask(wish, points)
        self._asked.add(number)
        if self._recording is not None:
            self._recording.requested(PathRequest(number, wish, points))
        return number

    def answer_to(self, number: int) -> PathAnswer:
        """Wait for the answer to a request and return it; if the planner does not answer, one that says so.

        Raises InputError if `request` has not returned this number.
        """
        if not isinstance(number, (int, np.integer)) or number not in self._asked:
            raise InputError(f"no request {number!r}", where="answer_to", hint="give a number that request() returned")
        self._flight.wait(lambda: number in self._answers, PLANNER_ANSWER_TIMEOUT)
        answer = self._answers.get(number)
        if answer is None:
            self._require_flying()
            answer = PathAnswer(number, PathVerdict.LATE, "the planner does not answer", seconds=PLANNER_ANSWER_TIMEOUT)
            self._hear_answer(answer)
        self._unread = [other for other in self._unread if other.number != number]
        return answer

    def answers(self) -> list[PathAnswer]:
        """Return the answers since the last call, except those that were waited for."""
        unread, self._unread = self._unread, []
        return unread

    def keys(self) -> list[str]:
        """Return the keys typed since the last call: up, down, left, right, and characters.

        Space and Esc are not among them: they land and cut. Keys are read while the vehicle flies in real time.
        """
        return self._flight.typed()

    def wait(self, patience: float = math.inf) -> bool:
        """Wait until all requests have been flown and the vehicle hovers, for at most `patience`, s.

        Returns whether it does.
        """
        until = self.time + patience
        while not self.resting and self.time < until:
            self._require_flying()
            self._flight.wait(lambda: self.resting, min(until - self.time, 1.0))
        return self.resting

    def sleep(self, duration: float) -> None:
        """Let `duration`, s, of the flight pass."""
        until = self.time + duration
        while self.time < until:
            self._require_flying()
            self._flight.wait(lambda: self.time >= until, min(until - self.time, 1.0))

    def land(self) -> None:
        """Stop along the path if the vehicle still moves, land, disarm, and return when that is done.

        Raises a FlightEndedError if a safety rule or the operator ended the flight instead.
        """
        self._end(Order.FINISH if self.resting else Order.LAND)
        ended = self._flight.outcome
        if isinstance(ended, CfplanError):
            raise ended
        if ended is not None and ended.exit_code not in (ExitCode.OK, ExitCode.ENDED_BY_OPERATOR):
            raise _ended(ended)

    def finish(self) -> None:
        """Fly the committed motion to its end, then land, disarm, and return. Raises like `land`."""
        self._end(Order.FINISH, self._ends + _LAND_TIMEOUT)
        self.land()

    def cut(self) -> None:
        """Cut the motors at once, at any height: the vehicle falls. It cannot take off afterwards."""
        self._end(Order.CUT)

    def close(self) -> None:
        """Land the vehicle if it flies, release it, and end its record. May be called twice; does not raise."""
        if self._closed:
            return
        self._closed = True
        try:
            self._flight.close()
        finally:
            if self._recording is not None:
                self._recorded = self._recording.close(self.outcome)

    def __enter__(self) -> "SteeredVehicle":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None and self._phase in _FLYING:
                self.finish()
        finally:
            self.close()

    # Internal.

    def _end(self, order: Order, patience: float = _LAND_TIMEOUT) -> None:
        """Give an order that ends the flight, and wait until it has ended. Raises LinkError if it does not."""
        if self._flight.outcome is not None:
            return
        if self._started or order is Order.CUT:
            self._flight.order(order)
        if self._started:
            self._flight.wait(lambda: False, patience)
            if self._flight.outcome is None:
                raise LinkError(
                    f"the flight has not ended {patience:.0f} s after the order to",
                    where=self._uri,
                    hint="keep away from the vehicle until it lies still",
                )

    def _hear(self, message: Telemetry) -> None:
        """Take telemetry, in the thread that attends to the flight."""
        if isinstance(message, PhaseEntered):
            self._phase = message.phase
        elif isinstance(message, PoseReceived):
            self._pose = message
        elif isinstance(message, SetpointSent) and self._phase in _FLYING:
            if math.isnan(self._begun):
                self._begun = message.due - message.index / RATE
            self._sent = message
        if self._recording is not None:
            self._recording.tell(message)

    def _hear_answer(self, answer: PathAnswer) -> None:
        if math.isfinite(answer.ends):
            self._ends = answer.ends
        brief = replace(answer, plan=None)
        if answer.verdict is not PathVerdict.CHANGED:  # that follows the answer
            self._answers[answer.number] = brief
        self._unread.append(brief)
        if self._recording is not None:
            self._recording.answered(answer)

    def _require_flying(self) -> None:
        ended = self._flight.outcome
        if isinstance(ended, CfplanError):
            raise ended
        if ended is not None:
            raise _ended(ended)
        if not self._started:
            raise _not_flying()


def checked_waypoints(waypoints: ArrayLike) -> tuple[Triple, ...]:
    """Return waypoints as rows of x, y, z, m. Raises InputError if they are invalid."""
    hint = "give rows of x, y, z in metres, as [[1, 0, 1], [0, 1, 1.2]]"
    try:
        points = np.array(waypoints, dtype=float)
    except OverflowError:
        raise InputError("one of the numbers is too large", where="waypoints", hint=hint) from None
    except (TypeError, ValueError):
        raise InputError("these are not numbers", where="waypoints", hint=hint) from None
    if points.ndim != 2 or points.shape[1:] != (3,) or not len(points):
        raise InputError(f"waypoints of shape {points.shape}", where="waypoints", hint=hint)
    if len(points) > MAX_WAYPOINTS:
        raise InputError(
            f"{len(points)} waypoints at once", where="waypoints", hint=f"give at most {MAX_WAYPOINTS}, and extend"
        )
    far = ~(np.abs(points) <= MAX_COORDINATE).all(axis=1)  # NaN too
    if far.any():
        at = int(np.argmax(far))
        raise InputError(
            f"{points[at].tolist()} is not a position within {MAX_COORDINATE:g} m of the origin",
            where=f"waypoint {at + 1}",
            hint="give metres in the frame of the room",
        )
    return tuple((x, y, z) for x, y, z in points.tolist())


def _checked_wish(wish: Wish | str) -> Wish:
    """Return a wish, also of its text. Raises InputError if it is none."""
    try:
        return Wish(wish)
    except ValueError:
        hint = f"give a cfplan.Wish, or one of {', '.join(Wish)}"
        raise InputError(f"{wish!r} is not a wish", where="request", hint=hint) from None


def _checked_height(height: float) -> float:
    """Return a height as a number, m. Raises InputError if it is not a finite one."""
    try:
        number = float(height) if np.isreal(height) else math.nan
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError("the height is not a finite number", where="take_off", hint="give metres above the origin")
    return number


def _not_flying() -> InputError:
    return InputError("it has not taken off", where="vehicle", hint="call take_off() first")


def _ended(outcome: FlightOutcome) -> FlightEndedError:
    failed = [f"{check.name}: {check.value}, must be {check.threshold}" for check in outcome.checks if not check.passed]
    hints = [check.hint for check in outcome.checks if not check.passed and check.hint]
    if outcome.exit_code is ExitCode.PREFLIGHT and failed:
        return FlightEndedError(
            "; ".join(failed), where="preflight", hint="; ".join(hints), exit_code=outcome.exit_code
        )
    return FlightEndedError(
        outcome.reason,
        where="flight",
        hint=outcome.hint or "the record tells what happened",
        exit_code=outcome.exit_code,
    )
