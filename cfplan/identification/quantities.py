"""Identified quantities with units and uncertainties, and the quantities that the records cannot determine."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.identification.signals import FlightSignals
from cfplan.identification.translation import (
    AXIAL_DRAG,
    BATTERY,
    DRAG,
    LINEAR,
    ORIGIN,
    THRUST,
    FittedUnknowns,
    FlightModel,
    slow_voltage,
)
from cfplan.numbers import shown
from cfplan.vehicle.airframe import GRAVITY, Airframe

# N, standard uncertainty: an accelerometer off by 0.3 m/s² steps the estimate at each pose by 3 mm/s, which the gain on
# velocity, 0.4 N s/m, turns into thrust between the log's samples.
_THRUST_STD = 1.2e-3
_SOURCE = "identified from flights by cfplan identify; the rest: "
# s: the quickest message of the log takes one, and its gyroscope's sample is as old; known to one.
_LOG_DELAY, _LOG_DELAY_STD = 2e-3, 1e-3
_PLAUSIBLE_RATIO = (0.5, 2.0)  # plausible range of thrust over mass, relative to the airframe
_SIGNIFICANT_DEVIATIONS = 2.0  # standard uncertainties
_LARGE_MISFIT = 0.004  # m rms
_MAX_DRAG_STD, _MAX_LAG_STD = 0.3, 0.02  # fraction of the value, s: larger uncertainties count as unobservable
_MIN_VOLTAGE_SPAN = 0.3  # V, least range of the voltage


@dataclass(frozen=True, slots=True)
class IdentifiedQuantity:
    """One identified figure."""

    name: str
    value: float
    deviation: float  # standard uncertainty; NaN if the records do not determine it
    unit: str
    before: float  # value in the airframe or safety.yaml; NaN if there was none
    digits: int
    unobservable_reason: str = ""  # why the records cannot determine it; empty if they can
    remark: str = ""  # further remark
    scale: float = 1.0  # from SI to the unit

    def row(self) -> list[str]:
        """Return name, value with uncertainty, what was assumed before, and a remark, for people."""
        spec = f".{self.digits}f"
        std = f" ± {shown(self.scale * self.deviation, spec)}" if math.isfinite(self.deviation) else ""
        before = f"{shown(self.scale * self.before, spec)}" if math.isfinite(self.before) else "–"
        return [
            self.name,
            f"{shown(self.scale * self.value, spec)}{std} {self.unit}",
            before,
            self.unobservable_reason or self.remark,
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return it in SI units."""
        numbers = {"value": self.value, "standard_uncertainty": self.deviation, "before": self.before}
        known = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
        return {**known, "unobservable_reason": self.unobservable_reason, "remark": self.remark}


@dataclass(frozen=True, slots=True)
class Identification:
    """The identification of one vehicle."""

    airframe: Airframe  # with the identified values, otherwise as before
    pose_latency: float  # s, from exposure to the pilot: `pose.latency` of safety.yaml
    poses_misdated: bool  # whether the pose latency differs significantly from the one in use
    quantities: dict[str, IdentifiedQuantity]
    notes: tuple[str, ...]  # remarks on what is not observable, and what was held fixed
    misfit: float  # m rms, of predictions over a second

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the airframe, in SI units; what is not known is None."""
        quantities = {name: quantity.to_dict() for name, quantity in self.quantities.items()}
        return {"quantities": quantities, "notes": list(self.notes), "misfit": self.misfit}


def assemble(
    models: Sequence[FlightModel], solution: FittedUnknowns, *, mass: float | None, voltage: float
) -> Identification:
    """Return the figures of a fit, and the airframe with those that are observable."""
    before = models[0].signals.airframe
    ratio = float(np.linalg.norm(solution.linear[THRUST])) * before.mass / _full_thrust(before)
    if not _PLAUSIBLE_RATIO[0] <= ratio <= _PLAUSIBLE_RATIO[1]:
        raise InputError(
            f"the motion does not follow the motors: thrust over mass {ratio:.2f} times that of {before.name}",
            hint="is the body that was tracked the vehicle, and upright? `cfplan replay` shows both",
        )
    found = _dynamics(solution, before, mass) | _latencies(models, solution) | _geometry(models, solution)
    found["thrust per volt"] = _battery(models, solution, voltage)

    def value_or(name: str, otherwise: float) -> float:
        return otherwise if found[name].unobservable_reason else found[name].value

    airframe = replace(
        before,
        name=f"{before.name.removesuffix(', identified')}, identified",
        mass=found["mass"].value,
        thrust_scale=found["thrust scale"].value,
        motor_time_constant=value_or("motor lag", before.motor_time_constant),
        drag=(max(value_or("drag", before.drag[0]), 0.0), max(value_or("axial drag", before.drag[1]), 0.0)),
        source=_SOURCE + before.source.removeprefix(_SOURCE),
    )
    notes, latency = _notes(mass, before, solution.rms), found["pose latency"]
    misdated = abs(latency.value - latency.before) > _SIGNIFICANT_DEVIATIONS * latency.deviation
    return Identification(airframe, latency.value, misdated, found, notes, solution.rms)


def _dynamics(solution: FittedUnknowns, before: Airframe, mass: float | None) -> dict[str, IdentifiedQuantity]:
    linear, covariance = solution.linear, solution.covariance
    thrust = float(np.linalg.norm(linear[THRUST]))
    direction = linear[THRUST] / thrust
    std = math.sqrt(direction @ covariance[THRUST, THRUST] @ direction) / thrust
    std = math.hypot(std, _THRUST_STD / (before.mass * GRAVITY))
    weight = before.mass if mass is None else mass
    ratio = thrust / (_full_thrust(before) / before.mass)
    scale = thrust * weight / before.motor_thrust_max
    held = "held: flights determine only thrust over mass; weigh the vehicle and give --mass" if mass is None else ""
    lag, lag_std = solution.lag, math.sqrt(covariance[LINEAR, LINEAR])
    drags = {}
    for name, place, old in (("drag", DRAG, before.drag[0]), ("axial drag", AXIAL_DRAG, before.drag[1])):
        value, drag_std = weight * linear[place], weight * math.sqrt(covariance[place, place])
        too_uncertain = drag_std > _MAX_DRAG_STD * max(abs(value), 0.2 * old) or value < 0.0
        why = "too uncertain, kept as before: fly faster, or longer" if too_uncertain else ""
        drags[name] = IdentifiedQuantity(name, float(value), drag_std, "mN s/m", old, 2, why, scale=1e3)
    too_uncertain = "too uncertain, kept as before: climb and sink more sharply" if lag_std > _MAX_LAG_STD else ""
    remark = "with the mass as it is" if held else ""
    return {
        "thrust over mass": IdentifiedQuantity("thrust over mass, relative", ratio, ratio * std, "", 1.0, 4),
        "mass": IdentifiedQuantity("mass", weight, math.nan, "g", before.mass, 2, held, scale=1e3),
        "thrust scale": IdentifiedQuantity(
            "thrust scale", scale, scale * std, "", before.thrust_scale, 4, remark=remark
        ),
        "motor lag": IdentifiedQuantity(
            "motor lag", lag, lag_std, "ms", before.motor_time_constant, 1, too_uncertain, scale=1e3
        ),
        **drags,
    }


def _full_thrust(airframe: Airframe) -> float:
    """Return the thrust of one motor, N, at the full command."""
    return airframe.motor_thrust_max * airframe.thrust_scale


def _latencies(models: Sequence[FlightModel], solution: FittedUnknowns) -> dict[str, IdentifiedQuantity]:
    variances = np.diag(solution.covariance)[LINEAR + 1 :].reshape(-1, 3)
    behind = np.array([model.signals.behind for model in models])
    pose, pose_std = _mean(behind + solution.times[:, 0] + _LOG_DELAY, variances[:, 0])
    link, link_std = _mean(solution.times[:, 1], variances[:, 1])
    return {
        "pose latency": IdentifiedQuantity(
            "pose latency", pose, math.hypot(pose_std, _LOG_DELAY_STD), "ms", float(behind.mean()), 1, scale=1e3
        ),
        "link latency": IdentifiedQuantity(
            "link latency, to the vehicle", link, link_std, "ms", math.nan, 1, scale=1e3
        ),
    }


def _geometry(models: Sequence[FlightModel], solution: FittedUnknowns) -> dict[str, IdentifiedQuantity]:
    """Return how the markers' body is turned and where its origin is, and where the centre of mass is."""
    mountings = np.array([model.attitude.mounting for model in models])
    stds = np.array([model.attitude.mounting_deviation for model in models])
    yaw, yaw_std = _mean(mountings[:, 2], stds[:, 2] ** 2)
    thrust = solution.linear[THRUST]
    size = float(np.linalg.norm(thrust))
    # The thrust axis in the markers' axes, turned about z into the vehicle's: n ≈ (−pitch, roll, 1).
    direction = Rotation.from_rotvec([0.0, 0.0, yaw]).apply(thrust / size)
    tilt_std = np.sqrt(np.diag(solution.covariance)[THRUST]) / size
    found = {}
    for name, value, std in (
        ("roll", direction[1], float(tilt_std[1])),
        ("pitch", -direction[0], float(tilt_std[0])),
        ("yaw", yaw, yaw_std),
    ):
        found[f"mounting {name}"] = IdentifiedQuantity(
            f"markers turned, {name}", float(value), std, "°", 0.0, 2, scale=math.degrees(1.0)
        )
    for axis, place in zip("xyz", range(ORIGIN.start, ORIGIN.stop), strict=True):
        std = math.sqrt(solution.covariance[place, place])
        found[f"origin {axis}"] = IdentifiedQuantity(
            f"markers' origin, {axis} from centre of mass",
            float(solution.linear[place]),
            std,
            "mm",
            0.0,
            1,
            scale=1e3,
        )
    centre, spread = _centre_of_mass([model.signals for model in models])
    for axis, value, std in zip("xy", centre, spread, strict=True):
        found[f"centre of mass {axis}"] = IdentifiedQuantity(
            f"centre of mass, {axis} from the motors' middle", float(value), float(std), "mm", 0.0, 2,
            remark="or motors that differ as much, or the air's moment in flight mostly forwards", scale=1e3,
        )  # fmt: skip
    return found


def _centre_of_mass(flights: Sequence[FlightSignals]) -> tuple[NDArray, NDArray]:
    """Return where, (2,) m, the motors' thrusts balance on average, and how sure that is, from means of a second."""
    means = []
    for flight in flights:
        arm = flight.airframe.arm
        # Motors 1 front right, 2 back right, 3 back left, 4 front left.
        lever = arm * np.column_stack([flight.command @ [1, -1, -1, 1], flight.command @ [-1, -1, 1, 1]])
        inside = (flight.status_time > 0) & (flight.status_time < flight.duration)
        second = np.floor(flight.status_time).astype(int)
        for number in np.unique(second[inside]):
            rows = inside & (second == number)
            means.append(lever[rows].sum(axis=0) / max(flight.collective[rows].sum(), 1e-9))
    values = np.array(means)
    return values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(len(values))


def _battery(models: Sequence[FlightModel], solution: FittedUnknowns, voltage: float) -> IdentifiedQuantity:
    nominal = float(np.linalg.norm(solution.linear[THRUST]))
    value = float(solution.linear[BATTERY]) / nominal
    std = math.sqrt(solution.covariance[BATTERY, BATTERY]) / nominal
    volts = np.concatenate([slow_voltage(model.signals) for model in models])
    span = float(np.ptp(volts))
    unobservable_reason = (
        f"the voltage spanned {span:.2f} V: fly full and nearly empty" if span < _MIN_VOLTAGE_SPAN else ""
    )
    return IdentifiedQuantity(
        f"thrust per volt, at {voltage:.2f} V", value, std, "%/V", 0.0, 1, unobservable_reason, scale=100.0
    )


def _notes(mass: float | None, before: Airframe, misfit: float) -> tuple[str, ...]:
    unobservable_reason = (
        "not observable in these records: inertia, moment by velocity, yaw torque per thrust, rotor reaction, lift "
        "with speed, curvature of thrust; as in the airframe before"
    )
    large = f"{1e3 * misfit:.1f} mm rms of motion are not explained: wind, a changed load or poses of bad quality?"
    always = (unobservable_reason, large) if misfit > _LARGE_MISFIT else (unobservable_reason,)
    if mass is not None:
        return (f"mass {1e3 * mass:.2f} g as given; thrust and drag follow from it", *always)
    return (
        f"mass held at {1e3 * before.mass:.2f} g: motion is the same if mass, thrust, drag and inertia all grow by one "
        "factor, so a record tells only their ratios; flights need no more",
        *always,
    )


def _mean(values: NDArray, variances: NDArray) -> tuple[float, float]:
    """Return the mean weighted by certainty, and its standard uncertainty."""
    weights = 1.0 / np.maximum(variances, 1e-18)
    return float(values @ weights / weights.sum()), float(1.0 / math.sqrt(weights.sum()))
