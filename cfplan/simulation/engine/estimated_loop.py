"""The closed loop with the estimator in it: body, sensors, poses, Kalman filter and controller, compiled.

A dry run on the true state leaves out the errors of the estimate. Here gyroscope and accelerometer pass the firmware's
low-pass filters (80 and 30 Hz), poses arrive late, the filter does not model drag, and the controller, Lee's or
Mellinger's, flies on the estimate. Each millisecond: sensors, a pose if one arrives, the filter, the controller (every
second time), the body.
"""

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray
from scipy.signal import butter

from cfplan.flight.firmware import MellingerGains
from cfplan.machine_code import njit
from cfplan.simulation.engine import lee, mellinger
from cfplan.simulation.engine.body import TIME_STEP, step_and_feel
from cfplan.simulation.engine.kalman import Filter, Prior, estimate, new_filter, step_filter
from cfplan.simulation.engine.layout import (
    ASKED,
    MEMORY,
    MEMORY_SIZE,
    MOTORS,
    SETPOINT,
    SETPOINT_SIZE,
    STATE_SIZE,
    THRUST_SCALE,
    new_vehicle,
    pack_airframe,
)
from cfplan.simulation.engine.lee import LeeGains
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.rotations import matrix_of, product, yaw_of

BELIEF_SIZE = 13
POSE_LATENCY = 0.005  # s; public logs: 3 to 8 ms
GYRO_CUTOFF, ACCELEROMETER_CUTOFF = 80.0, 30.0  # Hz, of the firmware's low-pass filters
_SETTLING = 4000  # ms of hover in which the filter's covariance settles
_POSE_PERIOD = 10  # ms, while it settles


@dataclass(frozen=True, slots=True, eq=False)
class EstimatorInput:
    """The poses sent to a vehicle, and the parameters of its filter."""

    time: NDArray  # (M,) s, when each arrived
    latency: float = POSE_LATENCY  # s
    attitude_latency: float | None = None  # s of its attitude, if different
    with_attitude: bool = True  # False for a single marker
    position_deviation: float = 0.001  # m, as set in the firmware (locSrv.extPosStdDev)
    attitude_deviation: float = 0.05  # rad (locSrv.extQuatStdDev)
    drag: tuple[float, float, float] = (0.0, 0.0, 0.0)  # 1/s, in the filter's model (kalman.dragB)
    noise: NDArray = field(default_factory=lambda: np.zeros((0, 6)))  # (M or 0, 6) m, and rad about the body's axes


@dataclass(frozen=True, slots=True, eq=False)
class EstimatedFlight:
    """The state and the estimate of a simulated vehicle, every millisecond."""

    states: NDArray  # (N, 17) as in `layout`
    beliefs: NDArray  # (N, 13) estimated position, velocity, quaternion; body rate as measured
    control: NDArray  # (N, 4) thrust N and torques N m commanded by the controller
    asked: NDArray  # (N, 4) N, commanded thrust of each motor


class _Loop(NamedTuple):
    """The arrays of the compiled loop, which fills in those of the flight."""

    states: NDArray
    beliefs: NDArray
    control: NDArray
    asked: NDArray
    setpoints: NDArray  # (K, 14 or 20) as the controller takes them
    changes: NDArray  # (K,) ms at which each comes into force
    mode: mellinger.Modes  # (7,) of Mellinger's
    gains: NDArray
    vehicle: NDArray  # (77,) as in `layout`: body, memory of the controller, setpoint, airframe
    levers: NDArray  # (5,) arm m, yaw torque per thrust m, largest motor thrust N, N per 16-bit unit, Mellinger or not
    scale: NDArray  # (N,) the body's thrust scale, which falls with the battery
    arrivals: NDArray  # (M,) ms of each pose
    noise: NDArray  # (M or 0, 6) m and rad, of each pose
    pose: NDArray  # (5,) latencies of position and attitude ms, with attitude, standard deviations m and rad
    kalman: Filter
    prior: NDArray
    lowpass: NDArray  # (2, 5) of gyroscope and accelerometer
    level_at: int  # ms at which a vehicle without setpoints levels out
    off_at: int  # ms at which its motors stop


def fly_with_estimator(
    gains: LeeGains | MellingerGains,
    setpoints: NDArray,
    times: NDArray,
    airframe: Airframe,
    start: NDArray,
    poses: EstimatorInput,
    *,
    scale: NDArray,
    mode: mellinger.Modes = mellinger.ON_BOARD,
    memory: NDArray | None = None,
    estimator: bool = True,
    level_at: float = math.inf,
    off_at: float = math.inf,
) -> EstimatedFlight:
    """Fly setpoints, (K, 14 or 20) as the controller of the gains takes them, from `start`, (13,).

    They come into force at `times`, (K,) s; the first holds before. `scale`, (N,), is the thrust scale at each
    millisecond of the flight; `mode` is that of Mellinger's setpoints, `memory` the controller's at the start.
    Without the estimator the controller knows the true state. At `level_at` and `off_at`, s, the supervisor of a
    vehicle that has lost its link levels it out, and stops its motors.
    """
    by_lee, steps = isinstance(gains, LeeGains), len(scale)
    states, beliefs = np.zeros((steps, STATE_SIZE)), np.zeros((steps, BELIEF_SIZE))
    states[0, :BELIEF_SIZE] = beliefs[0] = start
    states[0, MOTORS] = airframe.hover_thrust
    vehicle = new_vehicle(states[0], pack_airframe(airframe, floor=-np.inf))
    if memory is not None:
        vehicle[MEMORY : MEMORY + len(memory)] = memory
    per_unit = 0.25 / gains.mass_thrust if isinstance(gains, MellingerGains) else 0.0
    prior = Prior(drag_x=poses.drag[0], drag_y=poses.drag[1], drag_z=poses.drag[2]).pack()
    attitude_latency = poses.latency if poses.attitude_latency is None else poses.attitude_latency
    pose = np.array([
        round(poses.latency / TIME_STEP), round(attitude_latency / TIME_STEP), poses.with_attitude,
        poses.position_deviation, poses.attitude_deviation,
    ])  # fmt: skip
    loop = _Loop(
        states=states,
        beliefs=beliefs,
        control=np.zeros((steps, 4)),
        asked=np.zeros((steps, 4)),
        setpoints=np.array(setpoints, dtype=float),  # a copy: levelling out changes the last one
        changes=np.round(times / TIME_STEP).astype(np.int64),
        mode=mode,
        gains=gains.pack(),
        vehicle=vehicle,
        levers=np.array([airframe.arm, airframe.thrust_to_torque, airframe.motor_thrust_max, per_unit, not by_lee]),
        scale=np.asarray(scale, dtype=float),
        arrivals=np.round(poses.time / TIME_STEP).astype(np.int64),
        noise=np.ascontiguousarray(poses.noise, dtype=float),
        pose=pose,
        kalman=_settled(start, pose, prior),
        prior=prior,
        lowpass=np.stack([_lowpass(GYRO_CUTOFF), _lowpass(ACCELEROMETER_CUTOFF)]),
        level_at=round(min(level_at / TIME_STEP, steps)),
        off_at=round(min(off_at / TIME_STEP, steps)),
    )
    _run(loop, estimator)
    return EstimatedFlight(states, beliefs, loop.control, loop.asked)


def _lowpass(cutoff: float) -> NDArray:
    """Return the coefficients, (5,), of the firmware's second-order low-pass."""
    above, below = butter(2, cutoff, fs=1.0 / TIME_STEP)
    return np.array([*above, *below[1:]])


def _settled(start: NDArray, pose: NDArray, prior: NDArray) -> Filter:
    """Return a filter whose covariance has settled in hover, with `start` as its estimate."""
    kalman = Filter(*(part.copy() for part in _hovered(yaw_of(start[6:10]), tuple(pose[2:]), tuple(prior))))
    kalman.state[:3], kalman.state[3:6] = start[:3], matrix_of(start[6:10]).T @ start[3:6]
    kalman.quaternion[:] = start[6:10]
    return kalman


@lru_cache(maxsize=16)
def _hovered(yaw: float, pose: tuple[float, ...], prior: tuple[float, ...]) -> Filter:
    """Return a filter after _SETTLING ms of hover at the origin; not to be changed. `pose` is without latencies."""
    packed = np.array(prior)
    kalman, row = new_filter(packed), np.zeros((1, 9))
    level = np.array([0.0, 0.0, np.sin(0.5 * yaw), np.cos(0.5 * yaw)])
    row[0, 3:7], row[0, 7:] = level * pose[0], pose[1:]
    kalman.state[:3], kalman.quaternion[:] = 0.0, level
    _settle(kalman, packed, row)
    return kalman


@njit
def _settle(kalman: Filter, prior: NDArray, row: NDArray) -> None:
    still, hover = np.zeros(3), np.array([0.0, 0.0, GRAVITY])
    for tick in range(_SETTLING):
        step_filter(kalman, prior, still, hover, row if tick % _POSE_PERIOD == 0 else row[:0], tick, True)


@njit(nogil=True)
def _run(loop: _Loop, estimator: bool) -> None:
    vehicle, belief, control = loop.vehicle, loop.beliefs[0].copy(), np.zeros(4)
    state = vehicle[:STATE_SIZE]
    vehicle[ASKED : ASKED + 4] = state[13:17] / loop.scale[0]
    rates, forces = np.zeros(3), np.array([0.0, 0.0, GRAVITY])  # true, and low-pass filtered
    gyro, acceleration, past = state[10:13].copy(), forces.copy(), np.zeros((2, 3, 2))
    for _ in range(200):
        _filter(loop.lowpass[0], past[0], state[10:13], gyro)
        _filter(loop.lowpass[1], past[1], forces, acceleration)
    row, arrived, newest = np.zeros((1, 9)), 0, 0
    for step in range(len(loop.states)):
        loop.states[step] = state
        for axis in range(3):
            rates[axis] = state[10 + axis]
        _filter(loop.lowpass[0], past[0], rates, gyro)
        _filter(loop.lowpass[1], past[1], forces, acceleration)
        count = 0
        if arrived < len(loop.arrivals) and loop.arrivals[arrived] <= step:
            _write_pose(row, loop, loop.arrivals[arrived])
            if len(loop.noise) > 0:
                _add_noise(row, loop.noise[arrived])
            arrived, count = arrived + 1, 1
        if estimator:
            step_filter(loop.kalman, loop.prior, gyro, acceleration, row[:count], step, True)
            estimate(loop.kalman, belief)
        else:
            belief[:10] = state[:10]
        belief[10:13] = gyro
        loop.beliefs[step] = belief
        while newest + 1 < len(loop.changes) and loop.changes[newest + 1] <= step:
            newest += 1
        if step == loop.level_at:
            loop.setpoints[newest, mellinger.YAW_RATE] = 0.0
        if step >= loop.off_at:
            vehicle[ASKED : ASKED + 4] = 0.0
        elif step % 2 == 0:
            mode = mellinger.LEVEL_OUT if step >= loop.level_at else loop.mode
            _control(loop, mode, loop.setpoints[newest], belief, control)
        loop.control[step], loop.asked[step] = control, vehicle[ASKED : ASKED + 4]
        vehicle[THRUST_SCALE] = loop.scale[step]
        step_and_feel(vehicle, TIME_STEP, forces)


@register_jitable
def _control(loop: _Loop, mode: mellinger.Modes, setpoint: NDArray, belief: NDArray, control: NDArray) -> None:
    """Run the controller: write thrust and torques, and command the motors."""
    arm, twist, most, per_unit, by_mellinger = loop.levers
    asked = loop.vehicle[ASKED : ASKED + 4]
    if by_mellinger == 0.0:
        lee.step_lee(control, loop.vehicle[MEMORY : MEMORY + MEMORY_SIZE], loop.gains, setpoint, belief, 2 * TIME_STEP)
        lee.divide_power(control, (arm, twist), most, asked)
        return
    loop.vehicle[SETPOINT : SETPOINT + SETPOINT_SIZE] = setpoint
    units = mellinger.step_mellinger(loop.vehicle, loop.gains, mode, belief, 2 * TIME_STEP)
    control[0], control[1] = 4 * per_unit * units[0], 2 * arm * per_unit * units[1]
    control[2], control[3] = -2 * arm * per_unit * units[2], -4 * twist * per_unit * units[3]  # legacy signs
    commands = mellinger.mixed(units)
    for motor in range(4):
        asked[motor] = commands[motor] * per_unit


@register_jitable
def _write_pose(row: NDArray, loop: _Loop, arrival: int) -> None:
    seen, turned = max(arrival - int(loop.pose[0]), 0), max(arrival - int(loop.pose[1]), 0)
    for k in range(3):
        row[0, k] = loop.states[seen, k]
    for k in range(4):
        row[0, 3 + k] = loop.states[turned, 6 + k] * loop.pose[2]
    row[0, 7], row[0, 8] = loop.pose[3], loop.pose[4]


@register_jitable
def _add_noise(row: NDArray, noise: NDArray) -> None:
    """Add noise, (6,), to a pose: m, and small angles, rad, about its axes."""
    x, y, z, w = row[0, 3], row[0, 4], row[0, 5], row[0, 6]
    turn = 0.5 * noise[3], 0.5 * noise[4], 0.5 * noise[5], 1.0
    turned = product((x, y, z, w), turn)
    size = np.sqrt(1.0 + turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2])
    for k in range(3):
        row[0, k] += noise[k]
    for k in range(4):
        row[0, 3 + k] = turned[k] / size


@register_jitable
def _filter(lowpass: NDArray, past: NDArray, values: NDArray, out: NDArray) -> None:
    for axis in range(3):
        out[axis] = lowpass[0] * values[axis] + past[axis, 0]
        past[axis, 0] = lowpass[1] * values[axis] - lowpass[3] * out[axis] + past[axis, 1]
        past[axis, 1] = lowpass[2] * values[axis] - lowpass[4] * out[axis]
