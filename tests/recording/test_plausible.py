"""Finite and absurd times, places and texts in records and logs: named, or drawn as nothing; never a traceback."""

import contextlib
import json
from dataclasses import replace

import numpy as np
import pytest

from cfplan.cli.output import print_json
from cfplan.errors import InputError
from cfplan.flight.telemetry import Event as Message
from cfplan.flight.telemetry import Level, PoseReceived, SetpointSent
from cfplan.recording.importers.formats import read_log
from cfplan.recording.overlay import Trial, trial_of_record
from cfplan.recording.plausible import check_times
from cfplan.recording.reader import read_record
from cfplan.recording.report.charts import Curve, time_chart
from cfplan.recording.report.report import read_flight
from cfplan.recording.rerun.overlay_view import dashes, write_overlay
from cfplan.recording.rerun.record_view import floor_lines, write_rrd
from cfplan.recording.summary import summary_text
from cfplan.recording.writer import RecordWriter
from tests.recording.conftest import header

LEVEL = (0.0, 0.0, 0.0, 1.0)


def record_of(folder, *messages, **changed):
    with RecordWriter(folder, replace(header(), **changed)) as writer:
        for message in messages:
            writer.write(message)
    return folder


def pose(time, place=(0.0, 0.0, 1.0)):
    return PoseReceived(time, time, place, LEVEL)


@pytest.mark.parametrize("times", [(1.0, 1e9), (1.0, 50_000.0), (-1e8, 1.0)])
def test_a_record_with_absurd_times_is_refused(tmp_path, times):
    with pytest.raises(InputError, match="time") as error:
        read_record(record_of(tmp_path, *map(pose, times)))
    assert error.value.where.endswith("flight.mcap")
    assert error.value.hint


@pytest.mark.parametrize("times", [(1.0, 1e300), (np.nan, 1.0), (1.0, np.inf), (-1e200, 1.0), (1e12, 1e12 + 1)])
def test_times_that_are_no_times_are_named(times):
    with pytest.raises(InputError, match="of 'swift' is"):
        check_times(np.array(times), "'swift'", where="log.csv")


def test_a_setpoint_without_a_deadline_is_refused(tmp_path):
    late = SetpointSent(1.0, np.nan, 0, (0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3, LEVEL, (0.0,) * 3)
    with pytest.raises(InputError, match="deadlines is nan"):
        read_record(record_of(tmp_path, late))


def test_a_pose_without_a_plausible_arrival_is_refused(tmp_path):
    with pytest.raises(InputError, match="of the record span"):
        read_record(record_of(tmp_path, PoseReceived(1.0, 1e10, (0.0, 0.0, 1.0), LEVEL)))


@pytest.mark.parametrize("place", [(1e30, 0.0, 0.0), (0.0, -2e4, 0.0)])
def test_a_record_with_absurd_places_is_refused(tmp_path, place):
    with pytest.raises(InputError, match="position 2 of"):
        read_record(record_of(tmp_path, pose(1.0), pose(2.0, place)))


@pytest.mark.parametrize("corner", [(1e300, 0.0, 0.0), (np.nan, 0.0, 0.0)])
def test_a_record_with_an_absurd_fence_is_refused(tmp_path, corner):
    with pytest.raises(InputError, match="the header"):
        read_record(record_of(tmp_path, pose(1.0), fence=((-1.0, -1.0, 0.0), corner)))


@pytest.mark.parametrize("zero", [np.nan, np.inf, 1e300, -1e15])
def test_a_record_whose_date_is_not_known_has_a_dash(tmp_path, zero):
    folder = record_of(tmp_path, pose(1.0), pose(2.0), wall_time_at_zero=zero)
    record = read_record(folder)
    assert "\n– · " in summary_text(record)
    assert dict(read_flight(folder).provenance)["begun"] == "–"
    write_rrd(record, tmp_path / "view.rrd")


def test_half_a_surrogate_pair_in_a_record_becomes_a_question_mark(tmp_path):
    folder = record_of(tmp_path, pose(1.0), Message(1.0, Level.INFO, "fine"), name="half \ud800")
    (folder / "summary.json").write_text(json.dumps({"outcome": {"reason": "\udcff"}}))
    record = read_record(folder)
    assert record.header.name == "half ?"
    assert record.summary["outcome"]["reason"] == "?"


def test_half_a_surrogate_pair_is_printed_as_json_escapes_it(capsys):
    print_json({"name": "half \ud800, °"})
    printed = capsys.readouterr().out
    assert printed.isascii()  # for any terminal
    assert json.loads(printed) == {"name": "half \ud800, °"}


def crazyswarm(file, rows):
    file.write_text("timestamp,x,y,z,qw,qx,qy,qz\n" + "".join(",".join(map(str, row)) + "\n" for row in rows))
    return file


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(0, 0, 0, 1, 1, 0, 0, 0), (1e6, 0, 0, 1, 1, 0, 0, 0)], "span 1e"),
        ([(0, 0, 0, 1, 1, 0, 0, 0), (1e300, 0, 0, 1, 1, 0, 0, 0)], "time 2 of|times of"),
        ([(0, 0, 0, 1, 1, 0, 0, 0), (1, 1e9, 0, 1, 1, 0, 0, 0)], "position 2 of"),
    ],
)
def test_a_log_with_absurd_numbers_is_refused(tmp_path, rows, message):
    with pytest.raises(InputError, match=message) as error:
        read_log(crazyswarm(tmp_path / "cf1.csv", rows))
    assert error.value.hint


@pytest.mark.parametrize("cell", ["1_000", "infinity", '"1', "0,1", "1e999", "１"])
@pytest.mark.parametrize("ending", ["\n", "\n0.03,0", "\n0.03,0,0,1,1,0,0,0"])
def test_a_cell_that_only_one_reader_takes_for_a_number_is_no_traceback(tmp_path, cell, ending):
    file = crazyswarm(tmp_path / "cf1.csv", [(0, 0, 0, 1, 1, 0, 0, 0), (0.01, 0, cell, 1, 1, 0, 0, 0)])
    file.write_text(file.read_text().rstrip("\n") + ending)
    with contextlib.suppress(InputError):
        read_log(file)


def test_what_is_drawn_is_bounded(tmp_path):
    assert len(dashes(np.array([[0.0, 0.0, 0.0], [1e12, 0.0, 0.0]]))) <= 20_001
    assert len(floor_lines(np.array([-1e9, -1.0, 0.0]), np.array([1e30, 1.0, 1.0]))) <= 500
    time = np.arange(5) * 1e-300
    trial = Trial("swift", time, np.zeros((5, 3)), np.tile(LEVEL, (5, 1)), None)
    assert len(trial.speed) == 5
    write_overlay([trial], tmp_path / "view.rrd")


def test_a_record_of_one_pose_is_a_trial(tmp_path):
    assert len(trial_of_record(read_record(record_of(tmp_path, pose(1.0))), "one").time) == 1


@pytest.mark.parametrize("quaternion", [(1e300, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, -1e12)])
def test_a_record_with_a_number_that_nothing_measures_is_refused(tmp_path, quaternion):
    with pytest.raises(InputError, match="number 2 of /pose quaternion is") as error:
        read_record(record_of(tmp_path, pose(1.0), PoseReceived(1.01, 1.01, (0.0, 0.0, 1.0), quaternion)))
    assert error.value.hint


@pytest.mark.parametrize("figure", ["travel_time", "thrust_at_full_command"])
def test_a_header_with_a_number_that_nothing_measures_is_refused(tmp_path, figure):
    with pytest.raises(InputError, match="of the header is 1e\\+300"):
        read_record(record_of(tmp_path, pose(1.0), **{figure: 1e300}))


def test_values_that_cannot_be_told_apart_make_a_chart():
    time = np.array([0.0, 1.0])
    assert "<svg" in time_chart("speed", [Curve("flown", time, np.array([0.0, 5e-324]), (0, 0, 0))])
