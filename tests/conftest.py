"""What tests of several packages share: profiles, limits, and how examples are drawn."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from scipy.interpolate import BSpline

from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits
from cfplan.vehicle.profile import SpeedProfile

REPOSITORY = Path(__file__).parents[1]

# A verdict depends neither on how busy the computer is nor on the day: no deadlines, and the same examples on each run.
# `make fuzz` draws others: pytest -m hypothesis --hypothesis-profile=random
settings.register_profile("random", deadline=None)
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")


def spline_profile(end, h_coefficients, yaw_coefficients=None) -> SpeedProfile:
    """A profile over [0, end] of len(h_coefficients) - 3 intervals, by the coefficients of B-splines.

    h lies between the least and the largest of its coefficients, so positive ones make a sound profile.
    """
    h_coefficients = np.asarray(h_coefficients, dtype=float)
    intervals = len(h_coefficients) - 3
    if yaw_coefficients is None:
        yaw_coefficients = np.zeros(intervals + 2)
    grid = np.linspace(0.0, end, intervals + 1)
    step = grid[1]
    h = BSpline(step * np.arange(-3, intervals + 4), h_coefficients, 3)
    yaw = BSpline(step * np.arange(-2, intervals + 3), np.asarray(yaw_coefficients, dtype=float), 2)
    middle = (grid[:-1] + grid[1:]) / 2
    return SpeedProfile(
        s=grid, h=h(grid), dh=h(grid, 1), ddh=h(grid, 2), dddh=h(middle, 3),
        yaw=yaw(grid), dyaw=yaw(grid, 1), ddyaw=yaw(middle, 2),
    )  # fmt: skip


@pytest.fixture(scope="session")
def make_profile():
    return spline_profile


@pytest.fixture(scope="session")
def limits() -> Limits:
    """The limits of the project's own safety.yaml."""
    return load_limits(REPOSITORY / "safety.yaml")
