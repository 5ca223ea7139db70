"""A certified plan in the vehicle's memory, uploaded packet by packet, and flown by its own commander."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfplan.flight.on_board.certified_pieces import certified_compressed, certified_pieces
from cfplan.flight.radio.crtp import Port
from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.geometry.path_file import path_through
from cfplan.planning.plan import plan
from cfplan.safety.limits_file import load_limits

LIMITS = load_limits(Path(__file__).parents[3] / "safety.yaml")
POINTS = [[-1.2, -1.2, 0.7], [0.2, 0.4, 1.1], [1.2, -0.6, 0.9], [1.2, 1.2, 1.1]]
MORE = 0.02  # m, by which deviations may be larger than where the same plan is streamed
MEMORY = 1  # its number in the vehicle's list


@pytest.fixture(scope="module")
def trajectory():
    gentle = replace(LIMITS.plan, angular_acceleration=0.57 * LIMITS.plan.angular_acceleration)
    return plan(path_through(POINTS).path, LIMITS.airframe, replace(LIMITS, plan=gentle)).trajectory


def streamed_deviation(rig, trajectory, limits):
    """The largest deviation, m, where setpoints fly a plan from where the vehicle hovers; it is left in hover."""
    encoded = encode_trajectory(trajectory, gains=gains_under(limits), space=limits.space)
    payloads, places = iter(encoded.payloads), []

    def stream(_):
        rig.send(Port.SETPOINT, 0, next(payloads).tobytes())
        places.append(rig.truth[:3].copy())

    rig.run(len(encoded.payloads) / 100, stream)
    assert rig.go_to(*rig.belief[:3], duration=1.0) == 0
    rig.notify_setpoint_stop()
    rig.run(1.0)
    wanted = trajectory.at(np.arange(len(places)) / 100).position
    return np.linalg.norm(np.array(places) - wanted, axis=1).max()


@pytest.mark.parametrize("make", [certified_pieces, certified_compressed])
def test_an_upload_is_read_back_and_flown_nearly_as_well_as_a_stream(hovering, trajectory, make):
    made, rig = make(trajectory, LIMITS), hovering
    for address in range(0, len(made.memory), 24):
        part = made.memory[address : address + 24]
        assert rig.send(Port.MEMORY, 2, struct.pack("<BI", MEMORY, address) + part)[-1][-1] == 0
        assert rig.send(Port.MEMORY, 1, struct.pack("<BIB", MEMORY, address, len(part)))[-1][-len(part) :] == part
    define = struct.pack("<BBBBIB", 6, 1, 1, int(made.compressed), 0, len(made.pieces.durations))
    assert rig.high_level(define) == 0
    begin = made.pieces.coefficients[0, :, 0]
    assert rig.go_to(*begin, duration=4.0) == 0
    rig.run(6.0)
    streamed = streamed_deviation(rig, trajectory, LIMITS)
    assert rig.go_to(*begin, duration=4.0) == 0
    rig.run(6.0)

    assert rig.high_level(struct.pack("<BBBBBBf", 13, 0, 0, 0, 0, 1, 1.0)) == 0
    places: list[np.ndarray] = []
    rig.run(made.duration + 1.0, lambda _: places.append(rig.truth[:3].copy()))
    wanted = made.reference.plan_at(np.arange(len(places)) / 100)[:, 0, :3]
    off = np.linalg.norm(np.array(places) - wanted, axis=1).max()
    assert off < streamed + MORE
    assert rig.land() == 0
    rig.run(3.0)
    assert rig.truth[2] == 0.0
    assert rig.off_in_air == 0
