"""The vehicle left alone with its last setpoint, to the floor: compiled, for many such moments side by side.

A branch begins from a snapshot of a flight, at the moment at which a setpoint arrives. From there the vehicle holds
that setpoint, levels out, settles, and its motors stop; or they stop at once. What it sweeps is a box, which the drift
that `wrong` makes widens: (4,), a push to a side, m/s², the damping of that motion, 1/s, an error of the vertical
acceleration, m/s², and a speed to a side, m/s. The bodies after the setpoint, (1 + F, 13), are that of the vehicle
which goes on alone and those of the ones that fall.

Where obstacles matter, the sweep is cut into several boxes, each for PART s after the setpoint and the last for the
rest: one box around a diagonal way holds much that the vehicle never reaches.
"""

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.simulation.dynamics.body import (
    AXIAL_DRAG,
    DRAG,
    FULL_EFFICIENCY,
    LAG,
    MASS,
    STEP,
    STILL_AIR,
    THRUST_MAX,
    Parameters,
)
from cfplan.simulation.dynamics.branching import (
    MEMORY,
    SNAPSHOT_SIZE,
    STEPS_A_CONTROL,
    step_control,
    step_vehicle,
)
from cfplan.simulation.dynamics.mellinger import CONTROL_PERIOD, FULL_STATE, SETPOINT_SIZE, Gains
from cfplan.simulation.dynamics.side_by_side import (
    OWN,
    PLACE,
    SPEED,
    WIDTH,
    level_out_all,
    move,
    new_panel,
    read_snapshot,
    step_controls,
    step_vehicles,
    stop_motors,
    unpacked_body,
    unpacked_gains,
    whole,
    write_setpoint,
    write_snapshot,
)
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import axes_of

PUSH, DAMPING, LIFT, DRIFT = range(4)  # as what the vehicle has wrong is packed
PART = 0.15  # s of a sweep in one box
_LONGEST = 4.0  # s that are simulated after the last setpoint, unless the vehicle lies on the floor before
_SETTLED_AFTER = 0.5  # s of level-out, after which a vehicle that hardly turns has settled
_SETTLED_RATE = 0.2  # rad/s, below which it hardly turns
_COAST_STEP = 0.01  # s, of the place alone


@njit(nogil=True)
def fly_to_each(
    snapshots: NDArray, setpoints: NDArray, start: NDArray, gains: NDArray, body: NDArray, arrivals: NDArray
) -> None:
    """Fly setpoints, (N, 20), from a snapshot; write the snapshots, (N, 31), at the moments at which each arrives."""
    now, control, motors, full_state = start.copy(), np.zeros(4), np.zeros(4), FULL_STATE.copy()
    for newest in range(len(setpoints)):
        for k in range(SNAPSHOT_SIZE):
            snapshots[newest, k] = now[k]
        if newest + 1 < len(setpoints):
            for step in range(arrivals[newest], arrivals[newest + 1]):
                if step % STEPS_A_CONTROL == 0:
                    step_control(now, now, gains, setpoints[newest], full_state, body, CONTROL_PERIOD, control, motors)
                step_vehicle(now, body, STILL_AIR, FULL_EFFICIENCY)


@njit(nogil=True, error_model="numpy")
def leave_alone_in_stops(
    swept: NDArray,
    stops: NDArray,
    starts: NDArray,
    forks: NDArray,
    gains: NDArray,
    body: NDArray,
    later_bodies: NDArray,
    level_after: int,
    off_after: int,
    arrivals: NDArray,
    wrong: NDArray,
) -> None:
    """Fly stops, (K, M, 20), each from a snapshot, (K, 31); leave the vehicle alone where `forks`, (K, M), says so.

    Write the boxes, (F, S, 2, 3), of one fork after another.
    """
    length = stops.shape[1]
    snapshots, setpoints = np.empty((WIDTH * length, SNAPSHOT_SIZE)), np.empty((WIDTH * length, SETPOINT_SIZE))
    panel, spare, stop = new_panel(), np.empty((WIDTH, SNAPSHOT_SIZE)), np.empty(WIDTH, dtype=np.int64)
    last, number = np.empty(WIDTH, dtype=np.int64), np.empty(WIDTH, dtype=np.int64)
    the_gains, the_body, done = unpacked_gains(gains), unpacked_body(body), 0
    for first in range(0, len(stops), WIDTH):
        lanes, count = 0, 0
        for k in range(first, min(first + WIDTH, len(stops))):
            end = -1
            for m in range(length):
                if forks[k, m]:
                    end = m
            if end >= 0:
                stop[lanes], last[lanes], number[lanes] = k, end, count
                write_snapshot(panel, lanes, starts[k])
                lanes += 1
            for m in range(length):
                if forks[k, m]:
                    for column in range(SETPOINT_SIZE):
                        setpoints[count, column] = stops[k, m, column]
                    count += 1
        for newest in range(length):
            n = 0
            while n < lanes:
                if forks[stop[n], newest]:
                    read_snapshot(snapshots[number[n]], panel, n)
                    number[n] += 1
                if last[n] == newest:
                    lanes -= 1
                    move(panel, n, lanes)
                    stop[n], last[n], number[n] = stop[lanes], last[lanes], number[lanes]
                else:
                    write_setpoint(panel, n, stops[stop[n], newest])
                    n += 1
            if lanes == 0:
                break
            for step in range(arrivals[newest], arrivals[newest + 1]):
                if step % STEPS_A_CONTROL == 0:
                    step_controls(panel, lanes, the_gains, the_body, False, CONTROL_PERIOD)
                step_vehicles(panel, lanes, the_body, body, spare)
        leave_alone(
            swept[done : done + count], snapshots[:count], setpoints[:count], gains, later_bodies, level_after,
            off_after, wrong,
        )  # fmt: skip
        done += count


@njit(nogil=True, error_model="numpy")
def leave_alone(
    swept: NDArray,
    snapshots: NDArray,
    setpoints: NDArray,
    gains: NDArray,
    later_bodies: NDArray,
    level_after: int,
    off_after: int,
    wrong: NDArray,
) -> None:
    """Write the boxes, (F, S, 2, 3), that vehicles sweep from snapshots, (F, 31), with their last setpoints, (F, 20).

    Each box is of one part of the time, and none is empty.
    """
    panel, spare, which = new_panel(), np.empty((WIDTH, SNAPSHOT_SIZE)), np.empty(WIDTH, dtype=np.int64)
    the_gains = unpacked_gains(gains)
    for first in range(0, len(snapshots), WIDTH):
        count = min(WIDTH, len(snapshots) - first)
        for n in range(first, first + count):
            for axis in range(3):
                swept[n, 0, 0, axis] = swept[n, 0, 1, axis] = snapshots[n, axis]
                for part in range(1, swept.shape[1]):
                    swept[n, part, 0, axis], swept[n, part, 1, axis] = np.inf, -np.inf
        for falling in range(1, len(later_bodies)):
            _put_in(panel, which, swept, snapshots, first, count)
            _fall(swept, panel, which, count, unpacked_body(later_bodies[falling]), later_bodies[falling], spare)
        _put_in(panel, which, swept, snapshots, first, count)
        for n in range(count):
            write_setpoint(panel, n, setpoints[first + n])
        _go_on_alone(
            swept, panel, which, count, the_gains, gains, unpacked_body(later_bodies[0]), later_bodies[0], level_after,
            off_after, wrong, spare,
        )  # fmt: skip
        for n in range(first, first + count):
            for part in range(1, swept.shape[1]):
                if swept[n, part, 0, 0] == np.inf:  # it was on the floor before
                    for axis in range(3):
                        swept[n, part, 0, axis] = swept[n, part - 1, 0, axis]
                        swept[n, part, 1, axis] = swept[n, part - 1, 1, axis]


@register_jitable(forceinline=True)
def _part(swept: NDArray, time: float) -> int:
    """Return the number of the box of a time, s after the setpoint."""
    return min(int(time / PART + 1e-6), swept.shape[1] - 1)


@register_jitable
def _put_in(panel: NDArray, which: NDArray, swept: NDArray, snapshots: NDArray, first: int, count: int) -> None:
    """Write vehicles with their first boxes into a panel, and `which` branch is at each place."""
    for n in range(count):
        which[n] = first + n
        write_snapshot(panel, n, snapshots[first + n])
        _write_box(panel, n, swept[first + n, 0])


@register_jitable
def _write_box(panel: NDArray, n: int, box: NDArray) -> None:
    for k in range(3):
        panel[(OWN + k) * WIDTH + n], panel[(OWN + 3 + k) * WIDTH + n] = box[0, k], box[1, k]


@register_jitable
def _read_box(box: NDArray, panel: NDArray, n: int) -> None:
    for k in range(3):
        box[0, k], box[1, k] = panel[(OWN + k) * WIDTH + n], panel[(OWN + 3 + k) * WIDTH + n]


@register_jitable
def _widen_parts(
    swept: NDArray, panel: NDArray, which: NDArray, lanes: int, astray: float, part: int, after: int
) -> None:
    """Make the box of each vehicle hold its place, and all `astray`, m, to its sides.

    Where part `after` begins, its box replaces the one in the panel.
    """
    _widen(panel, whole(lanes), astray)
    if after != part:
        for n in range(lanes):
            _read_box(swept[which[n], part], panel, n)
            _write_box(panel, n, swept[which[n], after])
        _widen(panel, whole(lanes), astray)


@register_jitable
def _take_out(swept: NDArray, panel: NDArray, which: NDArray, n: int, lanes: int, part: int) -> int:
    """Write the box of the vehicle at place n, and put the last one there; return how many are left."""
    _read_box(swept[which[n], part], panel, n)
    move(panel, n, lanes - 1)
    which[n] = which[lanes - 1]
    return lanes - 1


@register_jitable
def _take_out_landed(swept: NDArray, panel: NDArray, which: NDArray, lanes: int, part: int) -> int:
    """Take out the vehicles on the floor; return how many are left."""
    n = 0
    while n < lanes:
        if panel[2 * WIDTH + n] <= 0.0:
            lanes = _take_out(swept, panel, which, n, lanes, part)
        else:
            n += 1
    return lanes


@njit(allocates=False, error_model="numpy")
def _fall(
    swept: NDArray, panel: NDArray, which: NDArray, lanes: int, body: Parameters, as_array: NDArray, spare: NDArray
) -> None:
    """Let all vehicles fall, motors off, to the floor; widen the boxes swept."""
    stop_motors(panel, lanes)
    part = 0
    for step in range(round(_LONGEST / body[STEP])):
        step_vehicles(panel, lanes, body, as_array, spare)
        before, part = part, _part(swept, (step + 1) * body[STEP])
        _widen_parts(swept, panel, which, lanes, 0.0, before, part)
        lanes = _take_out_landed(swept, panel, which, lanes, part)
        if lanes == 0:
            return
    while lanes > 0:
        lanes = _take_out(swept, panel, which, 0, lanes, part)


@njit(error_model="numpy")
def _go_on_alone(
    swept: NDArray,
    panel: NDArray,
    which: NDArray,
    lanes: int,
    gains: Gains,
    gains_as_array: NDArray,
    body: Parameters,
    as_array: NDArray,
    level_after: int,
    off_after: int,
    wrong: NDArray,
    spare: NDArray,
) -> None:
    """Let all vehicles fly on with their last setpoints, to the floor; widen the boxes swept."""
    astray = np.array([0.0, wrong[DRIFT], 0.0])  # m and m/s: drift to a side; m/s at which it believes to sink
    period, part = body[STEP], 0
    settled_after = level_after + round(_SETTLED_AFTER / period)
    for after in range(round(_LONGEST / period)):
        if after == level_after:
            level_out_all(panel, lanes)
        if settled_after <= after < off_after:
            powered = (off_after - after) * period
            lanes = _coast_where_settled(
                swept, panel, which, lanes, gains_as_array, as_array, after * period, powered, wrong, astray, spare
            )
        if after < off_after:
            step_controls(panel, lanes, gains, body, after >= level_after, period)
        elif after == off_after:
            stop_motors(panel, lanes)
        step_vehicles(panel, lanes, body, as_array, spare)
        _raise(panel, whole(lanes), *_go_astray(astray, wrong, after < off_after, period))
        before, part = part, _part(swept, (after + 1) * period)
        _widen_parts(swept, panel, which, lanes, astray[0], before, part)
        if after > off_after:
            lanes = _take_out_landed(swept, panel, which, lanes, part)
        if lanes == 0:
            return
    while lanes > 0:
        lanes = _take_out(swept, panel, which, 0, lanes, part)


@register_jitable
def _coast_where_settled(
    swept: NDArray,
    panel: NDArray,
    which: NDArray,
    lanes: int,
    gains: NDArray,
    body: NDArray,
    begin: float,
    powered: float,
    wrong: NDArray,
    astray: NDArray,
    spare: NDArray,
) -> int:
    """Take out the vehicles that hardly turn, and follow them to the floor; return how many are left."""
    n = 0
    while n < lanes:
        turning = abs(panel[10 * WIDTH + n]) + abs(panel[11 * WIDTH + n]) + abs(panel[12 * WIDTH + n])
        if turning < _SETTLED_RATE:
            branch, now = which[n], spare[0]
            read_snapshot(now, panel, n)
            height, climb = panel[(PLACE + 2) * WIDTH + n], panel[(SPEED + 2) * WIDTH + n]
            lanes = _take_out(swept, panel, which, n, lanes, _part(swept, begin))
            _coast(swept, branch, now, height, climb, gains, body, begin, powered, wrong, astray.copy())
        else:
            n += 1
    return lanes


@njit(allocates=False)
def _coast(
    swept: NDArray,
    branch: int,
    now: NDArray,
    height: float,
    climb: float,
    gains: NDArray,
    body: NDArray,
    begin: float,
    powered: float,
    wrong: NDArray,
    astray: NDArray,
) -> None:
    """Follow the place of a vehicle whose attitude stands still, for `powered` s with motors and to the floor.

    That begins at `begin`, s after the setpoint.
    `height` and `climb`, m/s, are those of its setpoint. Semi-implicit midpoint: height control, motor lag and drag as
    in the whole simulation. `now` and `astray` are overwritten.
    """
    _, _, (zx, zy, zz) = axes_of(now[6], now[7], now[8], now[9])
    mass, lag = body[MASS], max(body[LAG], _COAST_STEP)
    thrust = now[13] + now[14] + now[15] + now[16]
    integral, time = now[MEMORY + 2], 0.0
    while time < _LONGEST:
        wanted = 0.0
        if time < powered:
            error = height - now[2]
            integral += error * _COAST_STEP
            wanted = (mass * GRAVITY + gains[6] * error + gains[7] * (climb - now[5]) + gains[8] * integral) * zz
            wanted = min(max(wanted, 0.0), 4.0 * body[THRUST_MAX])
        before = thrust
        thrust += (wanted - thrust) * _COAST_STEP / (lag + 0.5 * _COAST_STEP)
        push = 0.5 * (before + thrust) / mass
        for k in range(3):
            lift = (zx, zy, zz)[k] * push - (GRAVITY if k == 2 else 0.0)
            drag = (body[DRAG] if k < 2 else body[AXIAL_DRAG]) / mass
            speed = now[3 + k]
            now[3 + k] = _slowed(speed, lift, drag, _COAST_STEP)
            now[k] += _COAST_STEP * 0.5 * (speed + now[3 + k])
        rise, faster = _go_astray(astray, wrong, time < powered, _COAST_STEP)
        height, climb = height + rise, climb + faster
        part = _part(swept, begin + time)
        time += _COAST_STEP
        for each in range(part, _part(swept, begin + time) + 1):
            box = swept[branch, each]
            for k in range(3):
                aside = astray[0] if k < 2 else 0.0
                box[0, k], box[1, k] = _lower(box[0, k], now[k] - aside), _higher(box[1, k], now[k] + aside)
        if time > powered and now[2] <= 0.0:
            break


@register_jitable
def _go_astray(astray: NDArray, wrong: NDArray, powered: bool, step: float) -> tuple[float, float]:
    """Let what the vehicle has wrong act for a step: a wrong attitude pushes to a side, a wrong height lifts.

    All that the controller sees of a height that is believed too low is how far off the setpoint is; so that rises.
    Returned is by how much, m, and its climb, m/s.
    """
    push = wrong[PUSH] if powered else 0.0
    speed = astray[1]
    astray[1] = _slowed(speed, push, wrong[DAMPING], step)
    astray[0] += step * 0.5 * (speed + astray[1])
    rise = step * (astray[2] + 0.5 * step * wrong[LIFT])
    astray[2] += step * wrong[LIFT]
    return rise, step * wrong[LIFT]


@register_jitable
def _raise(panel: NDArray, lanes: int, rise: float, faster: float) -> None:
    """Raise the setpoints of all vehicles, by m, and let them climb faster, by m/s."""
    lanes = min(lanes, WIDTH)
    for n in range(lanes):
        panel[(PLACE + 2) * WIDTH + n] += rise
        panel[(SPEED + 2) * WIDTH + n] += faster


@register_jitable
def _widen(panel: NDArray, lanes: int, astray: float) -> None:
    """Make the box of each vehicle hold its place, and all `astray`, m, to its sides."""
    lanes = min(lanes, WIDTH)
    for n in range(lanes):
        for k in range(3):
            aside, place = astray if k < 2 else 0.0, panel[k * WIDTH + n]
            low, high = (OWN + k) * WIDTH + n, (OWN + 3 + k) * WIDTH + n
            panel[low], panel[high] = _lower(panel[low], place - aside), _higher(panel[high], place + aside)


@register_jitable(forceinline=True)
def _lower(value: float, other: float) -> float:
    """Return the smaller; written so that what is no number is taken over."""
    return value if value <= other else other


@register_jitable(forceinline=True)
def _higher(value: float, other: float) -> float:
    return value if value >= other else other


@register_jitable
def _slowed(speed: float, push: float, drag: float, step: float) -> float:
    """Return a speed, m/s, after a step, s, of a push, m/s², and a drag in 1/s; midpoint, implicit in the drag."""
    return speed + step * (push - drag * speed) / (1.0 + 0.5 * drag * step)
