"""Vehicles side by side: up to WIDTH of them at once, each stepped as branching.py steps one, to the last bit the same.

A panel holds rows of one quantity each, WIDTH long, one behind the other in one array, so the compiler knows that they
do not overlap, and works on several vehicles with one instruction. How many places of the rows are in use is known at
run time only, else it would write the loops out. Its first rows are those of a snapshot; a setpoint comes behind them.
Sines and cosines are taken one by one, from the same library, as others would round otherwise.
"""

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.simulation.dynamics.body import (
    FLOOR,
    FULL_EFFICIENCY,
    STEP,
    STILL_AIR,
    THRUST_MAX,
    Parameters,
    accelerated,
    along_axes,
    lag_share,
    lift_of,
    rest,
    spun_up,
    turn_of,
    turned,
    turned_faster,
    twist_of,
)
from cfplan.simulation.dynamics.branching import MEMORY, SNAPSHOT_SIZE, THRUSTS, step_vehicle
from cfplan.simulation.dynamics.mellinger import (
    FULL_COMMAND,
    Gains,
    command_of,
    direction,
    force_of,
    level_force_of,
    mixed,
    moments_of,
    pull_of,
    thrust_along,
)
from cfplan.vehicle.rotations import Vector, axes_of, heading_of

WIDTH = 32
LANES = 8  # vehicles that the compiler may want to take at once
# Rows of a panel behind those of a snapshot.
PLACE = SNAPSHOT_SIZE  # m, of the setpoint
SPEED = PLACE + 3  # m/s, its velocity
_ACCELERATION, _HEADING, _RATE = PLACE + 6, PLACE + 9, PLACE + 11  # its acceleration, cosine and sine of yaw, body rate
MISSED = PLACE + 14  # m in x and y, m/s in x and y, that the controller's estimate falls behind the motion
_TURN = PLACE + 18  # rad/s, half an angle, its sine and cosine
OWN = PLACE + 22  # rows of whoever steps the vehicles
OWN_ROWS = 7
_ROWS = OWN + OWN_ROWS


@register_jitable
def new_panel() -> NDArray:
    """Return a panel without vehicles."""
    return np.zeros(_ROWS * WIDTH)


@register_jitable
def write_snapshot(panel: NDArray, n: int, snapshot: NDArray) -> None:
    """Put a vehicle as in a snapshot, (31,), at place n."""
    for row in range(SNAPSHOT_SIZE):
        panel[row * WIDTH + n] = snapshot[row]


@register_jitable
def read_snapshot(snapshot: NDArray, panel: NDArray, n: int) -> None:
    """Write the snapshot, (31,), of the vehicle at place n."""
    for row in range(SNAPSHOT_SIZE):
        snapshot[row] = panel[row * WIDTH + n]


@register_jitable
def write_setpoint(panel: NDArray, n: int, setpoint: NDArray) -> None:
    """Give the vehicle at place n a full-state setpoint, (20,)."""
    for k in range(9):
        panel[(PLACE + k) * WIDTH + n] = setpoint[k]
    x, y = heading_of((setpoint[9], setpoint[10], setpoint[11], setpoint[12]))
    panel[_HEADING * WIDTH + n], panel[(_HEADING + 1) * WIDTH + n] = direction(x, y)
    for k in range(3):
        panel[(_RATE + k) * WIDTH + n] = setpoint[13 + k]


@register_jitable
def move(panel: NDArray, to: int, n: int) -> None:
    """Put the vehicle at place n at another."""
    for row in range(_ROWS):
        panel[row * WIDTH + to] = panel[row * WIDTH + n]


@register_jitable
def level_out_all(panel: NDArray, lanes: int) -> None:
    """Let the setpoints ask for no yaw rate, as the supervisor does when it levels out."""
    for n in range(lanes):
        panel[(_RATE + 2) * WIDTH + n] = 0.0


@register_jitable
def stop_motors(panel: NDArray, lanes: int) -> None:
    """Ask all motors for nothing."""
    for k in range(4):
        for n in range(lanes):
            panel[(THRUSTS + k) * WIDTH + n] = 0.0


@register_jitable(forceinline=True)
def _vector(panel: NDArray, row: int, n: int) -> Vector:
    return panel[row * WIDTH + n], panel[(row + 1) * WIDTH + n], panel[(row + 2) * WIDTH + n]


@register_jitable(forceinline=True)
def _write(panel: NDArray, row: int, n: int, vector: Vector) -> None:
    panel[row * WIDTH + n], panel[(row + 1) * WIDTH + n], panel[(row + 2) * WIDTH + n] = vector


@njit(allocates=False, error_model="numpy")
def step_controls(panel: NDArray, lanes: int, gains: Gains, body: Parameters, levels: bool, period: float) -> None:
    """Step the controllers of all vehicles by `period`, s: by full-state setpoints, or levelling out."""
    scale = body[THRUST_MAX] / FULL_COMMAND
    if levels:
        _level_controls(panel, whole(lanes), gains, scale, period)
    else:
        _full_controls(panel, whole(lanes), gains, scale, period)


@register_jitable
def _full_controls(panel: NDArray, lanes: int, gains: Gains, scale: float, period: float) -> None:
    lanes = min(lanes, WIDTH)  # the compiler must see that no index overflows
    for n in range(lanes):
        _step_control(panel, n, gains, scale, False, period)


@register_jitable
def _level_controls(panel: NDArray, lanes: int, gains: Gains, scale: float, period: float) -> None:
    lanes = min(lanes, WIDTH)
    for n in range(lanes):
        _step_control(panel, n, gains, scale, True, period)


@register_jitable(forceinline=True)
def _step_control(panel: NDArray, n: int, gains: Gains, scale: float, levels: bool, period: float) -> None:
    x, y, z = _vector(panel, 0, n)
    vx, vy, vz = _vector(panel, 3, n)
    (place_x, place_y, place_z), (speed_x, speed_y, speed_z) = _vector(panel, PLACE, n), _vector(panel, SPEED, n)
    missed_x, missed_y, missed_vx = _vector(panel, MISSED, n)
    x, y, vx, vy = x - missed_x, y - missed_y, vx - missed_vx, vy - panel[(MISSED + 3) * WIDTH + n]
    sum_x, sum_y, sum_z = _vector(panel, MEMORY, n)
    pull_x, sum_x = pull_of(gains, False, place_x - x, speed_x - vx, sum_x, period)
    pull_y, sum_y = pull_of(gains, False, place_y - y, speed_y - vy, sum_y, period)
    pull_z, sum_z = pull_of(gains, True, place_z - z, speed_z - vz, sum_z, period)

    qx, qy, qz = _vector(panel, 6, n)
    turn = axes_of(qx, qy, qz, panel[9 * WIDTH + n])
    if levels:
        force, yaw = level_force_of(gains, pull_z), direction(turn[0][0], turn[0][1])
    else:
        force = force_of(gains, (pull_x, pull_y, pull_z), _vector(panel, _ACCELERATION, n))
        yaw = panel[_HEADING * WIDTH + n], panel[(_HEADING + 1) * WIDTH + n]
    thrust, desired = thrust_along(force, turn, yaw)
    last_x, last_y, last_wanted_x = _vector(panel, MEMORY + 6, n)
    (roll, pitch, spin), errors, last = moments_of(
        gains, turn, desired, _vector(panel, 10, n), _vector(panel, _RATE, n), _vector(panel, MEMORY + 3, n),
        (last_x, last_y, last_wanted_x, panel[(MEMORY + 9) * WIDTH + n]), period,
    )  # fmt: skip
    command = command_of(gains, thrust)
    flies = command > 0.0
    roll, pitch, spin = (roll if flies else 0.0), (pitch if flies else 0.0), (spin if flies else 0.0)
    sum_x, sum_y, sum_z = (sum_x if flies else 0.0), (sum_y if flies else 0.0), (sum_z if flies else 0.0)
    error_x, error_y, error_z = errors
    error_x, error_y, error_z = (error_x if flies else 0.0), (error_y if flies else 0.0), (error_z if flies else 0.0)
    _write(panel, MEMORY, n, (sum_x, sum_y, sum_z))
    _write(panel, MEMORY + 3, n, (error_x, error_y, error_z))
    _write(panel, MEMORY + 6, n, (last[0], last[1], last[2]))
    panel[(MEMORY + 9) * WIDTH + n] = last[3]
    motors = mixed(command, (roll, pitch, spin))
    _write(panel, THRUSTS, n, (motors[0] * scale, motors[1] * scale, motors[2] * scale))
    panel[(THRUSTS + 3) * WIDTH + n] = motors[3] * scale


@njit(allocates=False, error_model="numpy")
def step_vehicles(panel: NDArray, lanes: int, body: Parameters, as_array: NDArray, spare: NDArray) -> None:
    """Advance all vehicles by one step of `body`, in still air, with the thrusts that their controllers asked for.

    The body's parameters come as a tuple and `as_array`. Those on the floor are stepped one by one; `spare`, (WIDTH,
    31), is overwritten.
    """
    on_floor = 0
    for n in range(lanes):
        on_floor += panel[2 * WIDTH + n] <= body[FLOOR]
    if on_floor > 0:
        for n in range(lanes):
            read_snapshot(spare[n], panel, n)
    _step_in_air(panel, lanes, body)
    below = 0
    for n in range(lanes):
        below += panel[2 * WIDTH + n] < body[FLOOR]
    if on_floor + below > 0:
        for n in range(lanes):
            if on_floor > 0 and spare[n, 2] <= body[FLOOR]:
                step_vehicle(spare[n], as_array, STILL_AIR, FULL_EFFICIENCY)
                write_snapshot(panel, n, spare[n])
            elif panel[2 * WIDTH + n] < body[FLOOR]:
                read_snapshot(spare[n], panel, n)
                rest(spare[n], as_array)
                write_snapshot(panel, n, spare[n])


@register_jitable
def _step_in_air(panel: NDArray, lanes: int, body: Parameters) -> None:
    _accelerate_all(panel, whole(lanes), body)
    for n in range(lanes):
        half = panel[(_TURN + 1) * WIDTH + n]
        panel[(_TURN + 2) * WIDTH + n], panel[(_TURN + 3) * WIDTH + n] = np.sin(half), np.cos(half)
    _turn_all(panel, whole(lanes), body[STEP])


@register_jitable
def _accelerate_all(panel: NDArray, lanes: int, body: Parameters) -> None:
    lanes, lag = min(lanes, WIDTH), lag_share(body)
    for n in range(lanes):
        _accelerate(panel, n, body, lag)


@register_jitable
def _turn_all(panel: NDArray, lanes: int, step: float) -> None:
    lanes = min(lanes, WIDTH)
    for n in range(lanes):
        _turn(panel, n, step)


@register_jitable(forceinline=True)
def _accelerate(panel: NDArray, n: int, body: Parameters, lag: float) -> None:
    asked_0, asked_1, asked_2 = _vector(panel, THRUSTS, n)
    push_0, push_1, push_2 = _vector(panel, 13, n)
    push_0, change_0 = spun_up(push_0, asked_0, body, lag)
    push_1, change_1 = spun_up(push_1, asked_1, body, lag)
    push_2, change_2 = spun_up(push_2, asked_2, body, lag)
    push_3, change_3 = spun_up(panel[16 * WIDTH + n], panel[(THRUSTS + 3) * WIDTH + n], body, lag)
    _write(panel, 13, n, (push_0, push_1, push_2))
    panel[16 * WIDTH + n] = push_3
    qx, qy, qz = _vector(panel, 6, n)
    axes = axes_of(qx, qy, qz, panel[9 * WIDTH + n])
    rate, velocity = _vector(panel, 10, n), _vector(panel, 3, n)
    air = along_axes(velocity, axes)
    lift = lift_of(air, body)
    push_0, push_1, push_2, push_3 = push_0 * lift, push_1 * lift, push_2 * lift, push_3 * lift
    pushes = push_0, push_1, push_2, push_3
    twists = (
        twist_of(push_0, change_0, body), twist_of(push_1, change_1, body), twist_of(push_2, change_2, body),
        twist_of(push_3, change_3, body),
    )  # fmt: skip
    rate = turned_faster(rate, air, pushes, twists, body)
    velocity = accelerated(velocity, air, axes, pushes, body)
    _write(panel, 10, n, rate)
    _write(panel, 3, n, velocity)
    x, y, z = _vector(panel, 0, n)
    step = body[STEP]
    _write(panel, 0, n, (x + step * velocity[0], y + step * velocity[1], z + step * velocity[2]))
    panel[_TURN * WIDTH + n], panel[(_TURN + 1) * WIDTH + n] = turn_of(rate, step)


@register_jitable(forceinline=True)
def _turn(panel: NDArray, n: int, step: float) -> None:
    qx, qy, qz = _vector(panel, 6, n)
    size, half, sin = _vector(panel, _TURN, n)
    attitude = qx, qy, qz, panel[9 * WIDTH + n]
    qx, qy, qz, qw = turned(attitude, _vector(panel, 10, n), size, half, sin, panel[(_TURN + 3) * WIDTH + n], step)
    _write(panel, 6, n, (qx, qy, qz))
    panel[9 * WIDTH + n] = qw


@register_jitable
def whole(count: int) -> int:
    """Return the number of places to work on: whole vectors, unless one or two vehicles are done sooner alone."""
    return count if count <= 2 else (count + LANES - 1) // LANES * LANES


@register_jitable
def unpacked_body(body: NDArray) -> Parameters:
    """Return the parameters of a body, (19,), as a tuple, which the compiler knows not to change."""
    return (
        body[0], body[1], body[2], body[3], body[4], body[5], body[6], body[7], body[8], body[9], body[10], body[11],
        body[12], body[13], body[14], body[15], body[16],
        body[17], body[18],
    )  # fmt: skip


@register_jitable
def unpacked_gains(gains: NDArray) -> Gains:
    """Return gains, (19,), as a tuple, which the compiler knows not to change."""
    return (
        gains[0], gains[1], gains[2], gains[3], gains[4], gains[5], gains[6], gains[7], gains[8], gains[9], gains[10],
        gains[11], gains[12], gains[13], gains[14], gains[15], gains[16], gains[17], gains[18],
    )  # fmt: skip
