"""The study of other simulators' bodies: the same controller and bytes, and bodies that agree to a centimetre."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from one_body import stepped

from cfplan.errors import InputError
from cfplan.preparation.plan_flight import plan_flight
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.dry_run import fly_motion
from cfplan.simulation.engine.flight import NO_FLOOR
from cfplan.simulation.engine.layout import hovering, pack_airframe
from cfplan.simulation.other_bodies import fly_on, identified_body, rotorpy_body
from cfplan.vehicle.airframes import AIRFRAMES
from studies.physics import BODIES, PAPER_LAG, REALISTIC_LAG, STUDY, OtherBody, Settings, measure
from studies.runner.cases import run_study

SAFETY = Path(__file__).parents[2] / "safety.yaml"
AIRFRAME = AIRFRAMES["crazyflie-2.1+"].simplified()


@pytest.fixture(scope="module")
def path_file(tmp_path_factory):
    """Return a path so short that RotorPy flies it in a second."""
    file = tmp_path_factory.mktemp("physics") / "short.yaml"
    file.write_text("name: short\nwaypoints:\n  - [0, 0, 1]\n  - [0.25, 0.15, 1.1]\n")
    return file


@pytest.fixture(scope="module")
def result(path_file):
    return run_study("physics", "studies.physics", STUDY, Settings((path_file,)))


def own_step(state, asked, seconds):
    return stepped(state, asked, pack_airframe(AIRFRAME, floor=NO_FLOOR), seconds)


def test_with_the_dry_runs_body_it_is_the_dry_runs_flight(path_file):
    limits = load_limits(SAFETY)
    planned = plan_flight(path_file, limits)
    encoded, trajectory = encode_flight(planned), planned.plan.trajectory
    times, positions = fly_on(own_step, encoded, trajectory, AIRFRAME)
    loop = fly_motion(encoded, trajectory, AIRFRAME)
    np.testing.assert_allclose(times, loop.time[::2], atol=1e-9)
    np.testing.assert_array_equal(positions, loop.position[::2])


@pytest.mark.slow
def test_rotorpy_and_the_dry_run_are_a_centimetre_apart_at_most(result):
    flights = [flight for flight in result.rows if flight.body.startswith("RotorPy")]
    assert [flight.motor_lag for flight in flights] == [REALISTIC_LAG, PAPER_LAG]
    for flight in flights:
        assert 0.0 < flight.apart < 0.01
        assert flight.apart_rms <= flight.apart
        assert abs(flight.deviation - flight.own_deviation) <= flight.apart


def test_a_body_that_is_heavier_than_assumed_deviates(path_file):
    def heavy(airframe):
        return rotorpy_body(replace(airframe, mass=1.2 * airframe.mass), REALISTIC_LAG)

    (flight,) = measure(path_file, [OtherBody("heavy", heavy, REALISTIC_LAG)])
    assert flight.apart > 0.02


@pytest.mark.skipif(find_spec("drone_models") is None, reason="drone-models is not installed")
def test_the_identified_model_moves_as_the_airframe_does():
    step, state = identified_body(AIRFRAME), hovering(AIRFRAME, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(step(state, np.full(4, AIRFRAME.hover_thrust), 0.1), state, atol=1e-6)
    rolled = own = state
    for _ in range(50):
        asked = AIRFRAME.hover_thrust + np.array([0.0, 0.0, 0.002, 0.002])
        rolled, own = step(rolled, asked, 0.002), own_step(own, asked, 0.002)
    assert own[6] > 0.003
    np.testing.assert_allclose(rolled[6:10], own[6:10], atol=0.1 * own[6])
    np.testing.assert_allclose(rolled[:6], own[:6], atol=0.1 * np.abs(own[4]))


def test_an_airframe_that_drone_models_does_not_know_is_refused():
    with pytest.raises(InputError, match=r"does not know crazyflie-2\.0"):
        identified_body(AIRFRAMES["crazyflie-2.0"])


def not_there(_):
    raise InputError("RotorPy is not installed")


def test_packages_that_are_not_there_are_named(path_file):
    with pytest.raises(InputError, match="RotorPy is not installed") as raised:
        measure(path_file, [OtherBody("RotorPy", not_there)])
    assert "pip install" in raised.value.hint


def test_a_body_that_is_not_there_is_left_out_and_the_others_fly(path_file):
    rows = measure(path_file, [OtherBody("absent", not_there), OtherBody("RotorPy", BODIES[1].make, REALISTIC_LAG)])
    bodies, left_out = STUDY.tables(Settings((path_file,)), rows)
    (flown,), (absent,) = bodies.rows, left_out.rows
    assert [column.title for column in bodies.columns[2:]] == ["RotorPy", f"cfplan, {REALISTIC_LAG:g} s", "apart"]
    assert flown["apart_0"] == rows[1].apart
    assert (absent["body"], absent["reason"]) == ("absent", "RotorPy is not installed")


def test_the_result_is_one_row_a_path(result):
    (table,) = result.tables
    assert [row["path"] for row in table.rows] == ["short"]
