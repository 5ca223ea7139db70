"""Third-party rigid bodies, RotorPy's and those of drone-models, with the interface of cfplan's own.

Each takes a state as in `engine/layout.py`, (17,), and each motor's commanded thrust, (4,) N, and returns the
state a while later. Both packages have rotor speeds where cfplan has thrusts; the curve of thrust over speed is known,
so they are equivalent.

RotorPy: S. Folk, J. Paulos, V. Kumar, "RotorPy: A Python-based Multirotor Simulator with Aerodynamics for Education and
Research", arXiv:2306.04485. drone-models: M. Rath, M. Schuck, first-principles model with parameters identified on
flying vehicles.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.flight.firmware import gains_for
from cfplan.flight.setpoints.encoding import EncodedFlight
from cfplan.flight.setpoints.packets import decode
from cfplan.simulation.dry_run import SETTLING
from cfplan.simulation.engine.body import TIME_STEP
from cfplan.simulation.engine.layout import (
    ASKED,
    BODY_RATE,
    MOTORS,
    POSITION,
    QUATERNION,
    SETPOINT,
    SETPOINT_SIZE,
    STATE_SIZE,
    VELOCITY,
    hovering,
    new_vehicle,
    pack_airframe,
    setpoint_rows,
)
from cfplan.simulation.engine.mellinger import CONTROL_PERIOD, FULL_STATE, fly_mellinger
from cfplan.vehicle.airframe import MOTOR_TORQUE_SIGNS, Airframe
from cfplan.vehicle.trajectory import Trajectory

BodyStep = Callable[[NDArray, NDArray, float], NDArray]
"""From a state (17,), motor commands (4,) N and a duration, s, to the state then."""

THRUST_COEFFICIENT = (
    2.3e-8  # N s², by which RotorPy's rotors turn; drag is set for the airframe's, so any value would do
)
IDENTIFIED = {
    "crazyflie-2.1+": "cf2x_P250", "crazyflie-thrust-upgrade": "cf2x_T350", "crazyflie-2.1-brushless": "cf21B_500",
}  # airframes whose numbers are those of drone-models  # fmt: skip
_MOST_STEP = 0.001  # s, of the Runge-Kutta integration of drone-models
_SCIPY_FLAG = "SCIPY_ARRAY_API"


def fly_on(
    step: BodyStep, encoded: EncodedFlight, trajectory: Trajectory, airframe: Airframe
) -> tuple[NDArray, NDArray]:
    """Return times, (N,) s every CONTROL_PERIOD, and positions, (N, 3) m, of a body that receives the dry run's bytes.

    It hovers at first; the firmware's controller, with the gains for `airframe`, sees the true state.
    """
    start, rows = trajectory.at(0.0), setpoint_rows(decode(encoded.payloads))
    vehicle = new_vehicle(hovering(airframe, start.position, float(start.yaw)), pack_airframe(airframe))
    gains, steps = gains_for(airframe).pack(), round(CONTROL_PERIOD / TIME_STEP)
    count = round((encoded.duration + SETTLING) / TIME_STEP) // steps + 1
    arrivals = np.round(encoded.times / TIME_STEP).astype(np.int64)
    newest = np.maximum(np.searchsorted(arrivals, steps * np.arange(count), side="right") - 1, 0)
    positions = np.empty((count, 3))
    for n in range(count):
        positions[n] = vehicle[POSITION]
        vehicle[SETPOINT : SETPOINT + SETPOINT_SIZE] = rows[newest[n]]
        fly_mellinger(vehicle, gains, FULL_STATE)
        vehicle[:STATE_SIZE] = step(vehicle[:STATE_SIZE], vehicle[ASKED : ASKED + 4], CONTROL_PERIOD)
    return CONTROL_PERIOD * np.arange(count), positions


def rotorpy_body(airframe: Airframe, lag: float) -> BodyStep:
    """Return RotorPy's multirotor with the airframe's numbers, and motors whose speed follows with that lag, s.

    Drag grows with rotor speed as RotorPy has it, and is the airframe's at hover. Raises InputError where RotorPy is
    not installed.
    """
    try:
        from rotorpy.vehicles.multirotor import Multirotor
    except ImportError:
        raise InputError("RotorPy is not installed", hint="pip install rotorpy==3.0.0") from None
    vehicle = Multirotor(_rotorpy_parameters(airframe, lag), aero=any(airframe.drag))

    def step(state: NDArray, asked: NDArray, seconds: float) -> NDArray:
        theirs = {
            "x": state[POSITION], "v": state[VELOCITY], "q": state[QUATERNION], "w": state[BODY_RATE],
            "wind": np.zeros(3), "rotor_speeds": np.sqrt(state[MOTORS] / THRUST_COEFFICIENT),
        }  # fmt: skip
        speeds = np.sqrt(np.maximum(asked, 0.0) / THRUST_COEFFICIENT)
        moved = vehicle.step(theirs, {"cmd_motor_speeds": speeds}, seconds)
        thrust = THRUST_COEFFICIENT * moved["rotor_speeds"] ** 2
        return np.concatenate([moved["x"], moved["v"], moved["q"], moved["w"], thrust])

    return step


def _rotorpy_parameters(airframe: Airframe, lag: float) -> dict[str, Any]:
    arm, (jx, jy, jz) = airframe.arm, airframe.inertia
    places = np.array([[1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]]) * arm  # in the order of motors, x forward
    hover = (airframe.hover_thrust / THRUST_COEFFICIENT) ** 0.5
    return {
        "mass": airframe.mass, "Ixx": jx, "Iyy": jy, "Izz": jz, "Ixy": 0.0, "Ixz": 0.0, "Iyz": 0.0, "num_rotors": 4,
        "rotor_pos": {f"r{k + 1}": place for k, place in enumerate(places)},
        "rotor_directions": MOTOR_TORQUE_SIGNS[2],
        "rotor_speed_min": 0.0, "rotor_speed_max": (airframe.motor_thrust_max / THRUST_COEFFICIENT) ** 0.5,
        "k_eta": THRUST_COEFFICIENT, "k_m": THRUST_COEFFICIENT * airframe.thrust_to_torque, "tau_m": lag,
        "k_d": airframe.drag[0] / (4 * hover), "k_z": airframe.drag[1] / (4 * hover),
    }  # fmt: skip


def identified_body(airframe: Airframe) -> BodyStep:
    """Return the first-principles model of drone-models with the parameters that were identified for the airframe.

    Rotors spin up and down by different laws, quadratic in speed, and have inertia. Raises InputError where
    drone-models is not installed, or does not know the airframe.
    """
    if airframe.name not in IDENTIFIED:
        raise InputError(f"drone-models does not know {airframe.name}", hint=f"known: {', '.join(IDENTIFIED)}")
    try:
        with _array_api():
            from drone_models import parametrize
            from drone_models.first_principles import symbolic_dynamics
    except ImportError:
        raise InputError("drone-models is not installed", hint="pip install drone-models==0.1.0") from None
    import casadi

    model = parametrize(symbolic_dynamics, drone_model=IDENTIFIED[airframe.name])
    change, state, asked, _ = model()
    changes = casadi.Function("changes", [state, asked], [change])
    offset, slope, bend = model.keywords["rpm2thrust"]

    def derivative(theirs: NDArray, command: NDArray) -> NDArray:
        found: NDArray = changes(theirs, command).full().ravel()
        found[3:7] = _turning(theirs[3:7], theirs[10:13])  # theirs has another order of components: 0.1.0's mistake
        return found

    def speed_of(thrust: NDArray) -> NDArray:
        return np.asarray((-slope + np.sqrt(slope**2 + 4 * bend * (np.maximum(thrust, 0.0) - offset))) / (2 * bend))

    def step(state: NDArray, asked: NDArray, seconds: float) -> NDArray:
        command = speed_of(np.clip(asked, 0.0, airframe.motor_thrust_max))
        count = int(np.ceil(seconds / _MOST_STEP - 1e-9))
        theirs = _to_rotorpy(state, speed_of(state[MOTORS]))
        for _ in range(count):
            theirs = _runge_kutta(lambda x: derivative(x, command), theirs, seconds / count)
            theirs[3:7] /= np.linalg.norm(theirs[3:7])
        return _from_rotorpy(theirs, offset + slope * theirs[13:] + bend * theirs[13:] ** 2)

    return step


def _to_rotorpy(state: NDArray, speeds: NDArray) -> NDArray:
    """Return position, quaternion, velocity, body rate and rotor speeds, as drone-models orders them, (17,)."""
    return np.concatenate([state[POSITION], state[QUATERNION], state[VELOCITY], state[BODY_RATE], speeds])


def _from_rotorpy(theirs: NDArray, thrust: NDArray) -> NDArray:
    state = np.empty(STATE_SIZE)
    state[POSITION], state[QUATERNION], state[VELOCITY] = theirs[:3], theirs[3:7], theirs[7:10]
    state[BODY_RATE], state[MOTORS] = theirs[10:13], thrust
    return state


def _turning(quaternion: NDArray, rate: NDArray) -> NDArray:
    """Return dq/dt, (4,) x y z w, of a body that turns at a rate in body axes, (3,) rad/s."""
    x, y, z, w = quaternion
    p, q, r = rate
    return 0.5 * np.array([
        w * p + y * r - z * q, w * q + z * p - x * r, w * r + x * q - y * p, -x * p - y * q - z * r,
    ])  # fmt: skip


def _runge_kutta(derivative: Callable[[NDArray], NDArray], x: NDArray, step: float) -> NDArray:
    """Step by the classical fourth-order Runge-Kutta method."""
    first = derivative(x)
    second = derivative(x + step / 2 * first)
    third = derivative(x + step / 2 * second)
    fourth = derivative(x + step * third)
    return np.asarray(x + step / 6 * (first + 2 * second + 2 * third + fourth))


@contextmanager
def _array_api() -> Iterator[None]:
    """Set the flag that drone-models requires at import, though its numeric functions do not need it."""
    before = os.environ.get(_SCIPY_FLAG)
    os.environ[_SCIPY_FLAG] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_SCIPY_FLAG]
        else:
            os.environ[_SCIPY_FLAG] = before
