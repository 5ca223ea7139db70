"""What tests of several packages share: profiles, limits, and repeats of tests in real time that this computer spoiled.

A virtual machine whose host is busy stands still for tenths of seconds, and a flight in real time then ends as it
should: the vehicle brakes, or preflight refuses. Such a test is repeated, if possible in a calmer moment, but only
if a process that does nothing but sleep was late meanwhile: a fault of cfplan fails at once on a computer that keeps
time, and on any in the end. A flight that several tests look at is flown once, and anew for a test that is
repeated.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from scipy.interpolate import BSpline

from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits
from cfplan.studies.sleeper import Sleeper
from cfplan.vehicle.profile import SpeedProfile

REPOSITORY = Path(__file__).parents[1]
MOST_REPEATS = 3
RATE = 200.0  # Hz, at which the sleeper wakes
STANDSTILL = 0.02  # s late
CALM, PATIENCE = 2.0, 30.0  # s without one before a test is repeated, and the longest wait for that

Result = TypeVar("Result")


class Standstills:
    """Standstills of this computer, as seen by a process that only sleeps."""

    def __init__(self) -> None:
        self._sleeper = Sleeper(RATE, first=True).__enter__()
        self.since = 0.0  # by time.monotonic(), when the act began that the present attempt at a test looks at

    def seen(self) -> bool:
        """Return whether there was one in what the present attempt looks at."""
        return max(self._sleeper.late(begin=self.since), default=0.0) > STANDSTILL

    def settle(self) -> None:
        """Wait until there has been none for CALM, but at most for PATIENCE."""
        end = time.monotonic() + PATIENCE
        while (now := time.monotonic()) < end:
            if max(self._sleeper.late(begin=now - CALM), default=0.0) <= STANDSTILL:
                break
            time.sleep(CALM / 4)

    def close(self) -> None:
        self._sleeper.__exit__()


_standstills = pytest.StashKey[Standstills]()


@pytest.hookimpl(trylast=True)  # when what is not selected has gone
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Let every test in real time be repeated."""
    in_real_time = [item for item in items if item.get_closest_marker("integration")]
    if in_real_time and not config.option.collectonly:
        watch = config.stash[_standstills] = Standstills()
        for item in in_real_time:
            item.add_marker(pytest.mark.flaky(reruns=MOST_REPEATS, condition=watch.seen))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    watch = item.config.stash.get(_standstills, None)
    if watch is not None:
        if _is_repeated(item):
            watch.settle()
        watch.since = time.monotonic()


def _is_repeated(item: pytest.Item) -> bool:
    return getattr(item, "execution_count", 1) > 1


def pytest_unconfigure(config: pytest.Config) -> None:
    if _standstills in config.stash:
        config.stash[_standstills].close()


@pytest.fixture(scope="module")
def kept() -> dict[str, tuple[float, object]]:
    """When each act began, by its name, and its result."""
    return {}


@pytest.fixture
def once(request, kept) -> Callable[[Callable[[], Result]], Result]:
    """Does an act in real time once for all tests of a module that look at it, and anew where one is repeated."""
    standstills = request.config.stash[_standstills]

    def do(act: Callable[[], Result]) -> Result:
        name = act.__qualname__
        if name not in kept or _is_repeated(request.node):
            begin = time.monotonic()
            kept[name] = begin, act()
        standstills.since, result = kept[name]
        return result

    return do


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
