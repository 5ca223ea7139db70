"""`cfplan doctor --uri` reads what preflight rests on, changes nothing, and says what would be refused."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from cfplan.cli import cfplan
from cfplan.errors import InputError
from cfplan.flight.pilot.vehicle_rules import PARAMETER_RULES
from cfplan.flight.radio import connection
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.lab.stepped_link import connect
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.vehicle.airframes import AIRFRAMES

SAFETY_FILE = Path(__file__).parents[2] / "safety.yaml"


@pytest.fixture
def look(monkeypatch):
    def with_settings(**settings):
        lab = SteppedLab(AIRFRAMES["crazyflie-2.1+"], vehicle=VehicleSettings(**settings))
        known = [rule.name for rule in PARAMETER_RULES if rule.name in lab.vehicle.firmware.parameters.toc.index()]
        before = {name: lab.vehicle.firmware.parameters[name] for name in known}
        monkeypatch.setattr(connection, "connect", lambda uri, report, drivers: connect(lab, report))
        words = ["doctor", "--json", "--safety", str(SAFETY_FILE), "--uri", "udp://127.0.0.1:19850"]
        result = CliRunner().invoke(cfplan, words, standalone_mode=False)
        assert result.exception is None
        assert {name: lab.vehicle.firmware.parameters[name] for name in known} == before
        return {check["name"]: check for check in json.loads(result.stdout)["checks"]}, result.return_value

    return with_settings


def test_a_vehicle_as_it_comes_has_nothing_to_refuse(look):
    checks, _ = look()
    assert {checks[rule.name]["verdict"] for rule in PARAMETER_RULES} == {"ok"}
    assert checks["stabilizer.controller"]["found"] == "1; each flight sets 2"
    assert checks["firmware"]["found"].startswith("2026.08")


def test_what_would_be_refused_is_and_says_why(look):
    checks, code = look(stored={"colAv.enable": 1, "ctrlMel.kR_xy": 90000.0})
    refused = {name for name, check in checks.items() if check["verdict"] == "refused"}
    assert refused == {"colAv.enable", "ctrlMel.kR_xy"}
    assert checks["ctrlMel.kR_xy"]["found"].startswith("90000, must be 68292.7 to 71707.3")
    assert "collision avoidance" in checks["colAv.enable"]["hint"]
    assert code == 5


def test_firmware_that_is_too_old_is_refused(look):
    checks, code = look(firmware="2025.02", protocol=9)
    assert checks["firmware"]["verdict"] == "refused"
    assert code == 5


def test_a_radio_that_is_not_there_is_told_without_a_traceback():
    words = [sys.executable, "-m", "cfplan", "doctor", "--uri", "radio://9/80/2M/E7E7E7E7E7"]
    told = subprocess.run(words, capture_output=True, text=True, check=False, cwd=SAFETY_FILE.parent)
    assert told.returncode != 0
    assert told.stderr.splitlines()[-1].startswith("error: radio://9/80/2M/E7E7E7E7E7: ")
    assert "Traceback" not in told.stdout + told.stderr


def test_what_is_no_uri_is_an_error():
    result = CliRunner().invoke(cfplan, ["doctor", "--uri", "nonsense"], standalone_mode=False)
    assert isinstance(result.exception, InputError)
