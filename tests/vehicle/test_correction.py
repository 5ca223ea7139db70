"""A shifted trajectory is the trajectory plus the shift, with all derivatives, and ends at rest."""

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.polynomials import shifted
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.correction import PlanCorrection, corrected, fit_correction
from cfplan.vehicle.trajectory import Trajectory

WAYPOINTS = [[0, 0, 1], [1.5, 1, 1.4], [1, -1.5, 0.6], [-1, 0.5, 1.2]]
TOLERANCES = {"position": 1e-7, "velocity": 1e-5, "acceleration": 1e-3, "jerk": 0.1}  # shifts are made of polynomials


def broken_beside(path: Path, s: np.ndarray) -> Path:
    """The same path with a break just after each s, as where a path was cut at other places than its profile."""
    breaks = np.unique(np.concatenate([path.breaks, s + 1e-5]))
    piece = np.clip(np.searchsorted(path.breaks, breaks[:-1] + 1e-9, side="right") - 1, 0, len(path.origins) - 1)
    origins = np.append(breaks[:-2], breaks[-1])
    return Path(breaks, shifted(path.coefficients[piece], origins - path.origins[piece]))


@pytest.fixture(scope="module")
def trajectory(make_profile):
    path, random = min_snap(WAYPOINTS), np.random.default_rng(3)
    profile = make_profile(path.end, random.uniform(0.8, 1.6, 40), random.uniform(-0.3, 0.3, 39).cumsum())
    return Trajectory(broken_beside(path, profile.s[1:-1]), profile, AIRFRAMES["crazyflie-2.1+"])


@pytest.fixture(scope="module")
def correction(trajectory):
    count = round(trajectory.duration / 0.3)
    return PlanCorrection(np.random.default_rng(4).uniform(-0.05, 0.05, (count, 3)), trajectory.duration)


@pytest.mark.parametrize("order", range(len(TOLERANCES)))
def test_each_derivative_is_that_of_the_trajectory_and_that_of_the_shift(trajectory, correction, order):
    times = np.random.default_rng(5).uniform(0.0, trajectory.duration, 500)
    name, off = list(TOLERANCES.items())[order]
    found = getattr(corrected(trajectory, correction).at(times), name)
    expected = getattr(trajectory.at(times), name) + correction.at(times)[:, order]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=off)


def test_it_begins_and_ends_at_rest_beside_the_trajectory(trajectory, correction):
    path = corrected(trajectory, correction).path
    for s, coefficient in ((0.0, correction.coefficients[0]), (path.end, correction.coefficients[-1])):
        assert path(s) == pytest.approx(trajectory.path(s) + coefficient, abs=1e-12)
        assert not any(path(s, order).any() for order in (1, 2, 3))


def test_the_speed_profile_stays(trajectory, correction):
    assert corrected(trajectory, correction).profile is trajectory.profile


@pytest.mark.parametrize(("frequency", "kept"), [(0.5, 1.0), (1.0, 1.0), (6.0, 0.0), (15.0, 0.0)])
def test_a_fit_follows_what_is_slow_and_leaves_out_what_is_fast(frequency, kept):
    times = np.arange(0.0, 8.0, 0.01)
    wave = 0.05 * np.sin(np.pi * times / 8.0) ** 4 * np.sin(2 * np.pi * frequency * times)
    shifts = np.stack([wave, -wave, 0.0 * wave], axis=1)
    np.testing.assert_allclose(fit_correction(times, shifts, 8.0, 0.25).at(times)[:, 0], kept * shifts, atol=5e-4)


@pytest.mark.parametrize("duration", [0.2, 1.0, 2.3])
def test_a_short_flight_is_fitted_too(duration):
    times = np.linspace(0.0, duration, 50)
    found = fit_correction(times, np.full((50, 3), 0.03), duration, 0.25)
    np.testing.assert_allclose(found.at(times)[:, 0], 0.03, atol=1e-12)


@pytest.mark.parametrize(
    ("coefficients", "duration"),
    [(np.zeros((0, 3)), 1.0), (np.full((4, 3), np.nan), 1.0), (np.zeros((4, 3)), 0.0), (np.zeros((4, 3)), np.inf)],
)
def test_no_numbers_and_no_time_are_refused(coefficients, duration):
    with pytest.raises(InputError, match="correction"):
        PlanCorrection(coefficients, duration)


def test_a_correction_of_another_plan_is_refused(trajectory):
    with pytest.raises(InputError, match=r"not \d"):
        corrected(trajectory, PlanCorrection(np.zeros((4, 3)), trajectory.duration + 0.1))
