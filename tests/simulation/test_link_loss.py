"""Where a vehicle goes after link loss: the quick loop against the whole virtual Crazyflie, and limit cases."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfplan.flight.pilot.mission import Mission
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode, encode
from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.link_loss import simulate_link_loss, swept_after_link_loss
from cfplan.studies.fault_scenarios import SCENARIOS
from cfplan.studies.faults import fly_stepped

REPOSITORY = Path(__file__).parents[2]
KILLED = next(row for row in SCENARIOS if row.name == "pilot killed")


@pytest.fixture(scope="module")
def limits():
    return load_limits(REPOSITORY / "safety.yaml")


@pytest.fixture(scope="module")
def line() -> Mission:
    return prepare_mission(REPOSITORY / "flights" / "line.yaml", load_limits(REPOSITORY / "safety.yaml"))


def straight(speed: float, seconds: float = 1.0) -> np.ndarray:
    """Along x from the middle of the room, at one speed."""
    time = np.arange(round(100 * seconds) + 1) / 100.0
    zero = np.zeros_like(time)
    return encode(
        FullStateSetpoints(
            position=np.stack([speed * (time - seconds), zero, zero + 1.0], axis=1),
            velocity=np.stack([zero + speed, zero, zero], axis=1),
            acceleration=np.zeros((len(time), 3)),
            quaternion=np.stack([zero, zero, zero, zero + 1.0], axis=1),
            body_rate=np.zeros((len(time), 3)),
        )
    )


def test_a_vehicle_that_hovers_comes_down_below_where_it_was(limits):
    lost = simulate_link_loss(straight(0.0), limits)
    assert lost.distance < 0.05
    assert lost.beyond < -0.9
    assert "inside the walls" in str(lost)


def test_the_faster_it_flies_the_farther_it_goes(limits):
    distances = [simulate_link_loss(straight(speed), limits).distance for speed in (0.5, 1.0, 1.5)]
    assert distances == sorted(distances)
    assert distances[0] > 0.05


def test_roll_and_pitch_rates_in_the_last_packet_carry_it_away_and_the_watchdog_ends_that_sooner(line, limits):
    told = decode(line.payloads)
    told.body_rate[:, 1] += 3.0
    lost = simulate_link_loss(encode(told)[:200], limits)
    watching = replace(limits, firmware=replace(limits.firmware, watchdog=True))
    assert lost.distance > 4.0
    assert simulate_link_loss(encode(told)[:200], watching).distance < lost.distance / 2


def test_setpoints_as_they_are_sent_are_harmless_when_they_stop(line, limits):
    lost = simulate_link_loss(line.payloads, limits)
    assert lost.beyond < 0.0
    assert lost.distance < 1.2


def test_the_virtual_crazyflie_goes_there_too(line, limits):
    moments = np.round(np.array([0.3, 0.5, 0.7]) * line.motion_ends, 2)
    places, swept = swept_after_link_loss(line.payloads, limits, moments)
    for moment, place, box in zip(moments, places, swept, strict=True):
        flown = fly_stepped(replace(KILLED, moment=float(moment)), line)
        alone = flown.truth.position[flown.truth.time >= flown.struck]
        # 0.35 m: its own estimate drifts so far in two seconds without poses.
        assert alone.min(axis=0) == pytest.approx(box[0], abs=0.35)
        assert alone.max(axis=0) == pytest.approx(box[1], abs=0.35)
        assert np.abs(box - place)[:, 1].max() < 1.1
