"""Slow a whole profile by one speed factor, as a last resort: as h tends to 0, motion tends to hover, which passes."""

from dataclasses import dataclass

import numpy as np

from cfplan.deadline import NEVER, Deadline
from cfplan.errors import InfeasibleError, NotCertifiedError
from cfplan.numbers import coordinates, shown
from cfplan.safety.certificate import OBSTACLES, OF_PLACE, Certificate, certify
from cfplan.safety.feasibility import describe_hover, hover_violation
from cfplan.safety.limits import PlanLimits
from cfplan.safety.quantities import QUANTITIES
from cfplan.safety.space import Space
from cfplan.safety.speed_caps import SpeedCaps
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.trajectory import Trajectory

RESOLUTION = 1e-4  # of the speed factor
LEAST_SPEED_FACTOR = 3e-3  # smaller ones do not count as flight
_AIM = RESOLUTION / 2  # below a limit, so that the search ends on the passing side
_TRIALS = 60


@dataclass(frozen=True, slots=True)
class Slowed:
    """A certified trajectory, and how much it was slowed."""

    trajectory: Trajectory
    certificate: Certificate
    speed_factor: float  # of the whole profile; 1: not slowed


def slow_until_certified(
    trajectory: Trajectory,
    limits: PlanLimits,
    space: Space | None = None,
    certificate: Certificate | None = None,
    caps: SpeedCaps | None = None,
    deadline: Deadline = NEVER,
) -> Slowed:
    """Return the trajectory if it passes, else slowed by the largest speed factor that passes, within RESOLUTION.

    `certificate` is the trajectory's, if it is known. After the deadline the first speed factor that passes is taken.

    Raises:
        InfeasibleError: no speed factor passes, because hovering or the path itself exceeds a limit; names it.
    """
    certificate = certificate or certify(trajectory, limits, space, caps)
    if certificate.passed:
        return Slowed(trajectory, certificate, 1.0)
    _check_hover(trajectory.airframe, limits)
    _check_place(certificate)

    # False position between hover and the failure, in the square of the factor, with which accelerations scale.
    low, low_excess = 0.0, _hover_share(trajectory.airframe, limits) - 1.0
    high, high_excess = 1.0, _excess(certificate)
    best: Slowed | None = None
    for trial in range(_TRIALS):
        square = low + (high - low) * (low_excess + _AIM) / (low_excess - high_excess)
        if trial % 3 == 2 or not low < square < high:
            square = (low + high) / 2.0
        try:
            slower = Trajectory(trajectory.path, trajectory.profile.slowed(square**0.5), trajectory.airframe)
        except NotCertifiedError:  # longer than any flight: too slow
            low = square
            continue
        certificate = certify(slower, limits, space, caps)
        if certificate.passed:
            low, low_excess = square, _excess(certificate)
            best = Slowed(slower, certificate, square**0.5)
            if low_excess > -RESOLUTION or deadline.passed:
                break
        else:
            high, high_excess = square, _excess(certificate)
        if high < LEAST_SPEED_FACTOR**2 or (best is not None and high - low <= 2.0 * RESOLUTION * high):
            break
    if best is None:
        raise InfeasibleError(
            f"{certificate.worst.name} exceeds its limit at any speed",
            where=f"{coordinates(certificate.worst.position, '.2f')} m",
            hint="loosen that limit or change the path there",
        )
    return best


def _excess(certificate: Certificate) -> float:
    """Return the largest usage of a limit that slowing changes, less 1; infinity for NaN (no thrust, upside down)."""
    usages = [margin.share for margin in certificate.margins if margin.name not in OF_PLACE]
    return np.inf if np.isnan(usages).any() else max(usages) - 1.0


def _hover_share(airframe: Airframe, limits: PlanLimits) -> float:
    """Return the worst usage that remains as the speed tends to 0."""
    return max((q.hover(airframe) - (zero := q.unused(airframe))) / (q.allowed(limits) - zero) for q in QUANTITIES)


def _check_hover(airframe: Airframe, limits: PlanLimits) -> None:
    if violated := hover_violation(airframe, limits):
        raise InfeasibleError(describe_hover(violated, airframe, limits), where=violated.noun, hint=violated.remedy)


def _check_place(certificate: Certificate) -> None:
    for margin in certificate.margins:
        if margin.name in OF_PLACE and not margin.passed:
            what = "an obstacle" if margin.name == OBSTACLES else "the walls"
            raise InfeasibleError(
                f"the path comes within {shown(margin.worst, '.3f')} m of {what}, the margin is {margin.limit:g} m",
                where=f"{coordinates(margin.position, '.2f')} m",
                hint="move or place the path",
            )
