"""Messages for ground stations from the pilot's newest telemetry, each at its own rate."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cfplan.flight.radio.supervisor_bits import ARMED, CRASHED, FLYING, LOCKED, TUMBLED
from cfplan.flight.telemetry import Estimate, Phase, SetpointSent, VehicleStatus
from cfplan.recording.mavlink.frames import attitude, euler, frd, in_body, ned

TEXT_LENGTH = 50  # bytes of one status text
_QUADROTOR, _GENERIC = 2, 0  # MAV_TYPE, MAV_AUTOPILOT
_GUIDED, _STABILISED, _ARMED = 8, 16, 128  # MAV_MODE_FLAG
_STANDBY, _ACTIVE, _EMERGENCY, _TERMINATED = 3, 4, 6, 8  # MAV_STATE
_ON_GROUND, _IN_AIR, _TAKING_OFF, _LANDING = 1, 2, 3, 4  # MAV_LANDED_STATE
_LOCAL_NED, _BODY_FRD = 1, 12  # MAV_FRAME
_NO_YAW_RATE = 2048  # of a position target's type mask
_POSE_ESTIMATOR = 6  # MAV_ESTIMATOR_TYPE_MOCAP
_NOT_KNOWN = 65535
_LITHIUM = 1  # MAV_BATTERY_TYPE
_LANDED_STATES = {Phase.TAKE_OFF: _TAKING_OFF, Phase.LAND: _LANDING}


@dataclass(slots=True)
class Latest:
    """The newest message of each kind; None where there was none yet."""

    start: float  # s on the pilot's clock, counted as the vehicle's boot
    estimate: Estimate | None = None
    status: VehicleStatus | None = None
    setpoint: SetpointSent | None = None
    phase: Phase | None = None

    def milliseconds(self, time: float) -> int:
        return max(0, round(1e3 * (time - self.start))) & 0xFFFFFFFF

    @property
    def supervisor(self) -> int:
        return self.status.supervisor if self.status is not None else 0


# A function from the dialect's encoder and the newest state to a message; None if nothing is known yet.
Make = Callable[[Any, Latest], Any]


def heartbeat(mav: Any, latest: Latest) -> Any:
    bits = latest.supervisor
    armed, flying = bool(bits & ARMED), bool(bits & FLYING)
    state = _ACTIVE if flying else _STANDBY
    if bits & (TUMBLED | CRASHED):
        state = _EMERGENCY
    if bits & LOCKED:
        state = _TERMINATED
    mode = _GUIDED | _STABILISED | (_ARMED if armed else 0)
    return mav.heartbeat_encode(_QUADROTOR, _GENERIC, mode, 0, state)


def landed_state(mav: Any, latest: Latest) -> Any:
    flying = bool(latest.supervisor & FLYING)
    state = _LANDED_STATES.get(latest.phase, _IN_AIR) if flying and latest.phase is not None else _ON_GROUND
    return mav.extended_sys_state_encode(0, state)


def local_position(mav: Any, latest: Latest) -> Any:
    estimate = latest.estimate
    if estimate is None:
        return None
    time = latest.milliseconds(estimate.time)
    return mav.local_position_ned_encode(time, *ned(estimate.position), *ned(estimate.velocity))


def attitude_quaternion(mav: Any, latest: Latest) -> Any:
    estimate = latest.estimate
    if estimate is None:
        return None
    return mav.attitude_quaternion_encode(
        latest.milliseconds(estimate.time), *attitude(estimate.quaternion), *_rate(latest)
    )


def attitude_euler(mav: Any, latest: Latest) -> Any:
    estimate = latest.estimate
    if estimate is None:
        return None
    angles = euler(attitude(estimate.quaternion))
    return mav.attitude_encode(latest.milliseconds(estimate.time), *angles, *_rate(latest))


def odometry(mav: Any, latest: Latest) -> Any:
    estimate = latest.estimate
    if estimate is None:
        return None
    unknown = [math.nan] + 20 * [0.0]
    velocity = frd(in_body(estimate.velocity, estimate.quaternion))
    return mav.odometry_encode(
        1000 * latest.milliseconds(estimate.time), _LOCAL_NED, _BODY_FRD, *ned(estimate.position),
        list(attitude(estimate.quaternion)), *velocity, *_rate(latest), unknown, unknown, 0, _POSE_ESTIMATOR,
    )  # fmt: skip


def position_target(mav: Any, latest: Latest) -> Any:
    setpoint = latest.setpoint
    if setpoint is None:
        return None
    _, _, yaw = euler(attitude(setpoint.quaternion))
    return mav.position_target_local_ned_encode(
        latest.milliseconds(setpoint.time), _LOCAL_NED, _NO_YAW_RATE, *ned(setpoint.position),
        *ned(setpoint.velocity), *ned(setpoint.acceleration), yaw, 0.0,
    )  # fmt: skip


def battery(mav: Any, latest: Latest) -> Any:
    if latest.status is None:
        return None
    cells = [_millivolts(latest), *[_NOT_KNOWN] * 9]
    return mav.battery_status_encode(0, 0, _LITHIUM, 32767, cells, -1, -1, -1, -1)


def system(mav: Any, latest: Latest) -> Any:
    if latest.status is None:
        return None
    return mav.sys_status_encode(0, 0, 0, 0, _millivolts(latest), -1, -1, 0, 0, 0, 0, 0, 0)


def autopilot_version(mav: Any, latest: Latest) -> Any:
    protocol_2 = 1 << 13  # MAV_PROTOCOL_CAPABILITY_MAVLINK2
    terminates = 1 << 11  # MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
    none = [0] * 8
    return mav.autopilot_version_encode(protocol_2 | terminates, 0, 0, 0, 0, none, none, none, 0, 0, 1)


def status_texts(mav: Any, severity: int, text: str, number: int) -> list[Any]:
    """Return one message, or several that belong together where the text is long."""
    data = text.encode()
    pieces = [data[i : i + TEXT_LENGTH] for i in range(0, len(data), TEXT_LENGTH)] or [b""]
    if len(pieces) == 1:
        return [mav.statustext_encode(severity, data)]
    if len(pieces[-1]) == TEXT_LENGTH:
        pieces.append(b"")  # a piece that is not full ends the text
    return [mav.statustext_encode(severity, piece, number, index) for index, piece in enumerate(pieces[:255])]


RATES: tuple[tuple[Make, float], ...] = (  # with Hz
    (heartbeat, 1.0),
    (landed_state, 2.0),
    (local_position, 25.0),
    (attitude_quaternion, 25.0),
    (attitude_euler, 10.0),
    (odometry, 25.0),
    (position_target, 25.0),
    (battery, 1.0),
    (system, 1.0),
)


def _rate(latest: Latest) -> tuple[float, float, float]:
    return frd(latest.status.body_rate) if latest.status is not None else (0.0, 0.0, 0.0)


def _millivolts(latest: Latest) -> int:
    volts = latest.status.battery_voltage if latest.status is not None else math.nan
    return min(max(round(1e3 * volts), 0), _NOT_KNOWN - 1) if math.isfinite(volts) else _NOT_KNOWN
