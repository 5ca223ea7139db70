"""Identification finds the truth of a flight through packets, filter and noise, and says what it cannot tell."""

from dataclasses import replace

import numpy as np
import pytest
from one_body import stepped

from cfplan.errors import InputError
from cfplan.flight.setpoints.encoding import LEAD
from cfplan.identification.advice import deviation_per_speed, suggests_identification
from cfplan.identification.airframe_yaml import airframe_text, safety_lines, write_airframe
from cfplan.identification.identify import identify
from cfplan.recording.record import Record
from cfplan.simulation.engine.body import TIME_STEP
from cfplan.simulation.engine.layout import hovering, pack_airframe
from cfplan.vehicle.airframe_file import read_airframe
from cfplan.vehicle.airframes import AIRFRAMES


@pytest.fixture(scope="module")
def found(record, drawn):
    return identify([record], mass=drawn.airframe.mass)


def rows(stream, keep):
    """A stream of a record with some of its messages."""
    return type(stream)(**{name: getattr(stream, name)[keep] for name in stream.__slots__})


def cut(record: Record, seconds: float) -> Record:
    """The record of a flight that was cut off so long after the vehicle was on its way to the start."""
    phases = list(record.phases.phase)
    end = record.phases.time[phases.index("go to start")] + seconds
    streams = {
        name: rows(getattr(record, name), getattr(record, name).time < end)
        for name in ("setpoints", "poses", "estimates", "status", "phases", "events")
    }
    return replace(record, truncated=True, **streams)


def test_the_truth_of_a_drawn_vehicle_is_found(found, drawn):
    true, quantities = drawn.airframe, found.quantities
    assert found.airframe.thrust_scale == pytest.approx(true.thrust_scale, rel=0.012)
    assert found.airframe.motor_time_constant == pytest.approx(true.motor_time_constant, abs=0.006)
    assert found.airframe.drag[0] == pytest.approx(true.drag[0], rel=0.08)
    assert found.airframe.drag[1] == pytest.approx(true.drag[1], rel=0.25)
    assert found.pose_latency == pytest.approx(drawn.latency, abs=0.003)
    assert quantities["link latency"].value == pytest.approx(0.002, abs=0.003)  # two transmissions of a millisecond
    for name in ("mounting roll", "mounting pitch", "mounting yaw"):
        assert abs(quantities[name].value) < np.radians(1.5)
    for name in ("origin x", "origin y", "origin z", "centre of mass x", "centre of mass y"):
        assert abs(quantities[name].value) < 0.004


def test_stated_uncertainties_cover_the_errors(found, drawn):
    true = drawn.airframe
    truths = {
        "thrust scale": true.thrust_scale,
        "motor lag": true.motor_time_constant,
        "drag": true.drag[0],
        "axial drag": true.drag[1],
        "pose latency": drawn.latency,
    }
    for name, truth in truths.items():
        quantity = found.quantities[name]
        assert abs(quantity.value - truth) < 4 * quantity.deviation, name


def test_without_a_weighed_mass_the_ratio_is_found_and_the_mass_held(record, drawn, limits):
    found = identify([record])
    true, before = drawn.airframe, limits.airframe
    assert found.airframe.mass == before.mass
    assert "weigh the vehicle" in found.quantities["mass"].unobservable_reason
    ratio = found.airframe.thrust_scale / found.airframe.mass
    assert ratio == pytest.approx(true.thrust_scale / true.mass, rel=0.012)
    assert found.airframe.drag[0] / before.mass == pytest.approx(true.drag[0] / true.mass, rel=0.08)


def test_motion_is_the_same_if_mass_thrust_drag_and_inertia_all_grow():
    """Why no record can tell the mass: Newton's and Euler's equations are homogeneous in them, moments too."""
    airframe, factor = AIRFRAMES["crazyflie-2.1+"], 1.3
    scaled = replace(
        airframe,
        velocity_moment=tuple(factor * value for value in airframe.velocity_moment),
        mass=factor * airframe.mass,
        inertia=tuple(factor * value for value in airframe.inertia),
        motor_thrust_max=factor * airframe.motor_thrust_max,
        drag=tuple(factor * value for value in airframe.drag),
    )
    states = [hovering(each, np.zeros(3)) for each in (airframe, scaled)]
    chance = np.random.default_rng(1)
    for _ in range(300):
        shares = 0.5 + 0.2 * chance.normal(size=4)
        states = [
            stepped(state, shares * each.motor_thrust_max, pack_airframe(each, floor=-np.inf), TIME_STEP)
            for state, each in zip(states, (airframe, scaled), strict=True)
        ]
    assert np.linalg.norm(states[0][:3]) > 0.01
    np.testing.assert_allclose(states[0][:13], states[1][:13], atol=1e-9)


@pytest.mark.slow
def test_several_records_are_surer_than_one(record, drawn, found):
    both = identify([record, record], mass=drawn.airframe.mass)
    assert both.quantities["drag"].deviation < found.quantities["drag"].deviation
    assert both.airframe.drag[0] == pytest.approx(found.airframe.drag[0], rel=0.02)


def test_a_record_that_ends_early_says_less(record, drawn, found):
    less = identify([cut(record, 12.0)], mass=drawn.airframe.mass)
    assert less.quantities["drag"].deviation > found.quantities["drag"].deviation
    assert less.airframe.thrust_scale == pytest.approx(drawn.airframe.thrust_scale, rel=0.02)


def test_a_record_without_a_flight_is_refused(record):
    grounded = replace(record, phases=rows(record.phases, record.phases.phase == "connect"))
    with pytest.raises(InputError, match="no flight in it") as refused:
        identify([grounded])
    assert refused.value.hint


def test_a_short_flight_is_refused(record):
    with pytest.raises(InputError, match="too short"):
        identify([cut(record, 3.0)])


def test_a_record_without_poses_is_refused(record):
    with pytest.raises(InputError, match="poses"):
        identify([replace(record, poses=rows(record.poses, record.poses.time < 0))])


def test_records_of_two_vehicles_are_refused(record):
    other = replace(record, header=replace(record.header, vehicle=AIRFRAMES["crazyflie-2.1-brushless"]))
    with pytest.raises(InputError, match="brushless"):
        identify([record, other])


def test_messages_that_are_broken_or_come_twice_change_nothing(record, drawn, found):
    poses = record.poses
    broken = poses.quaternion.copy(), poses.position.copy()
    broken[0][500], broken[1][600] = 0.0, np.nan
    order = np.r_[0:300, 250:300, 299:200:-1, 300 : len(poses.time)]
    changed = rows(replace(poses, quaternion=broken[0], position=broken[1]), order)
    again = identify([replace(record, poses=changed)], mass=drawn.airframe.mass)
    assert again.airframe.thrust_scale == pytest.approx(found.airframe.thrust_scale, rel=0.002)
    assert again.airframe.drag[0] == pytest.approx(found.airframe.drag[0], rel=0.03)


def test_poses_of_another_body_are_refused(record):
    chance = np.random.default_rng(5)
    still = np.array([1.0, 0.0, 0.0]) + chance.normal(0.0, 0.001, record.poses.position.shape)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(still), 1))
    with pytest.raises(InputError, match="do not turn as"):
        identify([replace(record, poses=replace(record.poses, position=still, quaternion=level))])


@pytest.mark.parametrize("mass", [0.0, -1.0, float("nan"), float("inf"), 33.1])
def test_an_absurd_mass_is_refused(record, mass):
    with pytest.raises(InputError, match="mass"):
        identify([record], mass=mass)


def test_the_airframe_file_is_read_back_as_written(found, tmp_path):
    file = tmp_path / "cf.yaml"
    write_airframe(found.airframe, file)
    again = read_airframe(file)
    assert again.name == found.airframe.name
    assert again.source == found.airframe.source
    assert again.drag == pytest.approx(found.airframe.drag, rel=1e-6)
    assert again.inertia == pytest.approx(found.airframe.inertia, rel=1e-6)
    assert again.thrust_scale == pytest.approx(found.airframe.thrust_scale, rel=1e-6)
    assert again.velocity_moment == pytest.approx(found.airframe.velocity_moment, rel=1e-6)
    assert f"latency: {found.pose_latency:.4f}" in safety_lines(found, file)
    assert "latency" not in safety_lines(replace(found, poses_misdated=False), file)


def test_tiny_numbers_of_an_airframe_are_numbers_in_yaml(tmp_path):
    file = tmp_path / "tiny.yaml"
    file.write_text(airframe_text(replace(AIRFRAMES["crazyflie-2.1+"], inertia=(1e-5, 1e-5, 2e-5))))
    assert read_airframe(file).inertia == (1e-5, 1e-5, 2e-5)


def test_a_file_is_overwritten_only_by_force(found, tmp_path):
    file = tmp_path / "cf.yaml"
    file.write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        write_airframe(found.airframe, file)
    assert file.read_text() == "mine"
    write_airframe(found.airframe, file, overwrite=True)
    assert list(tmp_path.iterdir()) == [file]


def test_deviation_that_grows_with_speed_suggests_identification(record):
    poses, planned = record.poses, record.setpoints.due + LEAD
    wanted = np.column_stack([np.interp(poses.time, planned, p) for p in record.setpoints.position.T])
    moving = np.column_stack([np.interp(poses.time, planned, v) for v in record.setpoints.velocity.T])
    noise = np.random.default_rng(2).normal(0.0, 0.01, wanted.shape)
    on_time = replace(record, poses=replace(poses, position=wanted + noise))
    late = replace(record, poses=replace(poses, position=wanted + noise - 0.03 * moving))
    assert deviation_per_speed(on_time) == pytest.approx(0.0, abs=0.001)
    assert deviation_per_speed(late) == pytest.approx(-0.03, abs=0.001)
    assert not suggests_identification(on_time)
    assert suggests_identification(late)
    aside = replace(record, poses=replace(poses, position=wanted + np.array([0.05, -0.05, 0.05])))
    assert not suggests_identification(aside)  # off, but not more with speed
    assert not suggests_identification(replace(record, poses=rows(poses, poses.time < 0)))
