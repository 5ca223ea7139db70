"""Draw limits, vehicles and paths by seed: from the shipped network's training distribution, and outside it.

A draw is a point in the space of the twelve numbers that describe limits and vehicle to the network, each scaled by its
standard deviation in training. The neighbourhood of a training draw is a ball whose radius is the 99th percentile of
the distances from training draws to their nearest neighbours. Two groups of draws lie outside every neighbourhood: one
with unusual vehicles, one with unusual limits. Paths are of all families and yaw modes, with seeds that no dataset
uses.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cfplan.errors import InputError
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import generator
from cfplan.geometry.yaw import YawMode
from cfplan.learning import draws
from cfplan.learning.dataset_spec import DatasetSpec
from cfplan.learning.features import scaled_limits
from cfplan.learning.labels import clean_path, row_limits
from cfplan.learning.model_files import find_model
from cfplan.safety.limit_sets import LIMIT_SETS, LimitSet
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import GRAVITY, Airframe

_SEED = 99  # of the draws; datasets have other seeds
_NEIGHBOURS = 0.99  # quantile of the distances from training draws to their nearest neighbours
_UNUSUAL = 0.6  # fraction of a draw's numbers that come from an unusual range
_TRIES = 1000  # draws before giving up

# Ranges below and above those that draws.py draws from for training.
SPEED = ((0.1, 0.3), (8.0, 16.0))  # m/s
ACCELERATION = ((0.3, 1.0), (20.0, 40.0))  # m/s²
ANGULAR_VELOCITY = ((0.7, 2.0), (25.0, 50.0))  # rad/s
ANGULAR_ACCELERATION = ((3.0, 10.0), (300.0, 1000.0))  # rad/s²
TILT = ((5.0, 15.0), (85.0, 88.0))  # degrees
SPECIFIC_THRUST = ((0.02, 0.1), (0.8, 0.9))  # g
MASS = ((0.010, 0.020), (0.080, 0.250))  # kg
ARM = ((0.015, 0.025), (0.060, 0.120))  # m
INERTIA = ((0.1, 0.3), (0.8, 2.0))  # over mass and the square of the arm
THRUST_TO_WEIGHT = ((1.25, 1.4), (4.0, 8.0))
THRUST_TO_TORQUE = ((0.001, 0.004), (0.035, 0.100))  # m
DRAG = ((0.8, 1.6),)  # 1/s


class _Neighbourhoods:
    """The neighbourhoods of the network's training draws."""

    def __init__(self, spec: DatasetSpec) -> None:
        """Repeat the training draws from the dataset's seed."""
        drawn = np.array([_numbers(row_limits(spec, number)[0]) for number in range(spec.count)])
        self._spread = drawn.std(axis=0)
        self._tree = cKDTree(drawn / self._spread)
        apart, _ = self._tree.query(self._tree.data, k=2)
        self._radius = float(np.quantile(apart[:, 1], _NEIGHBOURS))

    def hold(self, numbers: NDArray) -> bool:
        """Return whether these numbers lie in the neighbourhood of a training draw."""
        return float(self._tree.query(numbers / self._spread)[0]) <= self._radius


def draw_case(group: str, seed: int) -> tuple[Path, LimitSet, YawMode, float]:
    """Return path, limits, yaw mode and yaw angle, rad, for a seed in one of GROUPS.

    Raises InputError if the drawn waypoints do not define a path.
    """
    spec = DatasetSpec(count=10_000_000, seed=_SEED + list(GROUPS).index(group))
    chosen, mode, angle = row_limits(spec, seed)
    return clean_path(spec, seed), GROUPS[group](spec, seed, chosen), mode, angle


def _shipped(spec: DatasetSpec, seed: int, drawn: LimitSet) -> LimitSet:
    return list(LIMIT_SETS.values())[seed % len(LIMIT_SETS)]


def _as_drawn(spec: DatasetSpec, seed: int, drawn: LimitSet) -> LimitSet:
    return drawn


def _vehicle_outside(spec: DatasetSpec, seed: int, drawn: LimitSet) -> LimitSet:
    return _outside(spec, seed, lambda random: _limited(random, _unusual_airframe(random), draws.draw_limits))


def _limits_outside(spec: DatasetSpec, seed: int, drawn: LimitSet) -> LimitSet:
    return _outside(spec, seed, lambda random: _limited(random, draws.draw_airframe(random), _unusual_limits))


GROUPS = MappingProxyType(
    {
        "shipped limits": _shipped,
        "drawn as in training": _as_drawn,
        "vehicles outside": _vehicle_outside,
        "limits outside": _limits_outside,
    }
)


def _outside(spec: DatasetSpec, seed: int, draw: Callable[[np.random.Generator], LimitSet]) -> LimitSet:
    """Draw until the vehicle can hover and the draw lies outside every neighbourhood."""
    random, around = generator(np.random.SeedSequence(spec.seed, spawn_key=(seed, 1))), _neighbourhoods()
    for _ in range(_TRIES):
        chosen = draw(random)
        airframe, limits = chosen.airframe, chosen.limits
        hovers = limits.motor_thrust_min < airframe.hover_thrust < limits.motor_thrust_max
        if hovers and not around.hold(_numbers(chosen)):
            return chosen
    raise InputError("no draw lies outside of every neighbourhood", where="limits", hint="please report this")


@cache
def _neighbourhoods() -> _Neighbourhoods:
    usual = LIMIT_SETS["hardware"]
    model = find_model(usual.airframe, usual.limits)
    if model is None or model.card.data.get("limits") != "drawn":
        raise InputError("no model that has learned from draws", where="models", hint="train one with `cfplan train`")
    return _Neighbourhoods(DatasetSpec(count=model.card.data["count"], seed=model.card.data["seed"]))


def _numbers(chosen: LimitSet) -> NDArray:
    return scaled_limits(chosen.airframe, chosen.limits).numbers


def _limited(
    random: np.random.Generator, airframe: Airframe, limit: Callable[[np.random.Generator, Airframe], PlanLimits]
) -> LimitSet:
    return LimitSet("outside", airframe, limit(random, airframe))


def _unusual(random: np.random.Generator, usual: tuple[float, float], unusual: Sequence[tuple[float, float]]) -> float:
    """Draw a number whose logarithm is uniform, mostly from one of the unusual ranges."""
    ends = unusual[int(random.integers(len(unusual)))] if random.uniform() < _UNUSUAL else usual
    return math.exp(random.uniform(math.log(ends[0]), math.log(ends[1])))


def _unusual_airframe(random: np.random.Generator) -> Airframe:
    mass, arm = _unusual(random, draws.MASS, MASS), _unusual(random, (0.025, 0.060), ARM)
    roll = mass * arm**2 * _unusual(random, (0.3, 0.8), INERTIA)
    pitch = roll * random.uniform(0.7, 1.4)
    weight = mass * GRAVITY / 4
    sideways = mass * _unusual(random, (0.01, 0.8), DRAG)
    return Airframe(
        name="unusual", mass=mass, inertia=(roll, pitch, (roll + pitch) * random.uniform(0.75, 0.99)), arm=arm,
        thrust_to_torque=_unusual(random, (0.004, 0.035), THRUST_TO_TORQUE),
        motor_thrust_min=random.uniform(0.0, 0.2) * weight,
        motor_thrust_max=_unusual(random, draws.THRUST_TO_WEIGHT, THRUST_TO_WEIGHT) * weight,
        motor_time_constant=random.uniform(0.04, 0.12), drag=(sideways, sideways * random.uniform(0.7, 1.5)),
        source="drawn",
    )  # fmt: skip


def _unusual_limits(random: np.random.Generator, airframe: Airframe) -> PlanLimits:
    usual = draws.draw_limits(random, airframe)
    return PlanLimits(
        speed=_unusual(random, draws.SPEED, SPEED),
        acceleration=_unusual(random, draws.ACCELERATION, ACCELERATION),
        angular_velocity=_unusual(random, draws.ANGULAR_VELOCITY, ANGULAR_VELOCITY),
        angular_acceleration=_unusual(random, draws.ANGULAR_ACCELERATION, ANGULAR_ACCELERATION),
        tilt=math.radians(_unusual(random, draws.TILT, TILT)),
        specific_thrust_min=GRAVITY * _unusual(random, draws.SPECIFIC_THRUST, SPECIFIC_THRUST),
        motor_thrust_min=usual.motor_thrust_min,
        motor_thrust_max=usual.motor_thrust_max,
    )
