"""A plausible figure-eight flight, made up: every message of it, and its header."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from cfplan.flight.setpoints.encoding import LEAD
from cfplan.flight.telemetry import (
    Estimate,
    Event,
    Level,
    PathAnswered,
    PathRequested,
    Phase,
    PhaseEntered,
    PoseReceived,
    SetpointSent,
    Telemetry,
    VehicleStatus,
)
from cfplan.recording.header import FlightBounds, RecordHeader
from cfplan.recording.reader import read_record
from cfplan.recording.record import Record
from cfplan.recording.writer import RecordWriter
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe

MONOTONIC = 5000.0  # s, when the made-up flight begins
STREAM, TRAVEL, HOLD = 7.0, 10.0, 3.0  # s: begin of the stream, its length, and the hold after it
LANDED = STREAM + TRAVEL + HOLD + 4.0
START_HEIGHT = 1.0


def header() -> RecordHeader:
    times = np.linspace(0, TRAVEL, 400)
    return RecordHeader(
        name="figure8",
        version="0.1.0",
        uri="sim://0",
        planner="expert",
        vehicle=Airframe(
            name="Crazyflie 2.1+",
            mass=0.0318,
            inertia=(1.6e-5, 1.6e-5, 2.9e-5),
            arm=0.0325,
            thrust_to_torque=0.007,
            motor_thrust_min=0.0128,
            motor_thrust_max=0.12,
            motor_time_constant=0.105,
            drag=(0.01, 0.02),
            source="made up",
        ),
        thrust_at_full_command=0.12,
        plan_limits=PlanLimits(
            speed=2.0, acceleration=5.0, angular_velocity=8.0, tilt=0.52, motor_thrust_min=0.015,
            motor_thrust_max=0.11, specific_thrust_min=4.9,
        ),
        bounds=FlightBounds(
            speed=2.5, acceleration=10.0, body_rate=10.0, deviation=0.5, lateness=0.01, pose_age=0.1,
            battery_voltage=3.2,
        ),
        travel_time=TRAVEL,
        path=reference(times)[0],
        fence=((-2.0, -3.8, 0.2), (2.0, 3.8, 1.8)),
        wall_time_at_zero=1.7e9,
        provenance={"path": "flights/figure8.yaml"},
    )  # fmt: skip


def reference(times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity, acceleration of a figure eight flown in TRAVEL seconds from rest to rest."""
    x = np.clip(np.asarray(times, dtype=float) / TRAVEL, 0, 1)
    angle = 2 * np.pi * (10 * x**3 - 15 * x**4 + 6 * x**5)
    rate = 2 * np.pi / TRAVEL * 30 * x**2 * (1 - x) ** 2
    jolt = 2 * np.pi / TRAVEL**2 * 60 * x * (1 - x) * (1 - 2 * x)
    place = np.stack([0.6 * np.sin(2 * angle), 1.2 * np.sin(angle), START_HEIGHT + 0.3 * np.sin(angle) ** 2], axis=-1)
    slope = np.stack([1.2 * np.cos(2 * angle), 1.2 * np.cos(angle), 0.3 * np.sin(2 * angle)], axis=-1)
    bend = np.stack([-2.4 * np.sin(2 * angle), -1.2 * np.sin(angle), 0.6 * np.cos(2 * angle)], axis=-1)
    return place, slope * rate[..., None], bend * rate[..., None] ** 2 + slope * jolt[..., None]


def attitude(acceleration: np.ndarray) -> np.ndarray:
    """Quaternions x y z w at yaw 0 whose z axis is along acceleration plus gravity."""
    thrust = acceleration + np.array([0, 0, 9.81])
    z = thrust / np.linalg.norm(thrust, axis=-1, keepdims=True)
    q = np.stack([-z[..., 1], z[..., 0], np.zeros(len(z)), 1 + z[..., 2]], axis=-1)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def flight_messages(seed: int = 0) -> list[Telemetry]:
    """The whole flight at 100 Hz, with lag, noise, a pose dropout of 0.15 s, and a setpoint that is 12 ms late."""
    rng = np.random.default_rng(seed)
    times = np.arange(0, LANDED, 0.01)
    climb = np.clip((times - 3.5) / 2, 0, 1) * (1 - np.clip((times - LANDED + 3.5) / 2.5, 0, 1))
    lagged, speed, push = reference(times - STREAM - 0.03)
    flown = lagged * np.stack([np.clip((times - 5.5) / 1.0, 0, 1)] * 2 + [climb], axis=-1)
    turn = attitude(push)
    rate = np.gradient(turn[:, :3], times, axis=0) * 2
    noisy = flown + rng.normal(0, 0.001, flown.shape)
    flying = (times > 3.0) & (times < LANDED - 0.7)
    effort = np.linalg.norm(push + np.array([0, 0, 9.81]), axis=1) * 0.0318 / 4 / 0.12 * 65535
    motors = np.where(flying[:, None], effort[:, None] + rng.normal(0, 900, (len(times), 4)), 0).clip(0, 65535)
    voltage = 4.05 - 0.02 * times - 0.3 * flying + rng.normal(0, 0.01, len(times))

    messages: list[Telemetry] = []
    for i, t in enumerate(MONOTONIC + times):
        if not 10.0 <= times[i] < 10.15:
            messages.append(PoseReceived(t - 0.01, t + abs(rng.normal(0, 0.0005)), tuple(noisy[i]), tuple(turn[i])))
        messages.append(Estimate(t, tuple(flown[i]), tuple(speed[i]), tuple(push[i]), tuple(turn[i])))
        messages.append(
            VehicleStatus(t, tuple(rate[i]), tuple(int(m) for m in motors[i]), voltage[i], 0b11011 if flying[i] else 1)
        )
    wanted = np.arange(STREAM, STREAM + TRAVEL + HOLD, 0.01)
    late = 0.0002 + np.abs(rng.normal(0, 0.0002, len(wanted)))
    late[400:402] = 0.012, 0.0025
    rows = np.round((wanted - STREAM + late) * 100).astype(int)  # a late packet carries the state of its own time
    place, velocity, acceleration = reference(rows / 100 + LEAD)
    asked = attitude(acceleration)
    for i, t in enumerate(MONOTONIC + wanted):
        messages.append(
            SetpointSent(
                t + late[i], t, int(min(rows[i], 100 * TRAVEL)), tuple(place[i]), tuple(velocity[i]),
                tuple(acceleration[i]), tuple(asked[i]), (0.0, 0.0, 0.0),
            )
        )  # fmt: skip
    entries = [
        (0.0, Phase.CONNECT), (0.3, Phase.RELEASE), (0.5, Phase.CONFIGURE), (0.9, Phase.FEED), (1.3, Phase.CONVERGE),
        (2.3, Phase.PREFLIGHT), (2.7, Phase.ARM), (3.2, Phase.TAKE_OFF), (5.5, Phase.GO_TO_START),
        (STREAM, Phase.STREAM), (STREAM + TRAVEL, Phase.HOLD), (STREAM + TRAVEL + HOLD, Phase.LAND),
        (LANDED - 0.6, Phase.DISARM), (LANDED - 0.1, Phase.CLOSED),
    ]  # fmt: skip
    messages += [PhaseEntered(MONOTONIC + t, phase) for t, phase in entries]
    messages += [
        Event(MONOTONIC + 0.1, Level.INFO, "connected to sim://0"),
        Event(MONOTONIC + 10.1, Level.WARNING, "no pose for 0.1 s"),
        Event(MONOTONIC + STREAM + TRAVEL, Level.INFO, "the path is flown"),
    ]
    messages += [
        PathRequested(MONOTONIC + 12.0, 1, "replace", "[[1.0, 0.0, 1.0]]"),
        PathAnswered(MONOTONIC + 12.2, 1, "refused", "waypoint 1 is too far out", -1, math.nan, math.nan, 0.2),
    ]
    return sorted(messages, key=lambda message: getattr(message, "received", message.time))


@dataclass(frozen=True)
class MadeUpFlight:
    header: RecordHeader
    messages: list[Telemetry]
    folder: Path
    record: Record


@pytest.fixture(scope="session")
def flight(tmp_path_factory) -> MadeUpFlight:
    """The made-up flight, written and read back."""
    folder = tmp_path_factory.mktemp("records") / "20240101-120000-figure8"
    messages = flight_messages()
    with RecordWriter(folder, header()) as writer:
        for message in messages:
            writer.write(message)
    assert writer.failure == ""
    return MadeUpFlight(header(), messages, folder, read_record(folder))


@pytest.fixture
def small_header() -> RecordHeader:
    return header()
