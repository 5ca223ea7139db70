"""`cfplan validate`: microSD logs and records, what it writes and prints, and what it refuses."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from cfplan.cli import cfplan
from cfplan.cli.validate import check_same_vehicle
from cfplan.errors import CfplanError, ExitCode
from cfplan.identification.airframe_yaml import write_airframe
from cfplan.identification.flight_log import read_microsd
from cfplan.identification.logged_flight import flight_of_record
from cfplan.identification.validate import validate
from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.vehicle.airframe_file import read_airframe
from cfplan.vehicle.airframes import AIRFRAMES
from studies.identification import DrawnVehicle, fly_drawn
from tests.identification.conftest import REPOSITORY
from tests.identification.logs import GAINS, PLAIN, REAL, figure8, logged
from tests.recording.importers.test_import_logs import FLIGHTS, usd

SCALED = ("x", "y", "z", "vx", "vy", "vz")


def run(*words):
    return CliRunner().invoke(cfplan, ["validate", *map(str, words)])


def refused(*words):
    result = run(*words)
    assert isinstance(result.exception, CfplanError), result.output
    return result.exception


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A microSD log of a simulated flight, its gains, and the airframe of its kind."""
    place, log = tmp_path_factory.mktemp("validate"), logged()
    roll_pitch_yaw = log.attitude.as_euler("ZYX")[:, ::-1]
    names = [f"{group}.{name}(h)" for group in ("stateEstimateZ", "ctrltargetZ") for name in SCALED]
    names += [f"ctrlLee.{name}(f)" for name in ("rpyx", "rpyy", "rpyz", "omegax", "omegay", "omegaz")]
    names += [f"ctrlLee.{name}(f)" for name in ("thrustSI", "torquex", "torquey", "torquez")]
    staircase = figure8().at(np.floor(log.time / 0.01) * 0.01 + 0.005)[:, :6]
    whole = np.round(1000 * np.hstack([log.state[:, :6], staircase])).astype(int)
    rest = np.hstack([roll_pitch_yaw, log.state[:, 10:13], log.control])
    rows = [(*map(int, scaled), *others) for scaled, others in zip(whole, rest, strict=True)]
    (place / "log00").write_bytes(usd(names, rows, times=log.time))
    values = {**asdict(GAINS), "experiment": 12, "motors": "standard"}
    (place / "gains.yaml").write_text("".join(f"{name}: {value}\n" for name, value in values.items()))
    write_airframe(replace(PLAIN, name="plain"), place / "plain.yaml")
    return place


def test_a_microsd_log_is_predicted_and_its_vehicle_written(folder, tmp_path):
    file, page = tmp_path / "found.yaml", tmp_path / "page.html"
    result = run(
        folder / "log00", "--gains", folder / "gains.yaml", "--vehicle", folder / "plain.yaml", "-o", file,
        "--report", page,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    for text in (
        "logged setpoints",
        "holds",
        "without moment",
        "thrust scale",
        "roll moment",
        "accelerometer",
        "unlike",
    ):
        assert text in result.output
    found = read_airframe(file)
    assert found.thrust_scale == pytest.approx(REAL.thrust_scale, rel=0.01)
    assert found.velocity_moment == pytest.approx(REAL.velocity_moment, rel=0.25)  # the estimated velocity is too high
    text = page.read_text()
    assert "measured" in text
    assert "predicted" in text
    assert text.count("<svg") == 3


def test_the_yaw_that_was_asked_for_is_found_whatever_the_tilt(tmp_path):
    chance, count, yaw = np.random.default_rng(2), 40, 0.7
    up = np.column_stack([chance.normal(0.0, 0.3, (count, 2)), np.ones(count)])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    left = np.cross(up, [np.cos(yaw), np.sin(yaw), 0.0])
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    desired = Rotation.from_matrix(np.stack([np.cross(left, up), left, up], axis=-1)).as_euler("ZYX")
    names = [f"stateEstimateZ.{name}(h)" for name in SCALED]
    names += [f"ctrlLee.{name}(f)" for name in ("rpyx", "rpyy", "rpyz", "omegax", "omegay", "omegaz")]
    names += [f"ctrlLee.{name}(f)" for name in ("rpydz", "rpydy", "rpydx")]
    rows = [(0, 0, 1000, 0, 0, 0, *np.zeros(6), *angles) for angles in desired]
    (tmp_path / "log").write_bytes(usd(names, rows, times=np.arange(count) / 250))
    assert read_microsd(tmp_path / "log").setpoint_yaw == pytest.approx(np.full(count, yaw), abs=1e-5)


def test_one_document_is_printed_where_json_is_asked_for(folder, tmp_path):
    result = run(
        folder / "log00", "--gains", folder / "gains.yaml", "--vehicle", folder / "plain.yaml", "--json",
        "-o", tmp_path / "found.yaml", "--to", "8",
    )  # fmt: skip
    (flight,) = json.loads(result.output)["flights"]
    assert flight["holds"]
    assert flight["comparison"]["correlation"] > 0.95
    assert flight["commands"]["torque"] > 0.95


def test_a_prediction_that_does_not_hold_is_no_success(folder, tmp_path):
    without_drag = replace(PLAIN, name="slippery", drag=(0.0, 0.0))
    write_airframe(without_drag, tmp_path / "slippery.yaml")
    result = run(
        folder / "log00", "--gains", folder / "gains.yaml", "--vehicle", tmp_path / "slippery.yaml",
        "-o", tmp_path / "found.yaml",
    )  # fmt: skip
    assert result.exit_code == ExitCode.NOT_CERTIFIED
    assert "does not hold" in result.output


def test_a_wrong_gain_is_named_on_the_command_line(folder, tmp_path):
    text = (folder / "gains.yaml").read_text().replace("Kw_x: 0.00115", "Kw_x: 0.002")
    (tmp_path / "gains.yaml").write_text(text.replace("Kw_y: 0.00115", "Kw_y: 0.002"))
    error = refused(folder / "log00", "--gains", tmp_path / "gains.yaml", "-o", tmp_path / "found.yaml")
    assert "Kw = 0.001" in error.hint


@pytest.mark.parametrize(
    ("words", "what", "hint"),
    [
        (["log00"], "gains are not known", "--gains"),
        (["gains.yaml", "--gains", "gains.yaml"], "unknown format", "microSD"),
        (["log00", "--gains", "plain.yaml"], "names no gains", "KR_x"),
        (["log00", "--gains", "gains.yaml", "--from", "50"], "nothing between", "lasts"),
        (["log00", "--gains", "gains.yaml", "--to", "1"], "too short", "needed"),
        (["log00", "--gains", "gains.yaml", "--mass", "0.2"], "times the thrust", "weigh"),
        (["absent", "--gains", "gains.yaml"], "no such file", "name"),
    ],
)
def test_what_cannot_be_validated_is_refused_in_words(words, what, hint, folder, tmp_path, monkeypatch):
    monkeypatch.chdir(folder)
    error = refused(*words, "-o", tmp_path / "found.yaml")
    assert what in error.what
    assert hint in error.hint


def test_an_airframe_is_not_overwritten(folder, tmp_path):
    (tmp_path / "found.yaml").write_text("mine")
    error = refused(folder / "log00", "--gains", folder / "gains.yaml", "-o", tmp_path / "found.yaml")
    assert "--force" in error.hint


def test_a_public_log_is_predicted_though_its_notes_name_another_time_scale(tmp_path):
    logs = FLIGHTS / "original_logs"
    if not logs.is_dir():
        pytest.skip("the public flights, ../shared/data/flights, are not here")
    words = [
        logs / "log76", "--gains", logs / "info76.yaml", "--vehicle", "crazyflie-thrust-upgrade", "--mass", "0.0375",
        "-o", tmp_path / "found.yaml",
    ]  # fmt: skip
    assert run(*words, "--from", "0.35").exit_code == 0  # behind a gap of 0.32 s
    trajectory = FLIGHTS / "trajectories" / "translation_y.csv"
    noted = [*words, "--from", "0.35", "--force", "--polynomials", trajectory, "--time-scale"]
    assert "time scale" in refused(*noted, "0.75").hint
    assert run(*noted, "0.5").exit_code == 0


@pytest.mark.slow
def test_the_record_of_a_vehicle_as_real_ones_are_is_predicted(limits, tmp_path):
    true = replace(AIRFRAMES["crazyflie-2.1+"], velocity_moment=(4.4e-4, 6.2e-4), thrust_scale=1.06)
    true = replace(true, lift_with_speed=0.008)
    mission = prepare_mission(REPOSITORY / "flights" / "figure8.yaml", limits)
    record, _ = fly_drawn(DrawnVehicle(3, true, 0.01), mission, tmp_path / "record", 3)
    flight = flight_of_record(record)
    as_planned = validate(flight.log, flight.reference, flight.controller, limits.airframe, flight.poses)
    as_it_is = validate(flight.log, flight.reference, flight.controller, true, flight.poses)
    assert as_it_is.comparison.passes
    assert as_it_is.recomputed.thrust > 0.95
    assert as_it_is.comparison.explained > as_planned.comparison.explained + 0.3
    assert as_it_is.ablations["moment"].explained < as_it_is.comparison.explained - 0.3
    assert any("torque" in reason for reason in as_it_is.measured.unknown)


def test_flights_of_two_vehicles_are_not_pooled(folder, tmp_path):
    for name, mass in (("a", 0.03), ("b", 0.04)):
        write_airframe(replace(PLAIN, name=name, mass=mass), tmp_path / f"{name}.yaml")
    vehicles = [read_airframe(tmp_path / f"{name}.yaml") for name in "ab"]
    with pytest.raises(CfplanError, match=r"b of 40.0 g flew, in the first log a of 30.0 g"):
        check_same_vehicle(vehicles, folder / "log00")


@pytest.mark.parametrize("words", [("--from", "-5"), ("--to", "nan"), ("--offset", "nan", "0", "0")])
def test_times_and_places_are_finite_numbers(folder, tmp_path, words):
    result = run(folder / "log00", "--gains", folder / "gains.yaml", *words, "-o", tmp_path / "found.yaml")
    assert result.exit_code == 2
    assert words[0] in result.output


def test_a_part_that_ends_before_it_begins_is_refused(folder, tmp_path):
    error = refused(
        folder / "log00", "--gains", folder / "gains.yaml", "--from", 3, "--to", 2, "-o", tmp_path / "found.yaml"
    )
    assert error.where == "--to"


def test_airframe_and_page_are_two_files(folder, tmp_path):
    file = tmp_path / "found.yaml"
    error = refused(folder / "log00", "--gains", folder / "gains.yaml", "-o", file, "--report", file)
    assert error.where == str(file)
    assert not file.exists()
