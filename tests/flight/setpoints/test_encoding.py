"""A trajectory as bytes: they say what was planned, and nothing else passes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.byte_check import check_bytes, check_motion
from cfplan.flight.setpoints.encoding import (
    LEAD,
    RATE_LEAD,
    THRUST_LEAD,
    command_quaternion,
    controller_attitude,
    encode_motion,
    encode_trajectory,
    motion_at,
)
from cfplan.flight.setpoints.level_out import BRAKE_LEAD, UNTIL_WATCHDOG
from cfplan.flight.setpoints.packets import decode, encode
from cfplan.flight.setpoints.rate_trade import FIRMWARE_GAINS, AttitudeGains, motion_of_sent
from cfplan.geometry.min_snap import min_snap
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

AIRFRAME = AIRFRAMES["crazyflie-2.1+"]
LIMITS = PlanLimits(
    speed=2.0, acceleration=5.0, angular_velocity=8.0, tilt=np.radians(30), motor_thrust_min=0.0,
    motor_thrust_max=0.12, specific_thrust_min=4.905,
)  # fmt: skip


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    """A slalom at constant h, near 2 m/s, that turns by a radian on the way."""
    path = min_snap([[0, 0, 1], [1, 0.6, 1.2], [2, -0.6, 0.9], [3, 0.6, 1.1], [4, 0, 1]])
    s, step = np.linspace(0, path.end, 61, retstep=True)
    ddyaw = np.repeat([4.0, -4.0], 30) / path.end**2
    dyaw = np.append(0.0, np.cumsum(ddyaw) * step)
    yaw = np.append(0.0, np.cumsum((dyaw[:-1] + dyaw[1:]) / 2 * step))
    h, none = np.full(61, 0.9), np.zeros(61)
    profile = SpeedProfile(s, h, none, none, none[:-1], yaw, dyaw, ddyaw)
    return Trajectory(path, profile, AIRFRAME)


@pytest.fixture(scope="module")
def encoded(trajectory):
    return encode_trajectory(trajectory)


def ahead_of(encoded, trajectory):
    return trajectory.at(encoded.times + LEAD + BRAKE_LEAD).acceleration


@pytest.fixture(scope="module")
def flown(encoded, trajectory):
    """The motion that the bytes make the vehicle fly."""
    motion = motion_at(trajectory, encoded.times + LEAD)
    return check_motion(encoded.payloads, motion, ahead_of(encoded, trajectory), FIRMWARE_GAINS)


def test_a_setpoint_is_due_every_ten_milliseconds_until_well_after_the_end(encoded, trajectory):
    assert np.diff(encoded.times) == pytest.approx(0.01)
    assert encoded.times[0] == 0.0
    assert trajectory.duration + 0.5 <= encoded.duration <= trajectory.duration + 0.53
    assert encoded.payloads.shape == (len(encoded.times), 29)


def test_it_begins_and_ends_in_hover(encoded, trajectory):
    told = encoded.decoded
    assert told.position[0] == pytest.approx(trajectory.path(0.0), abs=5e-4)
    assert told.velocity[0] == pytest.approx(0.0)
    after = encoded.times >= trajectory.duration
    for values in (told.velocity, told.acceleration, told.body_rate):
        assert np.all(values[after] == 0.0)
    assert told.position[after] == pytest.approx(
        np.tile(trajectory.path(trajectory.path.end), (sum(after), 1)), abs=5e-4
    )


def test_the_acceleration_field_makes_up_for_drag(encoded, trajectory):
    """Newton's second law: mass times planned acceleration is thrust, weight and drag together."""
    motion, ahead = encoded.motion, ahead_of(encoded, trajectory)  # without what is sent ahead
    flown = check_motion(encode_motion(motion, ahead), motion, ahead, FIRMWARE_GAINS)
    states = trajectory.at(encoded.times + LEAD)
    turn = Rotation.from_quat(states.quaternion)
    air = turn.inv().apply(states.velocity)
    drag = -turn.apply(air * [AIRFRAME.drag[0], AIRFRAME.drag[0], AIRFRAME.drag[1]])
    thrust = AIRFRAME.mass * (flown.acceleration + np.array([0, 0, GRAVITY]))
    weight = AIRFRAME.mass * np.array([0, 0, -GRAVITY])
    assert (thrust + weight + drag) / AIRFRAME.mass == pytest.approx(states.acceleration, abs=1e-3)
    assert np.linalg.norm(drag, axis=1).max() / AIRFRAME.mass > 0.5


def rates_to_send(trajectory, times):
    later, before = trajectory.at(times + RATE_LEAD).body_rate, trajectory.at(times - RATE_LEAD).body_rate
    return (0.8 * later + 0.2 * before) * (times < trajectory.duration)[:, None]


def test_body_rates_are_flown_ahead(flown, encoded, trajectory):
    later = rates_to_send(trajectory, encoded.times + LEAD)
    assert flown.body_rate == pytest.approx(later, abs=2e-3)


def test_thrust_is_flown_ahead_and_its_direction_is_not(flown, encoded, trajectory):
    force = flown.acceleration + np.array([0, 0, GRAVITY])
    thrust = np.linalg.norm(force, axis=1)
    assert thrust == pytest.approx(trajectory.at(encoded.times + LEAD + THRUST_LEAD).specific_thrust, abs=1e-3)
    assert force / thrust[:, None] == pytest.approx(trajectory.at(encoded.times + LEAD).thrust_axis, abs=2e-4)


def test_roll_and_pitch_rates_that_are_sent_are_small_and_the_yaw_rate_is_whole(encoded, trajectory):
    sent, planned = encoded.decoded.body_rate, rates_to_send(trajectory, encoded.times + LEAD)
    assert np.linalg.norm(planned[:, :2], axis=1).max() > 0.8
    assert np.linalg.norm(sent[:, :2], axis=1).max() <= UNTIL_WATCHDOG.rate_max + 1e-3
    assert sent[:, 2] == pytest.approx(planned[:, 2], abs=0.6e-3)


def test_the_torque_at_the_planned_attitude_is_that_of_the_planned_rates(encoded, trajectory):
    """Mellinger's attitude error, (Rd' R - R' Rd)/2, and his gains, at the attitude that he believes: 7 ms old."""
    times = encoded.times + LEAD
    planned, later = trajectory.at(times), rates_to_send(trajectory, times)
    sent = encoded.decoded
    wanted = controller_attitude(sent.acceleration + np.array([0, 0, GRAVITY]), sent.quaternion)
    planned_turn = Rotation.from_quat(planned.quaternion)
    believed = (planned_turn * Rotation.from_rotvec(-0.007 * later * (1.0, 1.0, 0.0))).as_matrix()
    error = np.swapaxes(wanted, 1, 2) @ believed - np.swapaxes(believed, 1, 2) @ wanted
    turning = -70000.0 * np.stack([error[:, 2, 1], error[:, 0, 2]], axis=1)
    torque = turning + 20000.0 * (sent.body_rate - planned.body_rate)[:, :2]
    assert torque == pytest.approx(20000.0 * (later - planned.body_rate)[:, :2], abs=40.0)  # of 32000
    force = sent.acceleration + np.array([0, 0, GRAVITY])
    along = np.einsum("ni,ni->n", force, planned_turn.as_matrix()[:, :, 2])
    assert along == pytest.approx(trajectory.at(encoded.times + LEAD + THRUST_LEAD).specific_thrust, abs=2e-3)


def attitudes(tilt_max: float, count: int = 5000):
    random = np.random.default_rng(5)
    tilt, direction, yaw = tilt_max * random.random(count), *random.uniform(-np.pi, np.pi, (2, count))
    axis = np.stack([np.sin(tilt) * np.cos(direction), np.sin(tilt) * np.sin(direction), np.cos(tilt)], axis=1)
    turn = np.stack([-np.sin(direction), np.cos(direction), 0 * yaw], axis=1) * tilt[:, None]  # the least to the axis
    return axis, (Rotation.from_rotvec(turn) * Rotation.from_euler("z", yaw[:, None])).as_quat()


def angles(frames, quaternions):
    """rad between rotation matrices and quaternions."""
    return (Rotation.from_matrix(frames).inv() * Rotation.from_quat(quaternions)).magnitude()


def test_the_controller_arrives_at_the_planned_attitude_from_what_is_sent():
    axis, planned = attitudes(np.radians(60))
    sent = command_quaternion(planned)
    assert Rotation.from_quat(sent).apply([0, 0, 1]) == pytest.approx(axis, abs=1e-12)
    assert angles(controller_attitude(axis, sent), planned) == pytest.approx(0.0, abs=1e-7)


def test_sending_the_planned_attitude_itself_would_turn_the_vehicle_by_degrees():
    axis, planned = attitudes(np.radians(30))
    off = angles(controller_attitude(axis, planned), planned)
    assert 8.0 < np.degrees(off.max()) < 8.5


def test_its_own_bytes_pass(encoded, trajectory):
    check_bytes(encoded, trajectory, LIMITS)


def test_bytes_beyond_a_speed_limit_do_not_pass(encoded, trajectory):
    with pytest.raises(NotCertifiedError, match="speed"):
        check_bytes(encoded, trajectory, replace(LIMITS, speed=1.5))


@pytest.mark.parametrize("late", [1, -1])
@pytest.mark.parametrize("name", ["position", "velocity", "acceleration", "body_rate", "quaternion"])
def test_an_encoder_that_samples_the_trajectory_at_other_times_is_found(encoded, trajectory, name, late):
    """The check evaluates the trajectory by itself, so a fault of the encoder's sampling does not hide in both."""
    sent = encoded.decoded
    shifted = replace(sent, **{name: np.roll(getattr(sent, name), late, axis=0)})
    with pytest.raises(NotCertifiedError, match=f"{name}|body_rate"):  # braking goes by velocity and heading
        check_bytes(replace(encoded, payloads=encode(shifted)), trajectory, LIMITS)


def test_a_long_flight_is_encoded_and_checked_in_all_its_parts(trajectory):
    slow = Trajectory(trajectory.path, trajectory.profile.slowed(0.05), AIRFRAME)
    encoded = encode_trajectory(slow)
    assert len(encoded.payloads) > 4500
    check_bytes(encoded, slow, LIMITS)
    for row in (40, 4200):
        payloads = encoded.payloads.copy()
        payloads[row, 3] ^= 0x40
        with pytest.raises(NotCertifiedError, match="position") as caught:
            check_bytes(replace(encoded, payloads=payloads), slow, LIMITS)
        assert caught.value.where == f"setpoint {row}"


@pytest.mark.parametrize("byte", range(29))
def test_a_flipped_bit_in_any_byte_of_a_packet_is_found(encoded, trajectory, byte):
    payloads = encoded.payloads.copy()
    row = len(payloads) // 2
    payloads[row, byte] ^= 0x40
    with pytest.raises(NotCertifiedError) as caught:
        check_bytes(replace(encoded, payloads=payloads), trajectory, LIMITS)
    assert caught.value.where == f"setpoint {row}"


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("name", ["position", "velocity", "acceleration", "body_rate"])
def test_a_field_off_by_a_thousandth_is_found(encoded, trajectory, name, axis):
    told = decode(encoded.payloads)
    getattr(told, name)[40, axis] += 0.001
    changed = replace(encoded, payloads=encode(told))
    with pytest.raises(NotCertifiedError, match=name) as caught:
        check_bytes(changed, trajectory, LIMITS)
    assert caught.value.where == "setpoint 40"


def test_an_attitude_off_by_a_degree_of_yaw_is_found(encoded, trajectory):
    told = decode(encoded.payloads)
    told.quaternion[40] = (
        Rotation.from_euler("z", 1, degrees=True) * Rotation.from_quat(told.quaternion[40])
    ).as_quat()
    with pytest.raises(NotCertifiedError, match="quaternion"):
        check_bytes(replace(encoded, payloads=encode(told)), trajectory, LIMITS)


def test_packets_for_other_gains_are_found(trajectory):
    made = encode_trajectory(trajectory, gains=AttitudeGains(kw_xy=22000.0))
    check_bytes(made, trajectory, LIMITS)
    with pytest.raises(NotCertifiedError, match="body_rate"):
        check_bytes(replace(made, gains=FIRMWARE_GAINS), trajectory, LIMITS)


def test_rates_that_are_not_traded_are_found(encoded, trajectory):
    """The planned rates and attitudes make the same torque, but carry the vehicle away when setpoints stop."""
    motion = motion_at(trajectory, encoded.times + LEAD)
    payloads = encode(replace(motion, quaternion=command_quaternion(motion.quaternion)))
    with pytest.raises(NotCertifiedError, match="body_rate"):
        check_bytes(replace(encoded, payloads=payloads), trajectory, LIMITS)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("speed", 1.5, "speed"), ("acceleration", 2.0, "acceleration"), ("angular_velocity", 0.5, "angular velocity"),
        ("tilt", np.radians(15), "tilt"), ("specific_thrust_min", 9.8, "specific thrust"),
    ],
)  # fmt: skip
def test_bytes_beyond_a_limit_are_refused(encoded, trajectory, field, value, said):
    with pytest.raises(NotCertifiedError, match=said) as caught:
        check_bytes(encoded, trajectory, replace(LIMITS, **{field: value}))
    assert caught.value.where.startswith("setpoint ")


def test_a_stream_that_does_not_end_in_hover_is_refused(encoded, trajectory):
    cut = replace(encoded, times=encoded.times[:-60], payloads=encoded.payloads[:-60])
    with pytest.raises(NotCertifiedError, match="hover"):
        check_bytes(cut, trajectory, LIMITS)


def test_bytes_of_another_shape_are_refused(encoded, trajectory):
    for payloads in (encoded.payloads[:, :-1], encoded.payloads[:-1], encoded.payloads[:0]):
        with pytest.raises(NotCertifiedError, match="shape"):
            check_bytes(replace(encoded, payloads=payloads), trajectory, LIMITS)


def test_a_path_out_of_the_packets_range_is_refused_with_the_setpoint():
    path = min_snap([[0, 0, 1], [40, 0, 1]])
    ones = np.ones(11)
    profile = SpeedProfile(
        np.linspace(0, path.end, 11), ones, 0 * ones, 0 * ones, 0 * ones[:-1], 0 * ones, 0 * ones, 0 * ones[:-1]
    )
    with pytest.raises(NotCertifiedError, match="position") as caught:
        encode_trajectory(Trajectory(path, profile, AIRFRAME))
    row = int(caught.value.where.split()[1])
    assert motion_at(Trajectory(path, profile, AIRFRAME), np.array([row / 100 + LEAD])).position[0, 0] > 32.767


@pytest.mark.parametrize("hold", [-1.0, np.nan, np.inf])
def test_a_hold_that_makes_no_sense_is_refused(trajectory, hold):
    with pytest.raises(NotCertifiedError, match="hold"):
        encode_trajectory(trajectory, hold=hold)


def test_of_the_packets_alone_people_see_the_motion_that_was_planned(encoded, trajectory):
    sent, planned = encoded.decoded, trajectory.at(encoded.times + LEAD)
    made = Rotation.from_matrix(controller_attitude(sent.acceleration + np.array([0, 0, GRAVITY]), sent.quaternion))
    attitude, acceleration, rate = motion_of_sent(encoded.times, sent.acceleration, made.as_quat(), sent.body_rate)
    later = slice(50, None)  # it takes half a second to forget how it began
    off = (Rotation.from_quat(attitude[later]).inv() * Rotation.from_quat(planned.quaternion[later])).magnitude()
    assert np.degrees(off.max()) < 1.0
    turning = rates_to_send(trajectory, encoded.times + LEAD)
    assert rate[later] == pytest.approx(turning[later], abs=0.12)
    led = motion_at(trajectory, encoded.times + LEAD).acceleration
    assert acceleration[later] == pytest.approx(led[later], abs=0.15)
    assert np.abs(sent.acceleration - led)[later].max() > 0.5
