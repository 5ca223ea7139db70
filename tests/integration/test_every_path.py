"""Every file of flights/, planned, certified, flown through the packets, and judged by what really happened."""

from pathlib import Path

import numpy as np
import pytest
from stepped_flight import fly_stepped

from cfplan.errors import ExitCode
from cfplan.flight.pilot.mission import mission_of
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.setpoints.byte_check import check_bytes
from cfplan.flight.setpoints.encoding import RATE, encode_trajectory
from cfplan.flight.telemetry import SetpointSent
from cfplan.geometry.path_file import load_path_file
from cfplan.planning.plan import plan
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.dry_run import dry_run
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.virtual_vicon.cameras import ViconSettings

REPOSITORY = Path(__file__).parents[2]
FLIGHTS = sorted((REPOSITORY / "flights").glob("*.yaml"))

pytestmark = [pytest.mark.integration, pytest.mark.slow]


@pytest.mark.parametrize("file", FLIGHTS, ids=[file.stem for file in FLIGHTS])
def test_a_path_file_certifies_and_flies_as_planned(file):
    limits = load_limits(REPOSITORY / "safety.yaml")
    path_file = load_path_file(file)
    made = plan(
        path_file.path,
        limits.airframe,
        limits,
        yaw=path_file.yaw,
        yaw_angle=path_file.yaw_angle,
        speed_factor=path_file.speed,
    )
    assert made.certificate.passed
    encoded = encode_trajectory(made.trajectory)
    check_bytes(encoded, made.trajectory, limits.plan)
    assert dry_run(encoded, made.trajectory, limits).passed

    assert limits.airframe.motor_time_constant == 0.105
    cameras = ViconSettings(position_noise=1e-3, attitude_noise=np.radians(0.2), latency=0.010)
    lab = SteppedLab(limits.airframe, cameras=cameras)
    lab.disturb(RadioFault(RadioFaultKind.LOSS, size=0.05))
    flight = fly_stepped(mission_of(encoded, limits), lab=lab)
    outcome, truth, sent = flight.outcome, flight.truth, flight.of(SetpointSent)

    assert (outcome.exit_code, outcome.reason) == (ExitCode.OK, "landed")
    assert outcome.rung is Rung.NONE
    planned = made.trajectory.duration
    last = next(
        message for message in sent if message.time > outcome.first_setpoint and message.index >= planned * RATE
    )
    assert last.time - outcome.first_setpoint == pytest.approx(planned, rel=0.01)
    assert truth.off_in_air[-1] == 0
    assert not truth.locked
    assert truth.position[-1, 2] < 0.02

    moving = (truth.time >= outcome.first_setpoint) & (truth.time <= outcome.first_setpoint + made.trajectory.duration)
    reference = made.trajectory.at(truth.time[moving] - outcome.first_setpoint).position
    deviation = np.linalg.norm(truth.position[moving] - reference, axis=1)
    assert moving.sum() > 90 * made.trajectory.duration
    assert deviation.max() <= 0.08
    assert np.all(limits.space.beyond(truth.position[moving]) < 0)
    assert outcome.lateness.p99 <= 2e-3
