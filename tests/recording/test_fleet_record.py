"""The record of a fleet: one common clock, the distance of each pair, one replay, one report; and what is missing."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
from click.testing import CliRunner

from cfplan.cli import cfplan
from cfplan.errors import InputError
from cfplan.flight.telemetry import Phase, PoseReceived
from cfplan.recording.fleet_record import distances_to_others, is_fleet_record, read_fleet_record, write_fleet_file
from cfplan.recording.record import FLIGHT_FILE
from cfplan.recording.rerun.fleet_view import write_fleet
from cfplan.recording.writer import RecordWriter, write_summary

ASIDE = np.array([1.0, 0.0, 0.3])  # m, of the second vehicle from the first
LATER = 1.5  # s, delay of the second vehicle's start
APART = 0.3  # m
TRAVEL = 10.0  # s, of the made-up flight along its path


def moved(message):
    """A message of the second vehicle."""
    changes = {"time": message.time + LATER}
    for name in ("received", "due"):
        if hasattr(message, name):
            changes[name] = getattr(message, name) + LATER
    if hasattr(message, "position"):
        changes["position"] = tuple(np.add(message.position, ASIDE).tolist())
    return dataclasses.replace(message, **changes)


def write_record(folder, header, messages):
    folder.mkdir()
    with RecordWriter(folder, header) as writer:
        for message in messages:
            writer.write(message)
    return folder


def begin(flight):
    """When the path of the made-up flight begins, s on its clock."""
    return flight.record.phase_span(Phase.STREAM)[0]


@pytest.fixture(scope="module")
def flown(flight, tmp_path_factory):
    """The folder of a flight of two vehicles, one of which is unseen for 0.5 s."""
    folder = tmp_path_factory.mktemp("records") / "20240101-120000-two"
    folder.mkdir()
    hidden = begin(flight) + 6.0
    seen = [
        each for each in flight.messages if not (isinstance(each, PoseReceived) and 0.0 <= each.time - hidden < 0.5)
    ]
    places = {
        "left <b>": write_record(folder / "20240101-120000-left", flight.header, seen),
        "right": write_record(folder / "20240101-120000-right", flight.header, list(map(moved, flight.messages))),
    }
    write_fleet_file(folder, "two", APART, places)
    return folder


@pytest.fixture
def copied(flown, tmp_path):
    return shutil.copytree(flown, tmp_path / "two")


def run(*words):
    return CliRunner().invoke(cfplan, [str(word) for word in words])


def position_of(flight, time):
    """Where the made-up flight was, s from the begin of its path, (N, 3) m."""
    poses = flight.record.poses
    return np.stack([np.interp(time + begin(flight), poses.time, axis) for axis in poses.position.T], axis=1)


def expected_distance(flight, time):
    return np.linalg.norm((position_of(flight, time - LATER) + ASIDE - position_of(flight, time))[:, :2], axis=1)


def test_distances_are_those_of_one_common_clock(flight, flown):
    fleet = read_fleet_record(flown)
    assert fleet.start == pytest.approx(begin(flight), abs=0.02)
    (pair,) = fleet.pairs()
    assert pair.pair == ("left <b>", "right")
    along = (pair.time > 0.0) & (pair.time < TRAVEL)
    off = pair.distance[along] - expected_distance(flight, pair.time[along])
    assert np.nanmax(np.abs(off)) < 0.01
    time = np.arange(0.0, TRAVEL, 0.001)
    row = pair.nearest
    assert pair.distance[row] == pytest.approx(expected_distance(flight, time).min(), abs=0.01)
    assert pair.time[row] == pytest.approx(time[np.argmin(expected_distance(flight, time))], abs=0.3)
    one, other = position_of(flight, pair.time[[row]]), position_of(flight, pair.time[[row]] - LATER) + ASIDE
    assert pair.place[row] == pytest.approx((0.5 * (one + other))[0, :2], abs=0.01)


def test_no_distance_is_invented_where_one_was_not_seen(flown):
    _, right = (fleet := read_fleet_record(flown)).trials
    _, of_right = distances_to_others(fleet.trials)
    hidden = (right.time > 6.02) & (right.time < 6.46)
    assert np.isnan(of_right[hidden]).all()
    assert np.isfinite(of_right[(right.time > 7.0) & (right.time < TRAVEL)]).all()


def test_deviations_of_a_vehicle_do_not_depend_on_the_common_clock(flown):
    left, right = read_fleet_record(flown).trials
    assert np.nanmax(right.deviation) == pytest.approx(np.nanmax(left.deviation), abs=0.01)
    assert right.reference.time[0] == pytest.approx(LATER, abs=0.02)


def test_a_report_is_about_all_vehicles_and_their_pairs(flown, tmp_path):
    page = tmp_path / "report.html"
    ended = run("report", flown, "-o", page)
    assert ended.exit_code == 0, ended.output
    text = page.read_text()
    for words in ("Together", "Distance of columns, m", "left &lt;b&gt; – right", "Deviation in time", "0.300 m"):
        assert words in text
    assert "left <b>" not in text
    (pair,) = read_fleet_record(flown).pairs()
    assert f"{pair.distance[pair.nearest]:.3f} m" in text


def test_a_report_in_numbers_has_the_pairs(flight, flown):
    document = json.loads(run("report", flown, "--json").output)
    assert [flight["name"] for flight in document["flights"]] == ["left <b>", "right"]
    (pair,) = document["pairs"]
    assert pair["distance"] == pytest.approx(expected_distance(flight, np.arange(0.0, TRAVEL, 0.001)).min(), abs=0.01)
    assert document["missing"] == []


def test_a_replay_holds_all_vehicles(flown, tmp_path):
    file = tmp_path / "fleet.rrd"
    ended = run("replay", flown, "--save", file)
    assert ended.exit_code == 0, ended.output
    content = file.read_bytes()
    for entity in (
        b"trial/0/body",
        b"trial/1/body",
        b"plots/distance/vehicle_1",
        b"plots/distance/apart",
        b"phase/right",
    ):
        assert entity in content
    assert "--force" in run("replay", flown, "--save", file).exception.hint


def test_a_list_of_flights_has_the_flight_of_a_fleet_in_one_row(copied):
    reasons = {"left": "landed", "right": "the battery is low"}
    for folder in copied.glob("*-*"):
        name = folder.name.rpartition("-")[2]
        summary = {"outcome": {"reason": reasons[name]}, "max_deviation": 0.04 if name == "left" else 0.07}
        write_summary(folder, summary)
    listed = run("replay", copied.parent)
    assert listed.exit_code == 0
    row = " ".join(next(line for line in listed.output.splitlines() if line.startswith("two")).split())
    for text in ("2 vehicles", *reasons.values(), "7.0 cm"):
        assert text in row
    (document,) = json.loads(run("replay", copied.parent, "--json").output)["records"]
    assert {each["outcome"]["reason"] for each in document["vehicles"]} == set(reasons.values())


def test_a_figure_is_of_one_vehicle(flown, tmp_path):
    assert "one record" in run("replay", flown, "--figure", tmp_path / "a.svg").exception.what


def test_a_missing_record_is_named_and_the_others_are_shown(copied):
    shutil.rmtree(copied / "20240101-120000-left")
    fleet = read_fleet_record(copied)
    assert list(fleet.records) == ["right"]
    assert "left <b>" in fleet.notes[0]
    assert "missing" in fleet.notes[0]
    assert not fleet.pairs()
    assert "left &lt;b&gt; is missing" in (run("report", copied), (copied / "report.html").read_text())[1]
    write_fleet(fleet, copied / "fleet.rrd")


def test_a_truncated_record_is_named(copied):
    file = copied / "20240101-120000-right" / FLIGHT_FILE
    file.write_bytes(file.read_bytes()[:-20_000])
    ended = run("report", copied)
    assert ended.exit_code == 0, ended.output
    assert "right ends early" in (copied / "report.html").read_text()
    assert "right ends early" in ended.output


def test_a_folder_without_any_record_is_refused(copied):
    for place in list(copied.glob("2024*")):
        shutil.rmtree(place)
    with pytest.raises(InputError, match="no record of the fleet") as caught:
        read_fleet_record(copied)
    assert caught.value.hint


@pytest.mark.parametrize("text", [
    "", "[]", "{}", '{"name": "two", "apart": "wide", "vehicles": {}}', '{"name": 1, "apart": 0, "vehicles": {}}',
    '{"name": "two", "apart": 0.3, "vehicles": {}}', '{"name": "two", "apart": 0.3, "vehicles": {"a": ".."}}',
])  # fmt: skip
def test_a_damaged_fleet_file_is_refused(copied, text):
    (copied / "fleet.json").write_text(text)
    assert is_fleet_record(copied)
    with pytest.raises(InputError) as caught:
        read_fleet_record(copied)
    assert str(copied) in caught.value.where
    assert caught.value.hint
