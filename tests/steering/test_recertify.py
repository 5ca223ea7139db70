"""A record tells what its pilot was ever bound to fly, and all of it is certified again; what was changed is found."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from rerun.chunk import RrdReader

import cfplan
from cfplan.air.requests import PathVerdict
from cfplan.air.stepped import PlannerFault
from cfplan.cli import cfplan as command_line
from cfplan.errors import InputError, NotCertifiedError
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE
from cfplan.planning.plan_file import load_plan, save_plan
from cfplan.recording.reader import read_record
from cfplan.recording.record import PLAN_IN_FLIGHT
from cfplan.recording.rerun import layout
from cfplan.recording.rerun.record_view import write_rrd
from cfplan.steering.recertify import recertify
from cfplan.steering.steered_vehicle import SteeredVehicle
from cfplan.steering.stepped_steering import SteppedSteering


@pytest.fixture(scope="module")
def folder(limits, tmp_path_factory):
    """The record of a flight that was extended, slowed down, begun anew, stopped, and ended early by a landing."""
    records = tmp_path_factory.mktemp("records")
    with cfplan.connect("sim://0", stepped=True, safety=limits, records=records) as vehicle:
        vehicle.take_off(0.8)
        vehicle.fly([[1, 0, 1], [0, 1, 1.2]])
        vehicle.sleep(0.8)
        vehicle.extend([[-1, 0, 1]])
        vehicle.slower()
        vehicle.wait()
        vehicle.sleep(0.5)
        vehicle.fly([[0, 1.5, 1]])
        vehicle.sleep(0.6)
        vehicle.stop()
        vehicle.wait()
        vehicle.fly([[0, -1.5, 1]])
        vehicle.sleep(0.9)
        vehicle.land()
    return vehicle.record


@pytest.fixture
def copy(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copy")


def with_a_plan(record):
    """The numbers of the commitments with which another plan begins; the others are more of it, or stops."""
    checksums = record.commitments.checksum
    return [n for n, each in enumerate(checksums) if (record.folder / PLAN_IN_FLIGHT.format(each)).is_file()]


def test_everything_committed_is_certified_again_and_was_streamed(folder):
    record = read_record(folder)
    checked = recertify(record)
    assert checked.plans == checked.joints == 5
    assert checked.stops == 1
    assert checked.jump < 1e-9
    shown = dict(checked.rows())
    assert shown["joints between plans"].startswith("5, none jumps by more than")
    assert dict(replace(checked, joints=0).rows())["joints between plans"] == "none: one plan was flown"
    assert 0.9 < checked.certificate.worst.share <= 1.0
    assert checked.streamed > 400
    assert checked.left_after == pytest.approx(checked.streamed / 100, abs=0.03)
    assert checked.committed == sum(len(each) // PAYLOAD_SIZE for each in record.commitments.payloads)


def test_a_plan_that_goes_on_behind_a_stop_is_recorded_and_certified_again(limits, tmp_path):
    """Its next part did not pass once; later it was asked for a place that no way leads to but from rest."""
    flight = SteppedSteering(limits)
    with SteeredVehicle(flight, limits, uri="sim://0", records=tmp_path) as vehicle:
        vehicle.take_off(0.8)
        vehicle.fly([[1.2, 2.5, 1.0], [-1.2, 2.5, 1.2], [-1.2, -2.5, 1.0]])
        flight.planner.fault = PlannerFault.GARBAGE
        vehicle.sleep(0.11)
        flight.planner.fault = None
        vehicle.sleep(2.4)
        before = np.array(vehicle.target)
        vehicle.sleep(0.1)
        turned = vehicle.replace([before - 0.3 * (np.array(vehicle.target) - before), [0.0, 0.0, 1.0]])
        assert vehicle.speed > 1.5
        vehicle.wait()
        np.testing.assert_allclose(vehicle.position, [0.0, 0.0, 1.0], atol=0.05)
    changed = [answer for answer in vehicle.answers() if answer.verdict is PathVerdict.CHANGED]
    record = read_record(vehicle.record)
    checked = recertify(record)
    assert checked.plans == checked.joints == 3
    assert checked.jump < 1e-9
    assert {changed[0].checksum, turned.checksum} <= set(record.commitments.checksum.tolist())
    assert checked.stops == (turned.stop > 0)


def test_a_stop_or_a_refusal_beside_a_plan_is_not_taken_for_its_joint(folder):
    """Each may come from the same splice; what was refused has none."""
    record = read_record(folder)
    answers, splice = record.answers, record.commitments.splice[with_a_plan(record)[1]]
    (row,) = np.flatnonzero(answers.splice == splice)
    rows = np.insert(np.arange(len(answers.splice)), row, [row, row])
    columns = {name: getattr(answers, name)[rows] for name in type(answers).__slots__}
    columns["splice"][[row, row + 1]] = splice, -1
    columns["joint"][[row, row + 1]] = splice / RATE, np.nan
    assert recertify(replace(record, answers=replace(answers, **columns))).joints == 5


def test_the_command_line_says_so(folder):
    result = CliRunner().invoke(command_line, ["check", str(folder)], catch_exceptions=False)
    assert result.return_value in (0, None)
    assert "plans, certified again" in result.output
    assert "each as committed, until" in result.output


def test_a_setpoint_that_was_not_committed_is_found(folder):
    record = read_record(folder)
    began = record.setpoints.index == 200
    moved = record.setpoints.position.copy()
    moved[began, 0] += 0.001
    with pytest.raises(NotCertifiedError, match="setpoint 200 as streamed"):
        recertify(replace(record, setpoints=replace(record.setpoints, position=moved)))


@pytest.mark.parametrize(("byte", "words"), [(29 * 100 + 5, "setpoints are not those"), (None, "stops are not those")])
def test_other_bytes_or_stops_than_were_certified_are_found(copy, byte, words):
    record = read_record(copy)
    commitments, number = record.commitments, with_a_plan(record)[1]
    payloads, checksums = commitments.payloads.copy(), commitments.checksum.copy()
    if byte is None:
        checksums[number] ^= 1
        shutil.copy(
            copy / PLAN_IN_FLIGHT.format(commitments.checksum[number]), copy / PLAN_IN_FLIGHT.format(checksums[number])
        )
    else:
        changed = bytearray(payloads[number])
        changed[byte] ^= 1
        payloads[number] = bytes(changed)
    with pytest.raises(NotCertifiedError, match=words) as refused:
        recertify(replace(record, commitments=replace(commitments, payloads=payloads, checksum=checksums)))
    assert f"plan {number}," in refused.value.where


def test_another_part_of_a_plan_than_was_certified_is_found(copy):
    record = read_record(copy)
    commitments = record.commitments
    part = next(n for n in range(2, len(commitments.splice)) if n not in with_a_plan(record))
    payloads, checksums = commitments.payloads.copy(), commitments.checksum.copy()
    checksums[part] ^= 1
    with pytest.raises(NotCertifiedError, match="stops are not those"):
        recertify(replace(record, commitments=replace(commitments, checksum=checksums)))
    changed = bytearray(payloads[part])
    changed[-29 * 40 + 5] ^= 1  # in the hover behind the stop
    payloads[part] = bytes(changed)
    with pytest.raises(NotCertifiedError, match="setpoints are not those"):
        recertify(replace(record, commitments=replace(commitments, payloads=payloads)))


def test_a_plan_that_is_missing_or_another_is_said(copy):
    record = read_record(copy)
    first, second = (
        copy / PLAN_IN_FLIGHT.format(record.commitments.checksum[number]) for number in with_a_plan(record)[:2]
    )
    shutil.copy(first, second)
    with pytest.raises(NotCertifiedError, match="the motion jumps"):
        recertify(record)
    second.unlink()
    with pytest.raises(InputError, match="no such file with its plan"):
        recertify(record)


def test_a_plan_that_exceeds_a_limit_is_said(copy):
    record = read_record(copy)
    file = copy / PLAN_IN_FLIGHT.format(record.commitments.checksum[with_a_plan(record)[0]])
    made = load_plan(file)
    slower = replace(made.limits, plan=replace(made.limits.plan, speed=made.limits.plan.speed / 2))
    save_plan(replace(made, limits=slower), file)
    with pytest.raises(NotCertifiedError, match="of the limit on speed"):
        recertify(record)


def test_replay_draws_what_was_committed(folder, tmp_path):
    record = read_record(folder)
    write_rrd(record, tmp_path / "flight.rrd")
    chunks = RrdReader(tmp_path / "flight.rrd").stream().filter(content=[f"/{layout.COMMITTED}"])
    drawn = [strip for chunk in chunks for strip in chunk.to_record_batch().column("LineStrips3D:strips").to_pylist()]
    assert len(drawn) == len(record.commitments.time)
    np.testing.assert_allclose(drawn[-1][0][-1], [0, -1.5, 1], atol=0.1)
    said = record.events.text.tolist()
    assert any(text.startswith("request 1: fly through (1.00, 0.00, 1.00)") for text in said)
    assert any(text.startswith("answer 1: accepted") for text in said)
    assert np.isin(record.answers.number, record.requests.number).all()
