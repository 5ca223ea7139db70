"""`cfplan identify`: what it writes and prints, and what it refuses."""

import json

import pytest
from click.testing import CliRunner

from cfplan.cli import cfplan
from cfplan.errors import CfplanError
from cfplan.safety.limits_file import load_limits
from tests.identification.conftest import REPOSITORY


def refused(*words):
    result = CliRunner().invoke(cfplan, ["identify", *map(str, words)])
    assert isinstance(result.exception, CfplanError)
    return result.exception


def test_a_record_becomes_an_airframe_that_safety_yaml_can_name(record, drawn, tmp_path):
    file = tmp_path / "cf.yaml"
    mass = f"{drawn.airframe.mass:.4f}"
    result = CliRunner().invoke(cfplan, ["identify", str(record.folder), "--mass", mass, "-o", str(file)])
    assert result.exit_code == 0, result.output
    for text in ("thrust scale", "motor lag", "pose latency", "vehicle: cf.yaml", "not observable in these records"):
        assert text in result.output
    latency = next(line for line in result.output.splitlines() if "latency:" in line)
    text = (REPOSITORY / "safety.yaml").read_text()
    text = text.replace("vehicle: crazyflie-2.1+", "vehicle: cf.yaml").replace("  latency: 0.010 ", latency + " ")
    (tmp_path / "safety.yaml").write_text(text)
    limits = load_limits(tmp_path / "safety.yaml")
    assert limits.airframe.mass == float(mass)
    assert limits.pose.latency == pytest.approx(drawn.latency, abs=0.003)


def test_one_document_is_printed_where_json_is_asked_for(record, tmp_path):
    file = tmp_path / "cf.yaml"
    result = CliRunner().invoke(cfplan, ["identify", str(record.folder), "-o", str(file), "--json"])
    document = json.loads(result.output)
    assert document["quantities"]["drag"]["standard_uncertainty"] > 0
    assert document["quantities"]["mass"]["unobservable_reason"]


def test_a_file_that_is_there_is_refused_before_anything_is_read(tmp_path):
    file = tmp_path / "cf.yaml"
    file.write_text("mine")
    assert "exists already" in str(refused(tmp_path / "no-record", "-o", file))
    assert file.read_text() == "mine"


@pytest.mark.parametrize("output", ["cf.txt", "no/such/folder/cf.yaml"])
def test_a_place_that_cannot_be_written_is_refused(tmp_path, output):
    error = refused(tmp_path / "no-record", "-o", tmp_path / output)
    assert error.hint


def test_a_record_counts_once(record, tmp_path):
    assert "twice" in str(refused(record.folder, record.folder, "-o", tmp_path / "cf.yaml"))


def test_what_is_no_record_is_refused(tmp_path):
    assert "no such record" in str(refused(tmp_path / "none", "-o", tmp_path / "cf.yaml"))
    assert not list(tmp_path.iterdir())
