"""Predict a logged flight by the model, and compare the prediction with the vehicle's motion.

The model starts from the log's first record and flies the reference closed loop: body, sensors, poses, Kalman filter,
controller with the gains that flew. Nothing is fitted to the deviation. It passes if rms and largest deviation agree
within 20 % and the deviations of all axes correlate by 0.95.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.firmware import MellingerGains
from cfplan.identification.flight_log import FlightLog, check_log
from cfplan.identification.measured import Measured, measure, scale_by_voltage
from cfplan.identification.reference import POSITION, SETPOINT_PERIOD, ReferenceMotion
from cfplan.identification.replay import Controller, Recomputed, check_explained, choose_jerk
from cfplan.simulation.engine.estimated_loop import POSE_LATENCY, EstimatorInput, fly_with_estimator
from cfplan.simulation.engine.mellinger import FULL_STATE, ON_BOARD
from cfplan.vehicle.airframe import GRAVITY, Airframe

WITHIN, CORRELATED = 0.20, 0.95  # fraction, for rms and largest deviation; least correlation
_RATE = 1000  # Hz, of the simulation
_FIRST_POSE = 0.003  # s, if the log does not show poses


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Predicted against measured distance from the reference."""

    measured_rms: float  # m
    predicted_rms: float
    measured_largest: float
    predicted_largest: float
    measured_axes: tuple[float, float, float]  # m rms along x, y, z
    predicted_axes: tuple[float, float, float]
    correlation: float  # of all three axes together
    explained: float  # fraction of the measured deviation's variance over time

    @property
    def ratio(self) -> float:
        """Return predicted over measured rms."""
        return self.predicted_rms / self.measured_rms

    @property
    def largest_ratio(self) -> float:
        """Return predicted over measured largest distance."""
        return self.predicted_largest / self.measured_largest

    @property
    def passes(self) -> bool:
        """Return whether the prediction holds."""
        near = abs(self.ratio - 1.0) <= WITHIN and abs(self.largest_ratio - 1.0) <= WITHIN
        return near and self.correlation >= CORRELATED


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """The prediction of one flight, compared with its log."""

    log: FlightLog
    reference: ReferenceMotion
    controller: Controller
    recomputed: Recomputed
    measured: Measured
    predicted: NDArray  # (N, 3) m, position estimated by the model at each record
    comparison: Comparison
    ablations: Mapping[str, Comparison]  # by the part of the physics that is left out


def validate(
    log: FlightLog,
    reference: ReferenceMotion,
    controller: Controller,
    airframe: Airframe,
    poses: EstimatorInput | None = None,
) -> Validation:
    """Validate the model by a flight, with the reference at its actual start and an airframe of the weighed mass.

    Raises:
        InputError: the log has gaps or a crash, or the gains do not explain its commands; the hint names what to do.
    """
    check_log(log)
    controller = choose_jerk(log, reference, controller, airframe)
    recomputed = check_explained(log, reference, controller, airframe)
    found = measure(log, airframe)
    poses = poses or poses_of(log)
    predicted = predict(log, reference, controller, found.airframe, recomputed, poses)
    ablations = {
        name: compare(log, reference, predict(log, reference, controller, lesser, recomputed, poses, estimator=known))
        for name, (lesser, known) in without_pieces(found.airframe).items()
    }
    return Validation(
        log, reference, controller, recomputed, found, predicted, compare(log, reference, predicted), ablations
    )


def without_pieces(airframe: Airframe) -> dict[str, tuple[Airframe, bool]]:
    """Return the airframe without each part of the physics, and whether the estimator is simulated."""
    return {
        "thrust scale": (replace(airframe, thrust_scale=1.0, thrust_curvature=0.0), True),
        "drag": (replace(airframe, drag=(0.0, 0.0)), True),
        "moment": (replace(airframe, velocity_moment=(0.0, 0.0)), True),
        "lift with speed": (replace(airframe, lift_with_speed=0.0), True),
        "estimator": (airframe, False),
    }


def poses_of(log: FlightLog, latency: float = POSE_LATENCY) -> EstimatorInput:
    """Return the logged poses; without any, poses at 100 Hz without attitude, as from a single marker."""
    if not len(log.pose_time):
        return EstimatorInput(np.arange(_FIRST_POSE, log.duration, 0.01), latency, with_attitude=False)
    return EstimatorInput(
        log.pose_time, latency, with_attitude=bool((np.linalg.norm(log.poses[:, 3:], axis=1) > 0.5).any())
    )


def predict(
    log: FlightLog, reference: ReferenceMotion, controller: Controller, airframe: Airframe, recomputed: Recomputed,
    poses: EstimatorInput, *, estimator: bool = True,
) -> NDArray:  # fmt: skip
    """Return the predicted estimate of position of a vehicle with this airframe at each record, (N, 3) m."""
    mode = ON_BOARD
    if len(reference.sent) and not controller.by_lee:
        setpoints, times, mode = reference.sent, reference.sent_time, FULL_STATE
    else:
        times = np.arange(0.0, log.duration, SETPOINT_PERIOD)
        # A setpoint holds for a period, so the reference stands for the middle of it.
        setpoints = controller.setpoints(reference, times + SETPOINT_PERIOD / 2)
    flown = fly_with_estimator(
        controller.gains, setpoints, times, airframe, log.state[0], poses, scale=scale_by_voltage(log, airframe),
        mode=mode, memory=_memory(controller, recomputed, airframe, log), estimator=estimator,
    )  # fmt: skip
    at = np.minimum(np.round(log.time * _RATE).astype(int), len(flown.beliefs) - 1)
    return flown.beliefs[at][:, POSITION]


def compare(log: FlightLog, reference: ReferenceMotion, predicted: NDArray) -> Comparison:
    """Compare predicted with estimated positions, (N, 3) m, both less the reference."""
    wanted = reference.at(log.time)[:, POSITION]
    measured, foreseen = log.state[:, POSITION] - wanted, predicted - wanted
    with np.errstate(all="ignore"):
        correlation = float(np.corrcoef(measured.ravel(), foreseen.ravel())[0, 1])
    left, moved = measured - foreseen, measured - measured.mean(axis=0)
    return Comparison(
        _rms(measured), _rms(foreseen), _largest(measured), _largest(foreseen), _axes(measured), _axes(foreseen),
        correlation, float(1.0 - np.var(left - left.mean(axis=0)) / np.var(moved)),
    )  # fmt: skip


def _memory(controller: Controller, recomputed: Recomputed, airframe: Airframe, log: FlightLog) -> NDArray:
    """Return the controller's integrals at the start: zero, as of a trimmed vehicle, except the integral of height.

    The real vehicle's integrals also compensate unequal motors and an offset centre of mass, which the model lacks.
    """
    memory = np.zeros(len(recomputed.memory))
    gains = controller.gains
    integral = gains.ki_z / airframe.mass if isinstance(gains, MellingerGains) else gains.Kpos_Iz
    if integral > 0.0:
        upward = log.control[:, 0] * log.attitude.as_matrix()[:, 2, 2]
        flown = airframe.mass * GRAVITY / float(np.mean(upward[log.time <= 1.0]))
        memory[2] = recomputed.memory[2] + GRAVITY / integral * (1.0 / airframe.thrust_scale - 1.0 / flown)
    return memory


def _rms(errors: NDArray) -> float:
    return float(np.sqrt(np.mean((errors**2).sum(axis=1))))


def _largest(errors: NDArray) -> float:
    return float(np.linalg.norm(errors, axis=1).max())


def _axes(errors: NDArray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in np.sqrt(np.mean(errors**2, axis=0)))
    return x, y, z
