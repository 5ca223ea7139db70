"""No limit is exceeded anywhere on a trajectory that passed: attacked with rough profiles and far finer grids."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from certificate_oracle import AIRFRAME, LIMITS, SPACE, worst_values
from hypothesis import example, given, settings
from hypothesis import strategies as st

from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.safety.certificate import certify, raise_peaks, sampled, segments_of
from cfplan.safety.limits import PlanLimits
from cfplan.safety.slowing import slow_until_certified
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.flatness import flat_state
from cfplan.vehicle.trajectory import Trajectory

points = st.tuples(st.floats(-2, 2), st.floats(-3.5, 3.5), st.floats(0.3, 1.7))
gentle = st.floats(0.5, 2.0)
rough = st.floats(0.02, 6.0)


def make(make_profile, waypoints, coefficients, turns, scale):
    apart = np.linalg.norm(np.diff(waypoints, axis=0), axis=1) > 0.1
    waypoints = np.array(waypoints)[np.r_[True, apart]]
    path = min_snap(waypoints if len(waypoints) > 1 else [[0, 0, 1], [0.5, 0, 1]])
    yaw = np.resize(turns, len(coefficients) - 1).cumsum()
    return Trajectory(path, make_profile(path.end, scale * np.array(coefficients), yaw), AIRFRAME)


def as_upper(margin):
    """The worst value with the sign of `worst_values`: larger is worse."""
    return -margin.worst if "least" in margin.name or "walls" in margin.name else margin.worst


@settings(max_examples=25, deadline=None)
@example(
    [(-2.0, 2.6875, 1.0), (-1.5, 0.625, 1.0)], [1.0] * 4 + [3.5, 4.0] + [1.0] * 3, [0.0] * 3 + [1.0, 0.0, 1.0], 2.375
)
@given(
    st.lists(points, min_size=2, max_size=4),
    st.one_of(st.lists(gentle, min_size=6, max_size=25), st.lists(rough, min_size=6, max_size=25)),
    st.lists(st.floats(-1, 1), min_size=1, max_size=25),
    st.floats(0.1, 4.0),
)
def test_nothing_between_the_samples_is_worse_than_the_certificate_says(make_profile, waypoints, rates, turns, scale):
    trajectory = make(make_profile, waypoints, rates, turns, scale)
    certificate = certify(trajectory, LIMITS, SPACE)
    true = worst_values(trajectory, SPACE)
    for margin in certificate.margins:
        # Far beyond the limits thrust can vanish and the attitude flip within a millisecond; failed is failed then.
        if margin.share < 3.0 and certificate.worst.share < 100.0:
            assert as_upper(margin) >= true[margin.name] - 1e-12, margin.name
            assert as_upper(margin) <= true[margin.name] + 0.02 * abs(margin.limit), f"{margin.name} is overstated"


@settings(max_examples=15, deadline=None)
@given(
    st.lists(points, min_size=2, max_size=4),
    st.lists(rough, min_size=6, max_size=40),
    st.lists(st.floats(-1, 1), min_size=1, max_size=25),
)
def test_what_just_passes_keeps_every_limit_on_a_far_finer_grid(make_profile, waypoints, rates, turns):
    slowed = slow_until_certified(make(make_profile, waypoints, rates, turns, 4.0), LIMITS)
    true = worst_values(slowed.trajectory, SPACE)
    assert true["speed"] <= LIMITS.speed
    assert true["acceleration"] <= LIMITS.acceleration
    assert true["angular velocity"] <= LIMITS.angular_velocity
    assert true["tilt"] <= LIMITS.tilt
    assert true["motor thrust, most"] <= LIMITS.motor_thrust_max
    assert -true["motor thrust, least"] >= LIMITS.motor_thrust_min
    assert -true["specific thrust, least"] >= LIMITS.specific_thrust_min


@pytest.fixture(scope="module")
def trajectory(make_profile):
    path, random = min_snap([[0, 0, 1], [1, 1.5, 1.3], [-1, 2, 0.7]]), np.random.default_rng(0)
    return Trajectory(path, make_profile(path.end, random.uniform(0.8, 1.3, 30)), AIRFRAME)


def _peak(rows, sign, counts):
    """Index and value of the peak of all rows."""
    values, places, table = np.array([-np.inf]), np.array([-1.0]), np.array([[0, len(rows), sign]])
    raise_peaks(values, np.zeros(1), places, table, rows, np.arange(float(rows.shape[1])), counts)
    return int(places[0]), values[0]


def test_a_smooth_peak_between_samples_is_not_missed():
    for shift in np.linspace(0, 1, 21):
        angles = (np.arange(20) - 9.5 + shift) * 0.2
        assert 1.0 <= _peak(np.cos(angles)[None], 1, np.array([20]))[1] <= 1.02
        # A valley has no peak inside: nothing is added to what stands at its ends.
        valley = np.cos(angles[5:15])[None]
        assert _peak(valley, -1, np.array([10]))[1] == _peak(-valley, 1, np.array([10]))[1] == -valley[0, [0, -1]].min()


def test_a_peak_in_the_first_or_last_gap_of_a_piece_is_not_missed():
    for shift in np.linspace(0, 1, 21):
        angles = (np.arange(10) - shift) * 0.2
        for values in (np.cos(angles), np.cos(angles)[::-1]):
            assert 1.0 <= _peak(np.ascontiguousarray(values)[None], 1, np.array([10]))[1] <= 1.02


def test_a_jump_between_pieces_is_no_peak():
    values = np.array([[0.0, 0.0, 0.0, 5.0, 5.0, 5.0]])
    index, peak = _peak(values, 1, np.array([3, 3]))
    assert index in (3, 4, 5)
    assert peak == 5.0


@pytest.mark.parametrize("counts", [[800], [255, 3, 542], [256, 257, 287]])
def test_a_peak_is_found_wherever_it_stands_among_many_samples(counts):
    last = np.cumsum(counts) - 1
    ends = np.concatenate([last, last + 1 - counts])
    for place in range(800):
        values = np.zeros((2, 800))
        values[1, place] = 1.0
        # by an eighth of the second difference there, twice over, except where there is none
        assert _peak(values, 1, np.array(counts)) == (place, 1.0 if place in ends else 1.5)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_one_value_that_is_not_finite_fails(wrong):
    for place in range(6):
        values = np.ones((2, 6))
        values[1, place] = wrong
        assert not np.isfinite(_peak(values, 1, np.array([3, 3]))[1])


def test_samples_are_a_millisecond_apart_at_most_and_at_least_ten_to_an_interval(trajectory):
    segments = segments_of(trajectory)
    s, _, _ = sampled(segments, 0, len(segments.counts))
    assert np.diff(trajectory.time_at(s)).max() <= 1.001e-3
    assert np.bincount(np.repeat(segments.interval, segments.counts)).min() >= 10
    assert len(segments.counts) >= len(np.union1d(trajectory.profile.s, trajectory.path.breaks)) - 1
    fast = Trajectory(trajectory.path, trajectory.profile.slowed(50.0), AIRFRAME)
    assert certify(fast, LIMITS).samples >= 10 * (len(trajectory.profile.s) - 1)


def plainly(trajectory, limits, samples):
    """The certificate's rule, sample by sample, on the flatness map in plain numpy: the worst of each quantity."""
    path, profile, segments = trajectory.path, trajectory.profile, segments_of(trajectory)
    gaps = segments.counts - 1
    nearer = (samples - len(gaps)) // gaps.sum()
    assert nearer in (1, 4, 16)
    worst = {}
    for left, right, interval, _, count in zip(*segments._replace(counts=nearer * gaps + 1), strict=True):
        s = np.append((left + np.arange(count) / (count - 1) * (right - left))[:-1], np.nextafter(right, 0))
        at = profile.at(s, np.full(count, interval))
        derivatives = tuple(tuple(path(s, order).T) for order in (1, 2, 3, 4))
        flat = flat_state(trajectory.airframe, derivatives, at[:4], at[4:], np.cos, np.sin)
        x, y, z = flat.thrust_axis
        middle = (np.array(SPACE.low) + SPACE.high) / 2
        for name, rows in {
            "speed": [np.square(flat.velocity).sum(axis=0)],
            "acceleration": [np.square(flat.acceleration).sum(axis=0)],
            "angular velocity": [np.square(flat.body_rate).sum(axis=0)],
            "angular acceleration": [np.square(flat.angular_acceleration).sum(axis=0)],
            "tilt": [np.tan(np.arctan2(np.hypot(x, y), z) / 2) ** 2],
            "motor thrust, most": flat.motor_thrust,
            "motor thrust, least": [-thrust for thrust in flat.motor_thrust],
            "specific thrust, least": [-flat.specific_thrust],
            "distance to the walls": list((np.abs(path(s) - middle) - (np.array(SPACE.high) - middle)).T),
        }.items():
            for row in rows:
                largest = np.maximum(np.maximum(row[:-2], row[1:-1]), row[2:])
                bound = (largest + np.maximum(2 * row[1:-1] - row[:-2] - row[2:], 0.0) / 4).max()
                worst[name] = max(worst.get(name, -np.inf), bound)
    for name in ("speed", "acceleration", "angular velocity", "angular acceleration"):
        worst[name] = np.sqrt(worst[name])
    worst["tilt"] = 2.0 * np.arctan(np.sqrt(worst["tilt"]))
    return worst


@settings(max_examples=10, deadline=None)
@given(
    st.lists(points, min_size=2, max_size=4),
    st.one_of(st.lists(gentle, min_size=6, max_size=15), st.lists(rough, min_size=6, max_size=15)),
    st.lists(st.floats(-1, 1), min_size=1, max_size=15),
    st.floats(0.5, 3.0),
)
def test_the_compiled_certificate_is_that_of_plain_numpy(make_profile, waypoints, rates, turns, scale):
    trajectory = make(make_profile, waypoints, rates, turns, scale)
    limits = replace(LIMITS, angular_acceleration=35.0)
    certificate = certify(trajectory, limits, SPACE)
    expected = plainly(trajectory, limits, certificate.samples)
    assert len(certificate.margins) == len(expected)
    worst = {margin.name: as_upper(margin) for margin in certificate.margins}
    if np.isnan(list(worst.values())).any():  # without thrust there is no attitude, and no certificate
        assert not certificate.passed
        assert worst["specific thrust, least"] == pytest.approx(0.0, abs=1e-9)
        return
    for margin in certificate.margins:
        assert as_upper(margin) == pytest.approx(expected[margin.name], rel=1e-9, abs=1e-9), margin.name


def test_the_worst_value_is_where_and_when_the_certificate_says(trajectory):
    margins = {margin.name: margin for margin in certify(trajectory, LIMITS, SPACE).margins}
    for name, value_of in (
        ("speed", lambda state: np.linalg.norm(state.velocity)),
        ("acceleration", lambda state: np.linalg.norm(state.acceleration)),
        ("tilt", lambda state: np.arccos(state.thrust_axis[2])),
        ("specific thrust, least", lambda state: state.specific_thrust),
    ):
        state = trajectory.at(margins[name].time)
        np.testing.assert_allclose(state.position, margins[name].position, atol=1e-6)
        assert margins[name].worst == pytest.approx(value_of(state), rel=1e-3)


def test_shares_are_of_the_limit_or_of_the_way_down_from_hover(trajectory):
    margins = {margin.name: margin for margin in certify(trajectory, LIMITS, SPACE).margins}
    assert margins["speed"].share == pytest.approx(margins["speed"].worst / 2.0)
    least = margins["specific thrust, least"]
    assert least.share == pytest.approx((GRAVITY - least.worst) / (GRAVITY - 4.905))


def test_limits_that_hovering_breaks_never_pass(trajectory):
    still = Trajectory(trajectory.path, trajectory.profile.slowed(0.05), AIRFRAME)
    assert certify(still, LIMITS).passed
    for changes in ({"motor_thrust_min": 0.079}, {"motor_thrust_max": 0.077}, {"specific_thrust_min": 9.9}):
        assert not certify(still, replace(LIMITS, **changes)).passed


@pytest.mark.parametrize("name", [field.name for field in fields(PlanLimits)])
def test_a_limit_that_is_no_number_fails(trajectory, name):
    assert not certify(trajectory, replace(LIMITS, **{name: float("nan")})).passed


def test_leaving_the_space_fails_at_the_place(trajectory):
    narrow = Space(low=(-2.25, -4.0, 0.0), high=(2.25, 2.1, 2.0), margin=0.2)
    worst = certify(trajectory, LIMITS, narrow).worst
    farthest = trajectory.path(np.linspace(0, trajectory.path.end, 5000))[:, 1].max()
    assert worst.name == "distance to the walls"
    assert worst.position[1] == pytest.approx(float(farthest), abs=1e-5)
    assert worst.worst == pytest.approx(2.1 - float(farthest), abs=1e-5)


def test_the_certificate_is_json_and_a_table(trajectory):
    certificate = certify(trajectory, LIMITS, SPACE)
    data = json.loads(json.dumps(certificate.to_dict(), allow_nan=False))
    assert data["passed"] is certificate.passed
    assert len(data["margins"]) == len(certificate.rows()) == 8
    assert certificate.rows()[0][0] == "speed"


@pytest.mark.parametrize("steep_first", [False, True])
def test_a_break_in_the_snap_of_a_path_is_seen_from_both_sides(make_profile, steep_first):
    # Straight along x in one piece; in the other y is a quartic that starts from s = 1 with its first derivatives 0.
    # The last piece counts from its right end, s = 2.
    table = np.zeros((2, 5, 3))
    table[:, 0, 2] = 1.0
    table[:, 1, 0] = 1.0
    table[1, 0, 0] = 2.0
    quartic = np.polynomial.Polynomial([1.0, 1.0 if not steep_first else -1.0]) ** 4
    if steep_first:
        table[0, :, 1] = 0.2 * np.polynomial.Polynomial([-1.0, 1.0]).__pow__(4).coef
    else:
        table[1, :, 1] = 0.2 * quartic.coef
    path = Path(np.array([0.0, 1.0, 2.0]), table)
    # Fast where the snap is, fastest at the break, where the profile has no grid point of its own.
    trajectory = Trajectory(path, make_profile(2.0, np.full(6, 2.0)), AIRFRAME)
    most = {margin.name: margin for margin in certify(trajectory, LIMITS).margins}["motor thrust, most"]
    assert most.worst >= worst_values(trajectory, SPACE)["motor thrust, most"]
