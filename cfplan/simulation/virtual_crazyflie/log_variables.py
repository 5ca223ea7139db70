"""The log variables of the virtual Crazyflie that have a value, in the firmware's units and signs."""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.setpoints.packets import compress_quaternion
from cfplan.machine_code import njit
from cfplan.simulation.engine.kalman import Filter
from cfplan.simulation.virtual_crazyflie.localization import Localization
from cfplan.simulation.virtual_crazyflie.setpoints import PITCH, ROLL, YAW, Setpoint
from cfplan.simulation.virtual_crazyflie.stabilizer import Loop
from cfplan.simulation.virtual_crazyflie.supervisor import Supervisor
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.motor_commands import FULL_COMMAND, compensated_pwm
from cfplan.vehicle.rotations import matrix_of, roll_pitch_of, yaw_of

Getter = Callable[[], float]

_AXES = "xyz"
_BATTERY_LEVELS = (3.5, 4.18)  # V at 0 and 100 %


def _element(array: NDArray, place: int, scale: float = 1.0) -> Getter:
    return lambda: array.item(place) * scale


def euler(quaternion: NDArray) -> tuple[float, float, float]:
    """Return roll, pitch, yaw in degrees; pitch in the firmware's legacy sign, nose up positive."""
    roll, pitch = roll_pitch_of(quaternion)
    return float(np.degrees(roll)), float(-np.degrees(pitch)), float(np.degrees(yaw_of(quaternion)))


def log_variables(
    loop: Loop,
    *,
    localization: Localization,
    supervisor: Supervisor,
    voltage: Callable[[], float],
    airframe: Airframe,
    setpoint: Callable[[], Setpoint],
    info: Callable[[], int],
) -> Mapping[str, Getter]:
    """Return a function for each log variable that has a value; the others stay zero.

    `voltage` returns that of the battery, V, `setpoint` what the controller is given now, `info` the bits of
    supervisor.info.
    """
    belief, kalman = loop.belief, loop.kalman
    found: dict[str, Getter] = {}
    for place, axis in enumerate(_AXES):
        found[f"stateEstimate.{axis}"] = _element(belief, place)
        found[f"stateEstimate.v{axis}"] = _element(belief, 3 + place)
        found[f"stateEstimateZ.{axis}"] = _element(belief, place, 1000)
        found[f"stateEstimateZ.v{axis}"] = _element(belief, 3 + place, 1000)
        found[f"gyro.{axis}"] = _element(belief, 10 + place, 180 / np.pi)
        found[f"acc.{axis}"] = _element(loop.acceleration, place, 1 / GRAVITY)
        found[f"kalman.state{axis.upper()}"] = _element(kalman.state, place)
        found[f"kalman.stateP{axis.upper()}"] = _element(kalman.state, 3 + place)
        found[f"kalman.stateD{place}"] = _element(kalman.state, 6 + place)
        found[f"locSrv.{axis}"] = _element(localization.latest, place)
        found[f"ext_pos.{axis.upper()}"] = _element(localization.latest, place)
    for place, name in enumerate("xyzw"):
        found[f"locSrv.q{name}"] = _element(localization.latest, 3 + place)
    found |= _variances(kalman) | _attitude(belief) | _accelerations(loop) | _targets(setpoint)
    found |= _motors(loop, voltage, airframe) | _power(voltage)
    found["supervisor.info"] = info
    found["sys.canfly"] = lambda: supervisor.can_fly
    found["sys.isFlying"] = lambda: supervisor.is_flying
    found["sys.isTumbled"] = lambda: supervisor.tumbled
    found["locSrvZ.tick"] = lambda: localization.tick
    found["radio.isConnected"] = lambda: 1
    return found


def _variances(kalman: Filter) -> dict[str, Getter]:
    names = ("X", "Y", "Z", "PX", "PY", "PZ", "D0", "D1", "D2")
    return {f"kalman.var{name}": _element(kalman.covariance.diagonal(), place) for place, name in enumerate(names)}


def _attitude(belief: NDArray) -> dict[str, Getter]:
    def angle(place: int) -> float:
        return euler(belief[6:10])[place]

    found: dict[str, Getter] = {}
    for place, name in enumerate(("roll", "pitch", "yaw")):
        for group in ("stateEstimate", "stabilizer"):
            found[f"{group}.{name}"] = partial(angle, place)
    for place, name in enumerate("xyzw"):
        found[f"stateEstimate.q{name}"] = _element(belief, 6 + place)
        found[f"kalman.q{(place + 1) % 4}"] = _element(belief, 6 + place)
    found["stateEstimateZ.quat"] = lambda: int(compress_quaternion(belief[None, 6:10])[0])
    # The firmware gives pitch in its legacy sign here too.
    for place, name, sign in ((10, "Roll", 1), (11, "Pitch", -1), (12, "Yaw", 1)):
        found[f"stateEstimateZ.rate{name}"] = _element(belief, place, sign * 1000)
    return found


def _accelerations(loop: Loop) -> dict[str, Getter]:
    """Return accelerations in world axes: stateEstimate in g without gravity, stateEstimateZ in mm/s² with it."""

    def world(axis: int, scale: float, gravity: float) -> float:
        return (_in_world(loop.belief, loop.acceleration, axis) - gravity) * scale

    found: dict[str, Getter] = {}
    for place, axis in enumerate(_AXES):
        found[f"stateEstimate.a{axis}"] = partial(world, place, 1 / GRAVITY, GRAVITY if axis == "z" else 0.0)
        found[f"stateEstimateZ.a{axis}"] = partial(world, place, 1000.0, 0.0)
    return found


@njit
def _in_world(belief: NDArray, vector: NDArray, axis: int) -> float:
    """Return the component of a vector, (3,) in body axes, along an axis of the world."""
    turn = matrix_of(belief[6:10])
    return turn[axis, 0] * vector[0] + turn[axis, 1] * vector[1] + turn[axis, 2] * vector[2]


def _targets(setpoint: Callable[[], Setpoint]) -> dict[str, Getter]:
    def target(place: int, scale: float = 1.0) -> Getter:
        return lambda: float(setpoint().values[place]) * scale

    def mode(place: int) -> Getter:
        return lambda: int(setpoint().mode[place])

    found: dict[str, Getter] = {}
    for start, prefix in ((0, ""), (3, "v"), (6, "a")):
        for place, axis in enumerate(_AXES):
            found[f"ctrltarget.{prefix}{axis}"] = target(start + place)
            found[f"ctrltargetZ.{prefix}{axis}"] = target(start + place, 1000)
    for place, name in ((ROLL, "roll"), (PITCH, "pitch"), (YAW, "yaw")):
        found[f"ctrltarget.{name}"] = target(place, 180 / np.pi)
    for place, name in enumerate(("x", "y", "z", "roll", "pitch", "yaw", "quat")):
        found[f"ctrltarget.mode_{name}"] = mode(place)
    return found


def _motors(loop: Loop, voltage: Callable[[], float], airframe: Airframe) -> dict[str, Getter]:
    def pwm(place: int) -> Getter:
        return lambda: compensated_pwm(float(loop.motors[place]) / FULL_COMMAND, voltage(), airframe)

    found: dict[str, Getter] = {f"motor.m{place + 1}": pwm(place) for place in range(4)}
    for place, name in enumerate(("thrust", "roll", "pitch", "yaw")):
        found[f"controller.cmd_{name}"] = _element(loop.control, place)
        found[f"ctrlMel.cmd_{name}"] = _element(loop.control, place)
    found["stabilizer.thrust"] = _element(loop.control, 0)
    return found


def _power(voltage: Callable[[], float]) -> dict[str, Getter]:
    empty, full = _BATTERY_LEVELS
    return {
        "pm.vbat": voltage,
        "pm.vbatMV": lambda: voltage() * 1000,
        "pm.batteryLevel": lambda: float(np.clip(100 * (voltage() - empty) / (full - empty), 0, 100)),
    }
