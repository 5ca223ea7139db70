"""Read a folder of public flights: columns in NPZ, vehicle, controller and reference in JSON."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.flight.firmware import MellingerGains
from cfplan.identification.flight_log import FlightLog
from cfplan.identification.reference import YAW, ReferenceMotion
from cfplan.identification.replay import Controller
from cfplan.simulation.engine.lee import LEE_GAINS, REFERENCE_SIZE, LeeGains
from cfplan.vehicle.airframe import GRAVITY, MOTOR_TORQUE_SIGNS

ARM, THRUST_TO_TORQUE = 0.046 / 2**0.5, 0.005964552  # m, as the power distribution of those firmwares has them
FULL = 65535
# Gram a motor to PWM of the brushless vehicle, and volts to gram of the brushed one's battery compensation.
_BRUSHLESS_PWM = (0.16609668469985447, 0.02297914810965436, 0.0001878280261464696)
_BRUSHED_VOLTS = (0.088, -0.0006239)
_BRUSHED_FULL = 60.0  # gram of all motors at full command
MASS_THRUST = 132000.0  # 16-bit units per N, firmware default of the Mellinger controller
MELLINGER = MellingerGains(
    mass=0.027, mass_thrust=MASS_THRUST, kR_xy=68000.0, kw_xy=18900.0, kd_omega_rp=190.0
)  # as replayed  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class PublicFlight:
    """One flight of the folder."""

    name: str
    family: str  # vehicle and controller
    mass: float  # kg, as weighed
    log: FlightLog
    reference: ReferenceMotion
    controller: Controller
    source: str  # its repository


def flights_of(folder: Path) -> dict[str, Path]:
    """Return the JSON file of each flight with a known reference. Raises InputError if there is none."""
    files = sorted(file for file in folder.glob("*.json") if file.name != "index.json")
    found = {file.stem: file for file in files if _known(json.loads(file.read_text()))}
    if not found:
        hint = "name the folder of the public flights, with its index.json"
        raise InputError("no flights with a known reference", where=str(folder), hint=hint)
    return found


def _known(about: dict[str, Any]) -> bool:
    return "ref_position" in about.get("columns", {})


def family_of(about: dict[str, Any]) -> str:
    """Return vehicle and controller."""
    named = {"brushless-lee": "brushless, Lee", "tune-upgraded": "brushed upgrade, Lee",
             "tune-standard": "brushed, Lee", "brushed-mellinger": "brushed, Mellinger"}  # fmt: skip
    return next((name for start, name in named.items() if about["family"].startswith(start)), about["family"])


def read_flight(file: Path) -> PublicFlight:
    """Read a flight by its JSON file."""
    about, data = json.loads(file.read_text()), dict(np.load(file.with_suffix(".npz")))
    family, zero = family_of(about), float(data["time"][0])
    by_lee = family.endswith("Lee")
    gains = LeeGains(**{name: value for name, value in about["gains"].items() if name in LEE_GAINS}) if by_lee else None
    rates = data.get("desired_body_rate")
    log = FlightLog(
        name=file.stem,
        time=data["time"] - zero,
        state=np.column_stack([data[name] for name in ("position", "velocity", "quaternion", "gyro")]).astype(float),
        control=_control(data, family),
        acceleration=data.get("acc"),
        voltage=data.get("vbat"),
        **_poses(data, zero),
    )
    rows = np.zeros((len(log.time), REFERENCE_SIZE))
    for k, name in enumerate(("position", "velocity", "acceleration", "jerk")):
        rows[:, 3 * k : 3 * k + 3] = data[f"ref_{name}"]
    rows[:, YAW] = data["ref_yaw"]
    return PublicFlight(
        file.stem, family, float(about["mass_weighed"]), log, ReferenceMotion(about["trajectory"], log.time, rows),
        Controller(gains or MELLINGER, feeds_jerk=rates is None or bool(np.any(rates))), about["source"]["repository"],
    )  # fmt: skip


def _poses(data: dict[str, NDArray], zero: float) -> dict[str, NDArray]:
    if "mocap_time" not in data:
        return {}
    poses = np.hstack([data["mocap_position"], data["mocap_quaternion"]])
    return {"pose_time": data["mocap_time"] - zero, "poses": poses}


def _control(data: dict[str, NDArray], family: str) -> NDArray:
    """Return thrust and torques, (N, 4), that the controller asked for: logged, or by the motors' PWM."""
    if "thrust_command" in data:
        return np.column_stack([data["thrust_command"], data["torque_command"]]).astype(float)
    fraction = data["pwm"] / FULL
    if family.startswith("brushless"):
        motors = _inverse(fraction, _BRUSHLESS_PWM) * 1e-3 * GRAVITY
    else:
        volts = fraction * data["vbat"][:, None]
        motors = _inverse(volts, (0.0, *_BRUSHED_VOLTS)) / _BRUSHED_FULL * (FULL + 1) / (4 * MASS_THRUST)
    levers = (ARM, ARM, THRUST_TO_TORQUE)
    return np.column_stack([motors.sum(axis=1), *(lever * motors @ signs for lever, signs in
                                                  zip(levers, MOTOR_TORQUE_SIGNS, strict=True))])  # fmt: skip


def _inverse(values: NDArray, coefficients: tuple[float, float, float]) -> NDArray:
    """Return x >= 0 of a + b x + c x² = value."""
    a, b, c = coefficients
    return np.maximum((-b + np.sqrt(np.maximum(b * b - 4 * c * (a - values), 0.0))) / (2 * c), 0.0)
