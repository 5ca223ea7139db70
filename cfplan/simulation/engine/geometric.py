"""A geometric controller as in the paper's simulations, in closed loop with the body, compiled.

Lee, Leok and McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)" (2010), with attitude by the Hopf
fibration (Watterson and Kumar, 2019) and the gains of TOPPQuad's Table III. Body rate and angular acceleration of the
reference are fed forward. It knows the true state, and the motors' range limits only their thrust, not its commands.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.simulation.engine.body import TIME_STEP, step_body
from cfplan.simulation.engine.layout import ASKED, POSITION, STATE_SIZE, new_vehicle, pack_airframe
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.rotations import axes_of, hopf_quaternion
from cfplan.vehicle.trajectory import FullState

CONTROL_STEPS = 2  # of the body, per step of the controller: 500 Hz
# Of the reference: position and velocity 0:6, specific thrust with its direction 6:9, Hopf yaw, body rate, and angular
# acceleration in body axes.
FORCE, YAW, RATE, TURNING, REFERENCE_SIZE = 6, 9, 10, 13, 16
POSITION_GAINS = (8.0, 8.0, 19.0)  # 1/s²
VELOCITY_GAINS = (5.5, 5.5, 8.7)  # 1/s
ATTITUDE_GAINS = (2812.0, 2812.0, 163.0)  # 1/s²
RATE_GAINS = (128.0, 128.0, 73.0)  # 1/s
BodyStep = Callable[[NDArray, NDArray, float], NDArray]  # as in `other_bodies`
_Believed = tuple[NDArray, NDArray, float]  # inertia (3,), thrusts from a wrench (4, 4), mass
_GAINS = np.array([POSITION_GAINS, VELOCITY_GAINS, ATTITUDE_GAINS, RATE_GAINS])


@dataclass(frozen=True, slots=True)
class GeometricFlight:
    """The vehicle's motion, every millisecond from the start to the end."""

    time: NDArray  # (N,) s
    states: NDArray  # (N, 17) as in `layout`
    asked: NDArray  # (N, 4) N, commanded thrust of each motor, not limited to its range


def reference_rows(state: FullState) -> NDArray:
    """Return the controller's reference, (N, 16), from a trajectory's full state at N times."""
    force = state.specific_thrust[:, None] * state.thrust_axis
    columns = (
        state.position, state.velocity, force, state.yaw[:, None], state.body_rate, state.angular_acceleration
    )  # fmt: skip
    return np.concatenate(columns, axis=1)


def follow(reference: NDArray, airframe: Airframe, start: NDArray) -> GeometricFlight:
    """Follow the reference, (K, 16), each row for 2 ms, from the state `start`, (17,), without a floor.

    If the simulation diverges, states are not finite from then on.
    """
    steps = CONTROL_STEPS * len(reference)
    states, asked = np.empty((steps + 1, STATE_SIZE)), np.zeros((steps + 1, 4))
    vehicle = new_vehicle(start, pack_airframe(airframe, floor=-np.inf))
    _follow(states, asked, reference, vehicle, _packed(airframe))
    return GeometricFlight(np.arange(steps + 1) * TIME_STEP, states, asked)


def follow_by(step: BodyStep, reference: NDArray, airframe: Airframe, start: NDArray) -> NDArray:
    """Return positions, (K, 3) m, of another body that the controller flies along the reference, as `follow` does."""
    state, command, positions = start.copy(), np.zeros(4), np.empty((len(reference), 3))
    packed = _packed(airframe)
    for row, wanted in enumerate(reference):
        positions[row] = state[POSITION]
        if not np.isfinite(state).all():
            positions[row:] = np.nan
            break
        _control(command, wanted, state, packed)
        state = step(state, command, CONTROL_STEPS * TIME_STEP)
    return positions


def _packed(airframe: Airframe) -> _Believed:
    """Return inertia, thrusts from a wrench (4, 4), and mass."""
    return np.array(airframe.inertia), np.linalg.inv(airframe.mixing), airframe.mass


@njit(error_model="numpy")
def _follow(states: NDArray, asked: NDArray, reference: NDArray, vehicle: NDArray, believed: _Believed) -> None:
    for row in range(len(reference)):
        _control(vehicle[ASKED : ASKED + 4], reference[row], vehicle, believed)
        for k in range(CONTROL_STEPS):
            step = CONTROL_STEPS * row + k
            states[step] = vehicle[:STATE_SIZE]
            asked[step] = vehicle[ASKED : ASKED + 4]
            step_body(vehicle, TIME_STEP)
    states[-1], asked[-1] = vehicle[:STATE_SIZE], vehicle[ASKED : ASKED + 4]


@njit(error_model="numpy")
def _control(command: NDArray, wanted: NDArray, state: NDArray, believed: _Believed) -> None:
    """Write the commanded thrust of each motor, (4,) N."""
    inertia, thrusts, mass = believed
    force, error, rate, turning, wrench = np.empty(3), np.empty(3), np.zeros(3), np.zeros(3), np.zeros(4)
    for k in range(3):
        force[k] = wanted[FORCE + k] + _GAINS[0, k] * (wanted[k] - state[k])
        force[k] += _GAINS[1, k] * (wanted[3 + k] - state[3 + k])
    size = np.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    half = 0.5 * wanted[YAW]
    aim = hopf_quaternion((force[0] / size, force[1] / size, force[2] / size), np.cos(half), np.sin(half))
    axes: NDArray = np.array(axes_of(state[6], state[7], state[8], state[9]))  # one per row
    aimed: NDArray = np.array(axes_of(aim[0], aim[1], aim[2], aim[3]))
    relative = aimed @ axes.T  # the body's axes in the desired axes, one per column
    error[0] = 0.5 * (relative[2, 1] - relative[1, 2])
    error[1] = 0.5 * (relative[0, 2] - relative[2, 0])
    error[2] = 0.5 * (relative[1, 0] - relative[0, 1])
    spin = np.cross(state[10:13], inertia * state[10:13])
    for k in range(3):
        wrench[0] += mass * force[k] * axes[2, k]
        for j in range(3):
            rate[k] += relative[j, k] * wanted[RATE + j]
            turning[k] += relative[j, k] * wanted[TURNING + j]
        feedback = _GAINS[2, k] * error[k] + _GAINS[3, k] * (state[10 + k] - rate[k])
        wrench[1 + k] = inertia[k] * (turning[k] - feedback) + spin[k]
    for motor in range(4):
        command[motor] = 0.0
        for k in range(4):
            command[motor] += thrusts[motor, k] * wrench[k]
