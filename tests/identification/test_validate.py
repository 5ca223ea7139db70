"""Validation: a prediction that holds on a log of the model's own physics, and logs that must be refused in words."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.identification.measured import measure, pooled, thrust_scale
from cfplan.identification.replay import Controller, find_start, recompute
from cfplan.identification.validate import validate
from tests.identification.logs import CONTROLLER, GAINS, PLAIN, REAL, figure8, logged


@pytest.fixture(scope="module")
def log():
    return logged()


@pytest.fixture(scope="module")
def found(log):
    return validate(log, figure8(), CONTROLLER, PLAIN)


def test_the_prediction_holds_and_each_missing_piece_shows(found):
    assert found.comparison.passes
    assert found.comparison.correlation > 0.99
    assert found.recomputed.explained > 0.99
    assert found.comparison.measured_rms > 0.03
    for piece in ("moment", "drag", "estimator"):
        assert found.ablations[piece].explained < found.comparison.explained - 0.03, piece


def test_the_vehicle_is_measured(found):
    vehicle = found.measured.airframe
    assert vehicle.thrust_scale == pytest.approx(REAL.thrust_scale, rel=0.01)
    assert vehicle.velocity_moment == pytest.approx(REAL.velocity_moment, rel=0.1)
    assert vehicle.inertia[:2] == pytest.approx(REAL.inertia[:2], rel=0.15)
    assert vehicle.motor_time_constant == pytest.approx(REAL.motor_time_constant, abs=0.015)
    assert vehicle.drag[0] == pytest.approx(REAL.drag[0], rel=0.1)
    assert vehicle.lift_with_speed == pytest.approx(REAL.lift_with_speed, abs=0.004)
    assert 0.0 < found.measured.estimate["velocity"] < 0.2
    assert any("roll moment" in text for text in found.measured.unlike)  # PLAIN has none


def test_without_sensors_what_they_show_is_named(found):
    bare = measure(logged(sensors=False), PLAIN)
    assert bare.airframe.drag == PLAIN.drag
    assert any("drag" in reason and "accelerometer" in reason for reason in bare.unknown)
    assert bare.estimate == {}


def test_a_slow_flight_shows_no_moment():
    slow = measure(logged(reference=figure8(period=60.0)), PLAIN)
    assert slow.airframe.velocity_moment == PLAIN.velocity_moment
    assert any("slower" in reason for reason in slow.unknown)


def test_flights_are_pooled_by_their_medians(found):
    other = replace(found.measured, airframe=replace(found.measured.airframe, velocity_moment=(5.0e-4, 6.0e-4)))
    vehicle = pooled([found.measured, other, other], PLAIN)
    assert vehicle.velocity_moment == pytest.approx((5.0e-4, 6.0e-4))
    assert vehicle.mass == PLAIN.mass


@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_start_and_height_are_found(log, offset):
    begun = find_start(log, figure8().moved(-0.7, np.array([0.0, 0.0, -offset])), CONTROLLER, REAL)
    assert begun.time[0] == pytest.approx(0.0, abs=0.004)
    assert begun.rows[0, 2] == pytest.approx(1.0, abs=0.005)


def test_a_time_scale_that_was_not_flown_is_refused(log):
    slower = replace(figure8(), time=1.2 * figure8().time)
    with pytest.raises(InputError, match="of the torque") as refused:
        validate(log, find_start(log, slower, CONTROLLER, REAL), CONTROLLER, PLAIN)
    assert "time scale" in refused.value.hint


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"KR_x": 0.016, "KR_y": 0.016}, "KR"),
        ({"Kw_x": 0.002, "Kw_y": 0.002}, "Kw"),
        ({"Kpos_Px": 14.0, "Kpos_Py": 14.0}, "Kpos_P"),
        ({"mass": 0.045}, "mass"),
    ],
)
def test_a_wrong_gain_is_refused_and_named(log, wrong, named):
    with pytest.raises(InputError, match="explain") as refused:
        validate(log, figure8(), Controller(replace(GAINS, **wrong)), PLAIN)
    assert f"with {named} = " in refused.value.hint
    true = getattr(GAINS, next(iter(wrong)))
    assert float(refused.value.hint.split(" = ")[1].split()[0]) == pytest.approx(true, rel=0.1)


@pytest.mark.parametrize("later", [-0.12, 0.2])
def test_a_shifted_start_is_refused_and_named(log, later):
    with pytest.raises(InputError, match="explain") as refused:
        validate(log, figure8().moved(later, np.zeros(3)), CONTROLLER, PLAIN)
    named = float(refused.value.hint.split("a start ")[1].split()[0])
    assert named == pytest.approx(abs(later), abs=0.003)
    assert ("sooner" if later > 0.0 else "later") in refused.value.hint


def test_a_gap_is_refused_with_its_time(log):
    keep = (log.time < 4.0) | (log.time > 5.5)
    holed = replace(log, time=log.time[keep], state=log.state[keep], control=log.control[keep], acceleration=None)
    with pytest.raises(InputError, match=r"no record for 1\.5\d? s from 3\.99\d? s|no record for 1\.5\d s from 4"):
        validate(holed, figure8(), CONTROLLER, PLAIN)


def test_short_gaps_are_bridged(log):
    keep = np.ones(len(log.time), dtype=bool)
    keep[1000:1012] = keep[1500:1530] = False
    parts = {name: getattr(log, name)[keep] for name in ("time", "state", "control", "acceleration")}
    assert validate(replace(log, **parts), figure8(), CONTROLLER, PLAIN).comparison.passes


def test_a_crash_is_refused_with_its_time_and_the_part_before_is_valid(log):
    state = log.state.copy()
    fallen = log.time > 7.0
    state[fallen, 6:10] = np.sin(0.75), 0.0, 0.0, np.cos(0.75)  # turned by 86° about x
    crashed = replace(log, state=state)
    with pytest.raises(InputError, match=r"crashed.*7\.00") as refused:
        validate(crashed, figure8(), CONTROLLER, PLAIN)
    assert "--to 6.5" in refused.value.hint
    assert validate(crashed.between(0.0, 6.5), figure8(), CONTROLLER, PLAIN).comparison.passes


def test_a_mass_that_cannot_be_is_refused(log):
    with pytest.raises(InputError, match="times the thrust") as refused:
        thrust_scale(log, replace(PLAIN, mass=0.09))
    assert "weigh" in refused.value.hint


def test_another_vehicle_is_named(found):
    heavier = logged(airframe=replace(REAL, mass=0.052, motor_thrust_max=0.25))
    other = measure(heavier, replace(PLAIN, mass=0.052))
    assert any("thrust scale" in text and PLAIN.name in text for text in other.unlike) is (
        abs(other.airframe.thrust_scale - 1.0) > PLAIN.spread.thrust_scale
    )
    as_if_light = measure(heavier, PLAIN)
    assert as_if_light.airframe.thrust_scale < 0.8
    assert any("thrust scale" in text and "outside" in text for text in as_if_light.unlike)


def test_few_records_are_refused(log):
    with pytest.raises(InputError, match="too short"):
        validate(log.between(0.0, 1.0), figure8(), CONTROLLER, PLAIN)
    sparse = log.between(0.0, 9.0)
    keep = np.arange(0, len(sparse.time), 10)
    thin = replace(sparse, time=sparse.time[keep], state=sparse.state[keep], control=sparse.control[keep])
    with pytest.raises(InputError, match="25 records a second"):
        validate(replace(thin, acceleration=None), figure8(), CONTROLLER, PLAIN)


def test_a_log_without_commands_is_refused(log):
    with pytest.raises(InputError, match="no commands"):
        recompute(replace(log, control=np.full_like(log.control, np.nan)), figure8(), CONTROLLER, PLAIN)
