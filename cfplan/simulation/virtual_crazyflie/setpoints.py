"""Setpoints of the stabilizer, decoded from the packets of CRTP ports 3 and 7."""

from dataclasses import dataclass, field
from math import radians
from struct import calcsize, unpack

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.setpoints.packets import FULL_STATE_TYPE, PAYLOAD_SIZE, decode_one
from cfplan.simulation.engine.layout import SETPOINT_SIZE
from cfplan.simulation.engine.mellinger import (
    ABSOLUTE,
    DISABLE,
    FULL_STATE,
    MODE_PITCH,
    MODE_ROLL,
    MODE_X,
    MODE_Y,
    MODE_YAW,
    MODE_Z,
    NOTHING,
    VELOCITY_MODE,
)

# Place of each value, as in `mellinger`.
POSITION, VELOCITY, ACCELERATION = slice(0, 3), slice(3, 6), slice(6, 9)
QUATERNION, BODY_RATE = slice(9, 13), slice(13, 16)
ROLL, PITCH, YAW, THRUST = range(16, 20)
ROLL_RATE, PITCH_RATE, YAW_RATE = range(13, 16)

_MIN_THRUST, _MAX_THRUST = 1000, 60000

_VELOCITY_LEGACY, _HEIGHT_LEGACY, _ALTITUDE_HOLD, _HOVER_LEGACY = 1, 2, 4, 5
_STOP, _POSITION, _VELOCITY, _HEIGHT, _HOVER, _MANUAL = 0, 7, 8, 9, 10, 11
_FOUR_FLOATS = "<ffff"
_LAYOUTS = {
    _VELOCITY_LEGACY: _FOUR_FLOATS, _HEIGHT_LEGACY: _FOUR_FLOATS, _ALTITUDE_HOLD: _FOUR_FLOATS,
    _HOVER_LEGACY: _FOUR_FLOATS, _POSITION: _FOUR_FLOATS, _VELOCITY: _FOUR_FLOATS, _HEIGHT: _FOUR_FLOATS,
    _HOVER: _FOUR_FLOATS, _MANUAL: "<fffHB",
}  # fmt: skip


class FirmwareAssert(Exception):
    """The firmware stops for ever on this packet."""


@dataclass(slots=True)
class Setpoint:
    """Values and modes as in `mellinger`; a new one is null: motors off."""

    values: NDArray = field(default_factory=lambda: np.zeros(SETPOINT_SIZE))  # (20,)
    mode: NDArray = field(default_factory=lambda: np.array(NOTHING))  # (7,)
    velocity_in_body: bool = False  # horizontal velocity along the body's axes
    tick: int = 0  # when the commander took it


def decode_setpoint(payload: bytes) -> Setpoint:
    """Decode a packet of port 7, channel 0; an unknown type gives a null setpoint.

    Raises FirmwareAssert on a wrong length.
    """
    kind, content = payload[0], payload[1:]
    if kind == FULL_STATE_TYPE:
        return _full_state(payload)
    setpoint = Setpoint()
    if kind == _STOP or kind not in _LAYOUTS:
        return setpoint
    if len(content) != calcsize(_LAYOUTS[kind]):
        raise FirmwareAssert(f"setpoint type {kind} with {len(content)} bytes")
    values = unpack(_LAYOUTS[kind], content)
    if kind == _MANUAL:
        return _manual(*values)
    turn = -1.0 if kind in (_VELOCITY_LEGACY, _HEIGHT_LEGACY, _HOVER_LEGACY) else 1.0
    if kind in (_VELOCITY, _VELOCITY_LEGACY):
        setpoint.values[VELOCITY] = values[:3]
        setpoint.mode[[MODE_X, MODE_Y, MODE_Z]] = VELOCITY_MODE
        _turn_at(setpoint, turn * values[3])
    elif kind in (_HOVER, _HOVER_LEGACY):
        setpoint.values[3:5] = values[:2]
        setpoint.mode[[MODE_X, MODE_Y]] = VELOCITY_MODE
        setpoint.velocity_in_body = True
        _hold_height(setpoint, values[3])
        _turn_at(setpoint, turn * values[2])
    elif kind == _POSITION:
        setpoint.values[POSITION] = values[:3]
        setpoint.values[YAW] = radians(values[3])
        setpoint.mode[[MODE_X, MODE_Y, MODE_Z, MODE_YAW]] = ABSOLUTE
    else:
        _tilt(setpoint, values[0], values[1])
        _turn_at(setpoint, turn * values[2])
        if kind == _ALTITUDE_HOLD:
            setpoint.values[5] = values[3]
            setpoint.mode[MODE_Z] = VELOCITY_MODE
        else:
            _hold_height(setpoint, values[3])
    return setpoint


def _full_state(payload: bytes) -> Setpoint:
    if len(payload) != PAYLOAD_SIZE:
        raise FirmwareAssert(f"full state with {len(payload)} bytes")
    setpoint = Setpoint(mode=np.array(FULL_STATE))
    setpoint.values[POSITION.start : BODY_RATE.stop] = decode_one(payload)
    return setpoint


def _manual(roll: float, pitch: float, turn: float, thrust: int, by_rate: int) -> Setpoint:
    setpoint = Setpoint()
    if by_rate:
        setpoint.values[[ROLL_RATE, PITCH_RATE]] = radians(roll), -radians(pitch)
        setpoint.mode[[MODE_ROLL, MODE_PITCH]] = VELOCITY_MODE
    else:
        _tilt(setpoint, roll, pitch)
    _turn_at(setpoint, turn)
    setpoint.values[THRUST] = thrust
    return setpoint


def _tilt(setpoint: Setpoint, roll: float, pitch: float) -> None:
    setpoint.values[[ROLL, PITCH]] = radians(roll), radians(pitch)
    setpoint.mode[[MODE_ROLL, MODE_PITCH]] = ABSOLUTE


def _turn_at(setpoint: Setpoint, rate: float) -> None:
    setpoint.values[YAW_RATE] = radians(rate)
    setpoint.mode[MODE_YAW] = VELOCITY_MODE


def _hold_height(setpoint: Setpoint, height: float) -> None:
    setpoint.values[2] = height
    setpoint.mode[MODE_Z] = ABSOLUTE


class AttitudeSetpoints:
    """Port 3: roll, pitch, yaw rate in degrees and thrust. Thrust stays locked until a zero has been seen."""

    def __init__(self) -> None:
        self._locked = True

    def decode(self, payload: bytes, *, first: bool) -> Setpoint | None:
        """Decode a packet, None if it is too short. `first` says that no setpoint has come before."""
        if len(payload) < 14:
            return None
        roll, pitch, turn, thrust = unpack("<fffH", payload[:14])
        self._locked = thrust != 0 and (self._locked or first)
        setpoint = Setpoint()
        _tilt(setpoint, roll, pitch)
        _turn_at(setpoint, -turn)
        setpoint.values[THRUST] = 0 if self._locked or thrust < _MIN_THRUST else min(thrust, _MAX_THRUST)
        setpoint.mode[MODE_Z] = DISABLE
        return setpoint
