"""The high-level commander (CRTP port 8): take-off, landing and go-to as septics, and uploaded polynomials.

When idle it sends a null setpoint, motors off, every 10 ms at the lowest priority: the null-setpoint gap. Spirals and
take-off and landing by speed are not simulated; they answer ENOEXEC. So do compressed pieces without an end, where the
firmware would read on in its memory.
"""

import errno
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum, auto
from struct import error, unpack

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.on_board.memory_format import PIECE_SIZE, read_compressed
from cfplan.simulation.engine.mellinger import ON_BOARD
from cfplan.simulation.virtual_crazyflie.setpoints import (
    ACCELERATION,
    BODY_RATE,
    POSITION,
    VELOCITY,
    YAW,
    Setpoint,
)
from cfplan.vehicle.airframe import GRAVITY

(
    _SET_GROUP_MASK, _TAKE_OFF, _LAND, _STOP, _GO_TO, _START, _DEFINE, _TAKE_OFF_2, _LAND_2, _TAKE_OFF_BY_SPEED,
    _LAND_BY_SPEED, _SPIRAL, _GO_TO_2, _START_2,
) = range(14)  # fmt: skip
_PLANNER_BUSY = 1
_DEFINITIONS = 31
_IN_MEMORY, _UNCOMPRESSED, _COMPRESSED = 1, 0, 1

# The upper half of a septic on [0, 1] from the remainders of value and derivatives 1 to 3 at its end.
_UPPER = np.linalg.inv(
    np.array([[1, 1, 1, 1], [4, 5, 6, 7], [12, 20, 30, 42], [24, 60, 120, 210]], dtype=float),
)
_ORDERS = np.arange(8)


class PlannerState(Enum):
    """The states of the planner."""

    IDLE = auto()
    FLYING = auto()
    LANDING = auto()
    DISABLED = auto()  # by an app on board, or a curve that is not a number; until a setpoint from the radio


@dataclass(frozen=True, slots=True)
class Goal:
    """The planner's goal at one moment. Columns x, y, z, yaw."""

    position: NDArray  # (4,)
    velocity: NDArray  # (4,)
    acceleration: NDArray  # (4,)
    jerk: NDArray  # (4,)


@dataclass(frozen=True, slots=True)
class _Piece:
    duration: float  # s
    coefficients: NDArray  # (8, 4) ascending powers of time, s; columns x, y, z, yaw
    _derivatives: list[NDArray] = field(init=False, default_factory=list)  # coefficients of orders 0 to 3

    def __post_init__(self) -> None:
        coefficients = self.coefficients
        for _ in range(4):
            self._derivatives.append(coefficients)
            coefficients = coefficients[1:] * _ORDERS[1 : len(coefficients), None]

    def at(self, time: float) -> Goal:
        return Goal(*(time ** _ORDERS[: len(each)] @ each for each in self._derivatives))

    def stretched(self, factor: float) -> "_Piece":
        return _Piece(self.duration * factor, self.coefficients / factor ** _ORDERS[:, None])

    def reversed(self) -> "_Piece":
        """Return the same curve backwards, again from time zero on."""
        shift = np.array([[math.comb(j, i) * self.duration ** max(j - i, 0) for j in range(8)] for i in range(8)])
        return _Piece(self.duration, (shift @ self.coefficients) * (-1.0) ** _ORDERS[:, None])

    def moved(self, offset: NDArray) -> "_Piece":
        coefficients = self.coefficients.copy()
        coefficients[0] += offset
        return _Piece(self.duration, coefficients)


def septic(duration: float, start: Goal, end: Goal) -> _Piece:
    """Return the polynomial between two states in `duration`, s, with zero jerk at both ends."""
    scale = duration ** np.arange(3)
    lower = np.zeros((4, 4))
    lower[0], lower[1], lower[2] = start.position, start.velocity * scale[1], start.acceleration * scale[2] / 2
    rest = np.stack(
        [
            end.position - lower.sum(axis=0),
            end.velocity * scale[1] - lower[1] - 2 * lower[2],
            end.acceleration * scale[2] - 2 * lower[2],
            np.zeros(4),
        ]
    )
    return _Piece(duration, np.vstack([lower, _UPPER @ rest]) / duration ** _ORDERS[:, None])


def _at_rest(position: NDArray) -> Goal:
    return Goal(position, np.zeros(4), np.zeros(4), np.zeros(4))


def _wrapped(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi) if math.isfinite(angle) else math.nan


class HighLevelCommander:
    """Carries out commands one at a time; from idle a curve starts at the vehicle's own estimate, `where`."""

    def __init__(self, memory: bytearray, where: Callable[[], Goal]):
        self.state = PlannerState.IDLE
        self._where = where
        self._memory = memory
        self._pieces: list[_Piece] = []
        self._begin = 0.0
        self._last = _at_rest(np.zeros(4))
        self._group_mask = 0
        self._definitions: dict[int, tuple[int, int, int]] = {}  # kind, offset and count of pieces

    def stop(self) -> None:
        """Become idle at once."""
        self.state = PlannerState.IDLE

    def disable(self) -> None:
        """Send no setpoints any more, not even those that stop the motors."""
        self.state = PlannerState.DISABLED

    def finished(self, time: float) -> bool:
        """Return whether the last curve has been flown to its end."""
        return time - self._begin >= sum(piece.duration for piece in self._pieces)

    def setpoint(self, time: float) -> Setpoint | None:
        """Return the setpoint of a time, s, None if disabled; called every 10 ms."""
        if self.state is PlannerState.LANDING and self.finished(time):
            self.state = PlannerState.IDLE
        if self.state is PlannerState.IDLE:
            return Setpoint()
        if self.state is PlannerState.DISABLED:
            return None
        with np.errstate(all="ignore"):  # a client may send NaN
            goal = self._goal(time)
            body_rate = _body_rate(goal)
        if np.isnan(goal.position[0]):  # the firmware checks nothing else
            self.disable()
            return None
        self._last = goal
        setpoint = Setpoint(mode=np.array(ON_BOARD))
        setpoint.values[POSITION] = goal.position[:3]
        setpoint.values[VELOCITY] = goal.velocity[:3]
        setpoint.values[ACCELERATION] = goal.acceleration[:3]
        setpoint.values[BODY_RATE] = body_rate
        setpoint.values[YAW] = goal.position[3]
        return setpoint

    def _goal(self, time: float) -> Goal:
        elapsed = time - self._begin
        for piece in self._pieces:
            if elapsed <= piece.duration:
                return piece.at(elapsed)
            elapsed -= piece.duration
        return _at_rest(self._pieces[-1].at(self._pieces[-1].duration).position)

    def receive(self, payload: bytes, time: float, *, blocked: bool) -> bytes:
        """Carry out a command; return the answer, with the return code in its fourth byte."""
        with np.errstate(all="ignore"):
            code = self._command(payload[0], payload[1:], time, blocked) if payload else errno.ENOEXEC
        return payload[:3].ljust(3, b"\0") + bytes((code,))

    def _command(self, command: int, data: bytes, time: float, blocked: bool) -> int:
        try:
            if command == _SET_GROUP_MASK:
                self._group_mask = data[0]
                return 0
            if command == _DEFINE:
                return self._define(*unpack("<BBBIB", data))
            if command == _STOP:
                if self._addressed(data[0]):
                    self.stop()
                return 0
            if command in (_SPIRAL, _TAKE_OFF_BY_SPEED, _LAND_BY_SPEED) or command > _START_2:
                return errno.ENOEXEC
            if blocked:
                return errno.EBUSY
            return self._move(command, data, time) if self._addressed(data[0]) else 0
        except (error, IndexError):  # a wrong length
            return errno.ENOEXEC

    def _addressed(self, group: int) -> bool:
        return group == 0 or bool(group & self._group_mask)

    def _move(self, command: int, data: bytes, time: float) -> int:
        if self.state in (PlannerState.IDLE, PlannerState.DISABLED):
            self._last = self._where()
        if command in (_TAKE_OFF, _LAND):
            _, height, duration = unpack("<Bff", data)
            return self._climb(command == _LAND, height, 0.0, duration, time)
        if command in (_TAKE_OFF_2, _LAND_2):
            _, height, yaw, keep_yaw, duration = unpack("<Bff?f", data)
            return self._climb(command == _LAND_2, height, self._last.position[3] if keep_yaw else yaw, duration, time)
        if command == _GO_TO:
            _, relative, *place, duration = unpack("<B?fffff", data)
            return self._go_to(relative, False, np.array(place), duration, time)
        if command == _GO_TO_2:
            _, relative, linear, *place, duration = unpack("<B??fffff", data)
            return self._go_to(relative, linear, np.array(place), duration, time)
        if command == _START:
            _, relative, backwards, number, scale = unpack("<B??Bf", data)
            return self._start(number, relative, False, backwards, scale, time)
        _, relative, relative_yaw, backwards, number, scale = unpack("<B???Bf", data)
        return self._start(number, relative, relative_yaw, backwards, scale, time)

    def _climb(self, landing: bool, height: float, yaw: float, duration: float, time: float) -> int:
        if self.state is PlannerState.LANDING if landing else self.state is not PlannerState.IDLE:
            return _PLANNER_BUSY
        target = self._last.position.copy()
        target[2] = height
        return self._fly(_at_rest(self._last.position), target, yaw, duration, time, landing=landing)

    def _go_to(self, relative: bool, linear: bool, place: NDArray, duration: float, time: float) -> int:
        here = self._last if self.state in (PlannerState.IDLE, PlannerState.DISABLED) else self._goal(time)
        target = place + here.position if relative else place.copy()
        if linear:
            distance = target - here.position
            distance[3] = _wrapped(distance[3])
            steady = distance / max(duration, 1e-3)
            still = np.zeros(4)
            here = Goal(here.position, steady, still, still)
            end = Goal(here.position + distance, steady, still, still)
            return self._begin_at(septic(max(duration, 1e-3), here, end), time, PlannerState.FLYING)
        return self._fly(here, target, target[3], duration, time, landing=False)

    def _fly(self, here: Goal, target: NDArray, yaw: float, duration: float, time: float, *, landing: bool) -> int:
        start = here.position.copy()
        start[3] = _wrapped(start[3])
        end = target.copy()
        end[3] = start[3] + _wrapped(yaw - start[3])
        curve = septic(max(duration, 1e-3), Goal(start, here.velocity, here.acceleration, here.jerk), _at_rest(end))
        return self._begin_at(curve, time, PlannerState.LANDING if landing else PlannerState.FLYING)

    def _begin_at(self, curve: _Piece, time: float, state: PlannerState) -> int:
        self._pieces, self._begin, self.state = [curve], time, state
        return 0

    def _define(self, number: int, place: int, kind: int, offset: int, count: int) -> int:
        if number >= _DEFINITIONS or place != _IN_MEMORY or kind not in (_UNCOMPRESSED, _COMPRESSED):
            return errno.ENOEXEC
        if kind == _UNCOMPRESSED and (not count or offset + count * PIECE_SIZE > len(self._memory)):
            return errno.ENOEXEC
        self._definitions[number] = kind, offset, count
        return 0

    def _start(
        self, number: int, relative: bool, relative_yaw: bool, backwards: bool, scale: float, time: float
    ) -> int:
        if number not in self._definitions or not scale > 0:
            return errno.ENOEXEC
        kind, offset, count = self._definitions[number]
        if kind == _COMPRESSED and (scale != 1.0 or backwards):
            return errno.ENOEXEC
        try:
            stored = self._compressed(offset) if kind == _COMPRESSED else self._uncompressed(offset, count)
        except NotCertifiedError:
            return errno.ENOEXEC
        pieces = [piece.stretched(scale) for piece in stored]
        if backwards:
            pieces = [piece.reversed() for piece in reversed(pieces)]
        if relative:
            shift = self._last.position - pieces[0].coefficients[0]
            shift[3] = _wrapped(shift[3]) if relative_yaw and kind == _UNCOMPRESSED else 0.0
            pieces = [piece.moved(shift) for piece in pieces]
        self._pieces, self._begin, self.state = pieces, time, PlannerState.FLYING
        return 0

    def _uncompressed(self, offset: int, count: int) -> list[_Piece]:
        table = np.frombuffer(self._memory, "<f4", count * PIECE_SIZE // 4, offset).reshape(count, -1).astype(float)
        return [_Piece(row[-1], row[:-1].reshape(4, 8).T) for row in table]

    def _compressed(self, offset: int) -> list[_Piece]:
        read = read_compressed(bytes(self._memory), offset)
        table = zip(read.durations.tolist(), read.coefficients.astype(float), strict=True)
        return [_Piece(duration, axes.T) for duration, axes in table]


def _body_rate(goal: Goal) -> NDArray:
    """Return the body rate (3,), rad/s, of the attitude for the goal's acceleration, jerk and yaw."""
    force = goal.acceleration[:3] + np.array([0.0, 0.0, GRAVITY])
    size = np.sqrt(force @ force)
    z = force / size
    yaw = goal.position[3]
    y = _cross(z, (np.cos(yaw), np.sin(yaw), 0.0))
    y /= np.sqrt(y @ y)
    x = _cross(y, z)
    tip = (goal.jerk[:3] - (goal.jerk[:3] @ z) * z) / size
    return np.array([-tip @ y, tip @ x, z[2] * goal.velocity[3]])


def _cross(first: Sequence[float] | NDArray, second: Sequence[float] | NDArray) -> NDArray:
    """Return the cross product, (3,): np.cross takes ten times as long for a single pair."""
    (a, b, c), (x, y, z) = first, second
    return np.array([b * z - c * y, c * x - a * z, a * y - b * x])
