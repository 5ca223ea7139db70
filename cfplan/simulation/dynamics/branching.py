"""Simulations that branch off a flight: vehicle, controller and motor commands at one moment as one flat array.

    snapshot (31,)  state of the vehicle 0:17 as in `body`, memory of the controller 17:27 as in `mellinger`, and the
                    thrust asked of each motor 27:31 N

What a flight does after any of its setpoints is simulated from a copy of the snapshot at that moment.
"""

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.setpoints.packets import FullStateSetpoints
from cfplan.machine_code import njit
from cfplan.simulation.dynamics.body import STATE_SIZE, THRUST_MAX, TIME_STEP, hovering, step_body
from cfplan.simulation.dynamics.mellinger import (
    CONTROL_PERIOD,
    FULL_COMMAND,
    MEMORY_SIZE,
    SETPOINT_SIZE,
    distribute_power,
    step_controller,
)
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.rotations import yaw_of

MEMORY, THRUSTS = STATE_SIZE, STATE_SIZE + MEMORY_SIZE  # where they begin in a snapshot
SNAPSHOT_SIZE = THRUSTS + 4
STEPS_A_CONTROL = round(CONTROL_PERIOD / TIME_STEP)


def setpoint_rows(setpoints: FullStateSetpoints) -> NDArray:
    """Return (N, 20): full-state setpoints as the controller takes them."""
    rows = np.zeros((len(setpoints.position), SETPOINT_SIZE))
    rows[:, 0:3], rows[:, 3:6], rows[:, 6:9] = setpoints.position, setpoints.velocity, setpoints.acceleration
    rows[:, 9:13], rows[:, 13:16] = setpoints.quaternion, setpoints.body_rate
    return rows


def arrival_steps(count: int, rate: float) -> NDArray:
    """Return the step, of TIME_STEP, at which each setpoint at `rate`, Hz, arrives; and of one more, (count + 1,)."""
    return np.round(np.arange(count + 1) / (rate * TIME_STEP)).astype(np.int64)


def hovering_snapshot(airframe: Airframe, setpoints: FullStateSetpoints) -> NDArray:
    """Return the snapshot, (31,), of a vehicle that hovers where the first setpoint is."""
    snapshot = np.zeros(SNAPSHOT_SIZE)
    snapshot[:STATE_SIZE] = hovering(airframe, setpoints.position[0], float(yaw_of(setpoints.quaternion[0])))
    snapshot[THRUSTS:] = airframe.hover_thrust
    return snapshot


@njit(allocates=False)
def step_control(
    snapshot: NDArray,
    believed: NDArray,
    gains: NDArray,
    setpoint: NDArray,
    mode: NDArray,
    body: NDArray,
    period: float,
    control: NDArray,
    motors: NDArray,
) -> None:
    """Step the controller of a snapshot by `period`, s, on the state that it believes, (17,): asks for thrusts.

    `control` (4,) and `motors` (4,) are overwritten.
    """
    step_controller(control, snapshot[MEMORY:THRUSTS], gains, setpoint, mode, believed, period)
    distribute_power(control, motors)
    for k in range(4):
        snapshot[THRUSTS + k] = motors[k] * (body[THRUST_MAX] / FULL_COMMAND)


@njit(allocates=False)
def step_vehicle(snapshot: NDArray, body: NDArray, wind: NDArray, efficiency: NDArray) -> None:
    """Advance the vehicle of a snapshot by one step of `body`, with the thrusts that its controller asked for."""
    step_body(snapshot[:MEMORY], snapshot[THRUSTS:], body, wind, efficiency)
