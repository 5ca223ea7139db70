"""Simulate one flight of setpoints, as sent in bytes, and record the vehicle each millisecond.

The recorded flights of the firmware were made in the same way.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.firmware import MellingerGains, gains_for
from cfplan.flight.setpoints.packets import FullStateSetpoints
from cfplan.simulation.engine.body import TIME_STEP
from cfplan.simulation.engine.layout import (
    ASKED,
    BODY_RATE,
    FULL_EFFICIENCY,
    MOTORS,
    POSITION,
    QUATERNION,
    SNAPSHOT_SIZE,
    STATE_SIZE,
    STILL_AIR,
    VELOCITY,
    pack_airframe,
    setpoint_rows,
)
from cfplan.simulation.engine.mellinger import FULL_COMMAND
from cfplan.simulation.engine.run import Schedule, Vehicles, simulate
from cfplan.vehicle.airframe import Airframe

NO_FLOOR = -np.inf  # a flight that sinks to the ground shows as a deviation


@dataclass(frozen=True, slots=True)
class EstimateErrors:
    """Errors of the controller's estimate of position and velocity; its attitude and body rate are exact."""

    latency: float = 0.0  # s by which position and velocity are late
    position_noise: float = 0.0  # m, standard deviation, drawn every 10 ms
    velocity_noise: float = 0.0  # m/s, standard deviation, drawn every 10 ms
    seed: int = 0


PERFECT = EstimateErrors()


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions of a flight; the defaults are those of the plan."""

    gains: MellingerGains | None = None  # of the controller; None: the airframe's
    floor: float = NO_FLOOR  # m
    delay: float = 0.0  # s by which setpoints are late
    estimate: EstimateErrors = PERFECT
    wind: NDArray = field(default_factory=lambda: STILL_AIR)  # (3,) m/s
    efficiency: NDArray = field(default_factory=lambda: FULL_EFFICIENCY)  # (4,) fraction of its thrust per motor
    on_board: bool = False  # whether setpoints are those of the high-level commander


AS_PLANNED = Conditions()


@dataclass(frozen=True, slots=True)
class ClosedLoop:
    """The vehicle's motion, every millisecond from the start to the end."""

    time: NDArray  # (N,) s
    states: NDArray  # (N, 17) as in `layout`
    commands: NDArray  # (N, 4) command of each motor, 16-bit units

    @property
    def position(self) -> NDArray:
        """Return the position, (N, 3) m."""
        return self.states[:, POSITION]

    @property
    def velocity(self) -> NDArray:
        """Return the velocity, (N, 3) m/s."""
        return self.states[:, VELOCITY]

    @property
    def quaternion(self) -> NDArray:
        """Return the attitude, (N, 4) body→world, x y z w."""
        return self.states[:, QUATERNION]

    @property
    def body_rate(self) -> NDArray:
        """Return the body rates, (N, 3) rad/s."""
        return self.states[:, BODY_RATE]

    @property
    def motor_thrust(self) -> NDArray:
        """Return the motor thrusts, (N, 4) N."""
        return self.states[:, MOTORS]


def fly_setpoints(
    setpoints: FullStateSetpoints | NDArray,
    times: NDArray,
    airframe: Airframe,
    start: NDArray,
    duration: float,
    conditions: Conditions = AS_PLANNED,
) -> ClosedLoop:
    """Fly setpoints, or rows of them as `mellinger` has them, (N, 20), for `duration` s.

    They arrive at `times`, (N,) s, and as much later as the conditions say; until the first does, the controller holds
    the first. The flight begins in a state, (17,), or goes on from a snapshot, (31,).
    """
    rows = setpoints if isinstance(setpoints, np.ndarray) else setpoint_rows(setpoints)
    steps = round(duration / TIME_STEP) + 1
    snapshot = np.zeros((1, SNAPSHOT_SIZE))
    snapshot[0, : len(start)] = start
    arrivals = np.round((np.asarray(times) + conditions.delay) / TIME_STEP).astype(np.int64)
    arrivals[0] = 0
    packed = pack_airframe(
        airframe, floor=conditions.floor, wind=conditions.wind, efficiency=conditions.efficiency
    )  # fmt: skip
    first = np.zeros(1, dtype=np.int64)
    batch = Vehicles(snapshot, packed[None], first, first + len(rows) - 1, first, np.zeros((1, 3)))
    estimate = conditions.estimate
    schedule = Schedule(
        rows, arrivals, (conditions.gains or gains_for(airframe)).pack(), steps + 1, on_board=conditions.on_board,
        latency=round(estimate.latency / TIME_STEP), noise=_noise(estimate, steps + 1),
    )  # fmt: skip
    trace = simulate(batch, schedule, trace=True).trace[0]
    commands = trace[1:, ASKED:] * (FULL_COMMAND / airframe.motor_thrust_max)
    return ClosedLoop(np.arange(steps) * TIME_STEP, trace[:-1, :STATE_SIZE], commands)


def _noise(estimate: EstimateErrors, steps: int) -> NDArray:
    """Return (M, 6), M >= steps: errors of position, m, and velocity, m/s, for each millisecond; none if exact."""
    if estimate.position_noise == estimate.velocity_noise == 0.0:
        return np.zeros((0, 6))
    random = np.random.default_rng(estimate.seed)
    noise = np.repeat(random.normal(size=(steps // 10 + 1, 6)), 10, axis=0)
    noise *= np.repeat([estimate.position_noise, estimate.velocity_noise], 3)
    return noise
