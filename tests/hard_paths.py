"""Read tests/data/hard_paths.yaml: paths that are, or once were, hard to plan.

A test takes them by `@pytest.mark.parametrize("case", hard_paths("expert"))`: one parameter for each limit set and yaw
mode of an entry, marked slow where the entry is.
"""

import itertools
from dataclasses import dataclass, replace
from pathlib import Path as File
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from cfplan.geometry import path_families
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import random_waypoints
from cfplan.geometry.yaw import YawMode
from cfplan.learning.dataset_spec import DatasetSpec
from cfplan.learning.labels import row_path
from cfplan.planners.task import PlanningTask
from cfplan.safety.limit_sets import BOXES, LIMIT_SETS
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe

FILE = File(__file__).parent / "data" / "hard_paths.yaml"
KEYS = {"name", "limits", "yaw", "nodes", "change", "expect", "slow"}
SHAPES = {"waypoints", "random", "dataset", "coil", "spaced"}
EXPECTATIONS = {"path", "expert", "plan"}


@dataclass(frozen=True)
class HardPath:
    """One path, the limits and the yaw mode to plan it with, and what to expect."""

    name: str
    shape: dict[str, Any]  # one of SHAPES and what it says
    limit_set: str
    change: dict[str, float]  # limits that differ from the set's
    yaw: YawMode
    nodes: int
    expect: dict[str, str]  # by EXPECTATIONS

    @property
    def path(self) -> Path:
        ((kind, given),) = self.shape.items()
        if kind == "dataset":
            spec = DatasetSpec(
                count=given["count"], seed=given["seed"], limits=self.limit_set, families=(), boxes=path_families.BOXES,
                yaw=YawMode.FREE,
            )  # fmt: skip
            return row_path(spec, given["row"])
        return min_snap(_POINTS[kind](given))

    @property
    def task(self) -> PlanningTask:
        return PlanningTask(self.path, self.airframe, self.limits, self.nodes, self.yaw)

    @property
    def airframe(self) -> Airframe:
        return LIMIT_SETS[self.limit_set].airframe

    @property
    def limits(self) -> PlanLimits:
        return replace(LIMIT_SETS[self.limit_set].limits, **self.change)


def hard_paths(expectation: str) -> list[Any]:
    """Return a pytest parameter for each case with an expectation of "path", "expert" or "plan"."""
    return [
        pytest.param(case, id=f"{case.name}, {case.limit_set}, {case.yaw}", marks=[pytest.mark.slow] * is_slow)
        for case, is_slow in _cases()
        if expectation in case.expect
    ]


def _cases() -> list[tuple[HardPath, bool]]:
    found = []
    for entry in yaml.safe_load(FILE.read_text()):
        shape = {key: entry[key] for key in SHAPES & set(entry)}
        assert len(shape) == 1, f"{entry['name']}: one of {SHAPES}"
        assert set(entry) <= KEYS | SHAPES, f"{entry['name']}: {set(entry) - KEYS - SHAPES}"
        assert set(entry["expect"]) <= EXPECTATIONS, entry["name"]
        for limit_set, yaw in itertools.product(
            _listed(entry.get("limits", "hardware")), _listed(entry.get("yaw", "fixed"))
        ):
            case = HardPath(
                entry["name"], shape, limit_set, entry.get("change", {}), YawMode(yaw), entry.get("nodes", 100),
                entry["expect"],
            )  # fmt: skip
            found.append((case, entry.get("slow", False)))
    return found


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _random(given: dict[str, Any]) -> NDArray:
    """Waypoints drawn in a named box whose low corner is the origin, as the studies draw theirs."""
    box = np.array([[0.0, 0.0, 0.0], BOXES[given["box"]]])
    return random_waypoints(given["seed"], box)


def _coil(given: dict[str, float]) -> NDArray:
    """Twelve waypoints a turn, `rise` m up each turn."""
    angle = np.arange(round(12 * given["turns"]) + 1) * (2 * np.pi / 12)
    radius = given["radius"]
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0.5 + given["rise"] * angle / (2 * np.pi)])


def _spaced(given: dict[str, float]) -> NDArray:
    """Waypoints `step` m apart along x, to one side and the other by `sideways` m."""
    count = np.arange(given["count"])
    return np.column_stack([given["step"] * count, given["sideways"] * (-1.0) ** count, np.ones(len(count))])


_POINTS = {"waypoints": np.array, "random": _random, "coil": _coil, "spaced": _spaced}
