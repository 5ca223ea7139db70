"""The whole loop against the flights that the real firmware flew."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.flight.firmware import MellingerGains
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode
from cfplan.simulation.engine.flight import Conditions, EstimateErrors, fly_setpoints
from cfplan.simulation.engine.layout import hovering
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.airframes import AIRFRAMES

AIRFRAME = AIRFRAMES["crazyflie-2.1+"]
HERE = np.array([[0.5, -0.5, 1.0]])
NOTHING = np.zeros((1, 3))
LEVEL = np.array([[0.0, 0.0, 0.0, 1.0]])
HOVER = FullStateSetpoints(HERE, NOTHING, NOTHING, LEVEL, NOTHING)


def airframe_of(flown) -> Airframe:
    return Airframe(
        name="firmware data", mass=float(flown["mass"]), inertia=tuple(flown["inertia_diag"]),
        arm=float(flown["arm_per_axis"]), thrust_to_torque=float(flown["thrust_to_torque"]), motor_thrust_min=0.0,
        motor_thrust_max=float(flown["thrust_max_N"]), motor_time_constant=float(flown["motor_tau"]),
        drag=(flown["drag"][0], flown["drag"][2]), source="",
    )  # fmt: skip


@pytest.mark.parametrize("number", [0, 1])
def test_the_firmwares_flights_are_flown_again_to_a_hundredth_of_a_millimetre(firmware, number):
    flown = firmware(f"closed_loop_mellinger_{number}")
    airframe = airframe_of(flown)
    start = np.concatenate(
        [flown[name][0] for name in ("position", "velocity", "quaternion_xyzw", "body_rate", "motor_thrust_N")]
    )
    loop = fly_setpoints(
        decode(flown["payload"]),
        flown["t"],
        airframe,
        start,
        duration=float(flown["t"][-1]),
        conditions=Conditions(MellingerGains(mass=airframe.mass)),
    )
    rows = slice(None, None, 10)
    assert loop.time[rows] == pytest.approx(flown["t"], abs=1e-6)
    assert np.linalg.norm(loop.position[rows] - flown["position"], axis=1).max() < 1e-5
    assert loop.velocity[rows] == pytest.approx(flown["velocity"], abs=1e-4)
    # Yaw swings ever wider there (no rotor reaction, lag 0.105 s), and with it what float32 rounded off.
    assert loop.quaternion[rows] == pytest.approx(flown["quaternion_xyzw"], abs=5e-4)
    assert loop.body_rate[rows] == pytest.approx(flown["body_rate"], abs=1e-2)
    assert loop.motor_thrust[rows] == pytest.approx(flown["motor_thrust_N"], abs=1e-4)


@pytest.mark.parametrize("airframe", AIRFRAMES.values(), ids=AIRFRAMES)
def test_every_airframe_hovers_on_the_spot_after_a_knock(airframe):
    start = hovering(airframe, HERE[0])
    start[10:13] = 0.3, -0.3, 0.3
    loop = fly_setpoints(HOVER, np.zeros(1), airframe, start, duration=20.0)
    assert np.abs(loop.position[-1] - HERE[0]).max() < 1e-3
    assert np.abs(loop.body_rate[-5000:]).max() < 1e-2


def test_yaw_would_be_unstable_at_this_motor_lag_without_the_rotors_reaction():
    """kw s + kR against s²(1 + τs): unstable where τ kR > kw, as Routh says."""
    bare = replace(AIRFRAME, rotor_reaction=0.0)
    growth = []
    for lag in (0.085, 0.115):
        start = hovering(bare, HERE[0])
        start[12] = 0.02
        loop = fly_setpoints(
            HOVER,
            np.zeros(1),
            replace(bare, motor_time_constant=lag),
            start,
            duration=6.0,
        )
        early, late = (np.abs(loop.body_rate[part, 2]).max() for part in (slice(1000, 2000), slice(5000, 6000)))
        growth.append(late / early)
    assert growth[0] < 0.5
    assert growth[1] > 2.0


def test_it_takes_off_from_the_floor_and_lands_on_it():
    seconds = np.arange(0, 8, 0.01)
    height = np.interp(seconds, [0, 1.5, 3, 6, 8], [0.0, 0.5, 0.5, -0.2, -0.2])
    speed = np.gradient(height, 0.01)
    count = len(seconds)
    up = np.array([[0.0, 0.0, 1.0]])
    setpoints = FullStateSetpoints(
        height[:, None] * up,
        speed[:, None] * up,
        np.zeros((count, 3)),
        np.tile(LEVEL, (count, 1)),
        np.zeros((count, 3)),
    )
    start = hovering(AIRFRAME, np.zeros(3))
    start[13:17] = 0.0
    loop = fly_setpoints(setpoints, seconds, AIRFRAME, start, 8.0, Conditions(floor=0.0))
    assert loop.position[:, 2].min() == 0.0
    assert loop.position[2500, 2] == pytest.approx(0.5, abs=0.05)
    assert loop.position[-1, 2] == 0.0


def test_setpoints_count_from_when_they_arrive():
    moved = FullStateSetpoints(
        np.vstack([HERE, HERE + 0.1]), np.zeros((2, 3)), np.zeros((2, 3)), np.vstack([LEVEL] * 2), np.zeros((2, 3))
    )
    start = hovering(AIRFRAME, HERE[0])
    due, late = (
        fly_setpoints(moved, np.array([0.0, 0.1]), AIRFRAME, start, 0.5, Conditions(delay=delay))
        for delay in (0.0, 0.02)
    )
    assert late.states[20:] == pytest.approx(due.states[:-20], abs=1e-4)
    assert not np.allclose(late.states, due.states, atol=1e-4)


def test_a_late_estimate_leaves_a_flight_ahead_by_speed_times_latency():
    speed = np.array([[1.0, 0.0, 0.0]])
    seconds = np.arange(0, 4, 0.01)
    count = len(seconds)
    frame = replace(AIRFRAME, drag=(0.0, 0.0))
    setpoints = FullStateSetpoints(
        HERE + seconds[:, None] * speed, np.tile(speed, (count, 1)), np.zeros((count, 3)), np.tile(LEVEL, (count, 1)),
        np.zeros((count, 3)),
    )  # fmt: skip
    start = hovering(frame, HERE[0])
    start[3:6] = speed
    known, late = (
        fly_setpoints(
            setpoints,
            seconds,
            frame,
            start,
            duration=4.0,
            conditions=Conditions(estimate=EstimateErrors(latency=latency)),
        )
        for latency in (0.0, 0.03)
    )
    assert late.position[-1, 0] - known.position[-1, 0] == pytest.approx(0.03, rel=0.1)


def test_noise_is_the_same_for_the_same_seed():
    start = hovering(AIRFRAME, HERE[0])
    noisy = [
        fly_setpoints(
            HOVER,
            np.zeros(1),
            AIRFRAME,
            start,
            duration=0.5,
            conditions=Conditions(estimate=EstimateErrors(position_noise=0.01, seed=seed)),
        )
        for seed in (1, 1, 2)
    ]
    assert np.array_equal(noisy[0].states, noisy[1].states)
    assert not np.array_equal(noisy[0].states, noisy[2].states)


def test_wind_and_a_weak_motor_are_felt():
    start = hovering(AIRFRAME, HERE[0])
    calm = fly_setpoints(HOVER, np.zeros(1), AIRFRAME, start, duration=2.0)
    blown = fly_setpoints(HOVER, np.zeros(1), AIRFRAME, start, 2.0, Conditions(wind=np.array([2.0, 0.0, 0.0])))
    weak = fly_setpoints(HOVER, np.zeros(1), AIRFRAME, start, 2.0, Conditions(efficiency=np.array([0.8, 1, 1, 1])))
    assert calm.position[-1] == pytest.approx(HERE[0], abs=1e-3)
    assert blown.position[-1, 0] > HERE[0, 0] + 0.02
    assert np.median(weak.commands[-500:, 0]) > 1.1 * np.median(weak.commands[-500:, 2])
