"""Polynomials for the vehicle: what it decodes stays near the plan and within every limit, reckoned independently."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfplan.errors import NotCertifiedError
from cfplan.flight.on_board.certified_pieces import FARTHEST, certified_compressed, certified_pieces
from cfplan.flight.on_board.fitting import even_knots, fit_control_points, fit_pieces
from cfplan.flight.on_board.memory_format import YAW_READ_SINCE
from cfplan.flight.on_board.piece_certificate import certify_pieces, check_joints, measures_along, sample_pieces
from cfplan.flight.on_board.pieces import Pieces, derivatives_of, goals_at
from cfplan.flight.on_board.reference import PolynomialReference
from cfplan.geometry.path_file import load_path_file, path_through
from cfplan.planning.plan import plan
from cfplan.safety.certificate import OBSTACLES, certify
from cfplan.safety.limits_file import load_limits
from cfplan.safety.space import Cylinder
from cfplan.simulation.on_board_run import on_board_run
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.measures import ANGULAR_ACCELERATION, BODY_RATE, MOTOR_THRUST, TILT

FLIGHTS = Path(__file__).parents[3] / "flights"
POINTS = [[-1.2, -1.2, 0.7], [0.2, 0.4, 1.1], [1.2, -0.6, 0.9], [1.2, 1.2, 1.1]]


def planned(path_file, limits):
    gentle = replace(limits.plan, angular_acceleration=0.57 * limits.plan.angular_acceleration)
    return plan(
        path_file.path, limits.airframe, replace(limits, plan=gentle), yaw=path_file.yaw, yaw_angle=path_file.yaw_angle
    ).trajectory


@pytest.fixture(scope="module")
def limits():
    read = load_limits(FLIGHTS.parent / "safety.yaml")
    return replace(read, firmware=replace(read.firmware, oldest=YAW_READ_SINCE))


@pytest.fixture(scope="module")
def trajectory(limits):
    return planned(path_through(POINTS), limits)


@pytest.fixture(scope="module")
def turning(limits):
    """A plan whose yaw turns."""
    return planned(load_path_file(FLIGHTS / "slalom.yaml"), limits)


@pytest.fixture(scope="module")
def made(trajectory, limits):
    return certified_pieces(trajectory, limits)


def independent_excess(pieces, limits):
    """The most by which the decoded motion exceeds a limit, as a share: by differences of what the commander says.

    Attitudes are those of the thrust axis, drag included, with y along z × yaw; rates are differences of attitudes.
    """
    step, airframe = 2e-4, limits.airframe
    times = np.random.default_rng(1).uniform(2 * step, pieces.duration - 2 * step, 4000)
    begins, k = pieces.begins, np.searchsorted(pieces.begins, times, side="right") - 1
    inside = (times - 2 * step > begins[k]) & (times + 2 * step < begins[k] + pieces.durations[k])
    times, k = times[inside], k[inside]

    def attitude(at):
        flat = np.concatenate(
            [derivatives_of(pieces, piece, np.array([t - begins[piece]])) for piece, t in zip(k, at, strict=True)]
        )
        force = flat[:, 2, :3] + airframe.drag[0] / airframe.mass * flat[:, 1, :3] + [0.0, 0.0, GRAVITY]
        z = force / np.linalg.norm(force, axis=1)[:, None]
        y = np.cross(z, np.stack([np.cos(flat[:, 0, 3]), np.sin(flat[:, 0, 3]), 0 * z[:, 0]], axis=1))
        y /= np.linalg.norm(y, axis=1)[:, None]
        return Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=2)), flat, z

    (before, _, _), (here, flat, z), (after, _, _) = (attitude(times + by) for by in (-step, 0.0, step))
    first, second = ((a.inv() * b).as_rotvec() / step for a, b in ((before, here), (here, after)))
    plan, rate, turning = limits.plan, (first + second) / 2, (second - first) / step
    shares = [
        np.linalg.norm(flat[:, 1, :3], axis=1) / plan.speed,
        np.linalg.norm(flat[:, 2, :3], axis=1) / plan.acceleration,
        np.linalg.norm(rate, axis=1) / plan.angular_velocity,
        np.linalg.norm(turning, axis=1) / plan.angular_acceleration,
        np.arccos(z[:, 2]) / plan.tilt,
    ]
    inside = limits.space.beyond(goals_at(pieces, times).position).max()
    return max(float(share.max()) for share in shares), float(inside)


@pytest.mark.parametrize("make", [certified_pieces, certified_compressed])
def test_what_the_vehicle_decodes_keeps_every_limit_near_the_plan(trajectory, limits, make):
    made = make(trajectory, limits)
    assert made.certificate.passed
    share, beyond = independent_excess(made.pieces, limits)
    assert share <= 1.0 + 1e-3  # of the differences
    assert beyond <= 0.0
    assert made.error <= FARTHEST
    assert 0 < len(made.memory) <= 4096
    assert made.duration < 1.15 * trajectory.duration + 1.0


def test_yaw_that_turns_is_flown_too(turning, limits):
    made = certified_compressed(turning, limits, leads=False)
    goals = goals_at(made.pieces, np.linspace(0.0, made.duration, 50))
    wanted = made.reference.plan_at(np.linspace(0.0, made.duration, 50))[:, 0, 3]
    assert np.abs(goals.yaw - wanted).max() < np.radians(3.0)
    assert independent_excess(made.pieces, limits)[0] <= 1.0 + 1e-3


def test_yaw_is_not_compressed_for_firmware_that_misreads_it(trajectory, turning, limits):
    earlier = replace(limits, firmware=replace(limits.firmware, oldest=(2026, 4)))
    with pytest.raises(NotCertifiedError, match=r"2026\.08") as refused:
        certified_compressed(turning, earlier, leads=False)
    assert "firmware.oldest" in refused.value.hint
    assert certified_compressed(trajectory, earlier).certificate.passed  # its yaw is always 0


def test_measures_are_those_of_differences_of_attitude(turning, limits):
    pieces = certified_pieces(turning, limits, leads=False).pieces
    step, (begin, duration) = 1e-4, (pieces.begins[5], float(pieces.durations[5]))
    own = np.linspace(0.1, 0.9, 7) * duration

    def attitudes(times):
        flat = derivatives_of(pieces, 5, times)
        force = flat[:, 2, :3] + limits.airframe.drag[0] / limits.airframe.mass * flat[:, 1, :3] + [0, 0, GRAVITY]
        z = force / np.linalg.norm(force, axis=1)[:, None]
        y = np.cross(z, np.stack([np.cos(flat[:, 0, 3]), np.sin(flat[:, 0, 3]), 0 * z[:, 0]], axis=1))
        y /= np.linalg.norm(y, axis=1)[:, None]
        return Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=2))

    before, here, after = (attitudes(own + by) for by in (-step, 0.0, step))
    first, second = (before.inv() * here).as_rotvec() / step, (here.inv() * after).as_rotvec() / step
    samples = sample_pieces(pieces)
    nearest = [int(np.argmin(np.abs(samples.time - begin - t))) for t in own]
    measured = measures_along(samples, limits.airframe)[:, nearest]
    rate, turn = (first + second) / 2, (second - first) / step
    np.testing.assert_allclose(np.sqrt(measured[BODY_RATE]), np.linalg.norm(rate, axis=1), rtol=0.05, atol=0.02)
    np.testing.assert_allclose(
        np.sqrt(measured[ANGULAR_ACCELERATION]), np.linalg.norm(turn, axis=1), rtol=0.1, atol=0.3
    )
    tilt = np.arccos(here.as_matrix()[:, 2, 2])
    np.testing.assert_allclose(2 * np.arctan(np.sqrt(measured[TILT])), tilt, rtol=0.02, atol=1e-3)


def test_the_certificate_agrees_with_that_of_the_plan_where_the_fit_is_close(trajectory, limits):
    """Two certificates that share no code but the table of limits."""
    slow = replace(limits.plan, angular_acceleration=limits.plan.angular_acceleration * 0.3)
    gentle = plan(path_through(POINTS).path, limits.airframe, replace(limits, plan=slow), speed_factor=0.7).trajectory
    made = certified_pieces(gentle, limits, leads=False)
    assert made.reference.slowing == 1.0
    whole = {margin.name: margin.worst for margin in certify(gentle, limits.plan, limits.space).margins}
    for margin in made.certificate.margins:
        if margin.name not in ("angular acceleration",):
            assert margin.worst == pytest.approx(whole[margin.name], rel=0.04), margin.name


def test_compressed_pieces_meet_as_smoothly_as_if_nothing_were_rounded(trajectory):
    curve = fit_control_points(PolynomialReference(trajectory), 9)
    assert np.array_equal(curve.points, np.round(curve.points))
    before = np.concatenate([curve.start[None, :, None] * np.ones((1, 1, 1), dtype=int), curve.points[:-1, :, -1:]])
    whole = np.concatenate([before, curve.points], axis=2)  # (K, 4, 8)
    for order in range(1, 4):
        differences = np.diff(whole, n=order, axis=2)
        np.testing.assert_array_equal(differences[:-1, :, -1], differences[1:, :, 0])
    ends = np.diff(whole, axis=2)
    assert not ends[0, :, :3].any()
    assert not ends[-1, :, -3:].any()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_pieces_are_fitted_too(trajectory, count):
    reference = PolynomialReference(trajectory, leads=False)
    pieces = fit_pieces(reference, even_knots(reference, count))
    check_joints(pieces)
    assert pieces.duration == pytest.approx(trajectory.duration, rel=1e-6)
    assert len(fit_control_points(reference, count).points) == count


def test_with_a_lead_the_vehicle_is_on_the_plan_that_drag_would_hold_it_behind(trajectory, limits, made):
    """By the median of drawn vehicles."""
    plain = on_board_run(certified_pieces(trajectory, limits, leads=False), limits)
    led = on_board_run(made, limits)
    assert plain.passed
    assert led.passed
    assert plain.deviation_median > 0.05
    assert led.deviation_median < 0.6 * plain.deviation_median


def test_pieces_that_do_not_meet_are_refused(made):
    coefficients = made.pieces.coefficients.copy()
    coefficients[3, 1, 0] += 0.01
    with pytest.raises(NotCertifiedError, match=r"position jumps by 0\.01 m"):
        check_joints(Pieces(made.pieces.durations, coefficients))


def test_pieces_that_begin_in_motion_are_refused(made):
    with pytest.raises(NotCertifiedError, match="jumps"):
        check_joints(Pieces(made.pieces.durations[2:], made.pieces.coefficients[2:]))


def test_pieces_that_are_too_fast_fail(made, limits):
    quick = Pieces(made.pieces.durations / 1.1, made.pieces.coefficients * 1.1 ** np.arange(8))
    certificate = certify_pieces(quick, limits.airframe, limits.plan, limits.space)
    assert not certificate.passed


@pytest.mark.parametrize(("clear", "passed"), [(0.01, True), (-0.01, False)])
def test_pieces_keep_the_margin_from_obstacles_or_fail(made, limits, clear, passed):
    """A pole beside the way, its distance from it by a far finer grid."""
    places = goals_at(made.pieces, np.linspace(0.0, made.pieces.duration, 50_001)).position
    x, y = places[20_000, :2].tolist()
    nearest = np.hypot(places[:, 0] - x - 0.5, places[:, 1] - y).min()
    pole = Cylinder(x + 0.5, y, float(nearest) - limits.space.margin - clear, 0.0, 2.0)
    space = replace(limits.space, obstacles=(pole,))
    certificate = certify_pieces(made.pieces, limits.airframe, limits.plan, space)
    found = next(each for each in certificate.margins if each.name == OBSTACLES)
    assert found.passed == certificate.passed == passed
    assert found.worst == pytest.approx(limits.space.margin + clear, abs=1e-3)


def test_too_few_pieces_for_a_plan_are_refused_with_how_far_they_stray(limits):
    trajectory = planned(load_path_file(FLIGHTS / "figure8.yaml"), limits)
    with pytest.raises(NotCertifiedError, match=r"stray .* m from the plan"):
        certified_pieces(trajectory, limits, most=5)


def test_a_flight_too_long_for_the_memory_is_refused_with_how_long_it_may_be(turning, limits):
    with pytest.raises(NotCertifiedError, match=r"of \d+ s; of one like this 250 bytes hold some [1-7] s") as why:
        certified_compressed(turning, limits, room=250)
    assert "laps" in why.value.hint
    enough = certified_compressed(turning, limits)
    assert enough.error <= FARTHEST
    assert len(enough.memory) > 250


def test_as_many_compressed_pieces_are_tried_as_the_room_holds(trajectory, limits):
    room = len(certified_compressed(trajectory, limits).memory) - 1
    assert len(certified_compressed(trajectory, limits, room=room).memory) > room - 3 * 60  # bytes of three pieces


def test_motors_reach_their_limit_where_the_certificate_says(made, limits):
    samples = sample_pieces(made.pieces)
    highest = measures_along(samples, limits.airframe)[MOTOR_THRUST : MOTOR_THRUST + 4].max()
    margin = next(margin for margin in made.certificate.margins if margin.name == "motor thrust, most")
    assert highest <= margin.worst <= highest * 1.01
