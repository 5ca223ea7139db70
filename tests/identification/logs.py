"""Logs of simulated flights: a vehicle with the physics of real ones, under the firmware's Lee controller."""

from dataclasses import replace

import numpy as np

from cfplan.identification.flight_log import FlightLog
from cfplan.identification.reference import ReferenceMotion
from cfplan.identification.replay import Controller
from cfplan.simulation.engine.estimated_loop import EstimatorInput, fly_with_estimator
from cfplan.simulation.engine.lee import REFERENCE_SIZE, LeeGains
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.airframes import AIRFRAMES

PLAIN = replace(
    AIRFRAMES["crazyflie-2.1+"], mass=0.035, drag=(0.0137, 0.013), thrust_scale=1.0, motor_time_constant=0.07,
    velocity_moment=(0.0, 0.0), lift_with_speed=0.0, motor_thrust_max=0.16,
)  # fmt: skip
REAL = replace(PLAIN, velocity_moment=(4.6e-4, 6.2e-4), thrust_scale=1.07, lift_with_speed=0.008)
GAINS = LeeGains(Kpos_Px=9.0, Kpos_Py=9.0, Kpos_Pz=12.0, Kpos_Dx=6.0, Kpos_Dy=6.0, Kpos_Dz=6.0, Kpos_Iz=5.0, mass=0.035)
CONTROLLER = Controller(GAINS)
DURATION, RATE = 9.0, 250


def figure8(duration: float = DURATION, period: float = 4.5) -> ReferenceMotion:
    """A figure eight of 2 m by 1 m, begun slowly from rest a second after the log begins."""
    time = np.arange(0.0, duration + 0.015, 0.005)
    since = np.maximum(time - 1.0, 0.0)
    phase = 2 * np.pi / period * since**5 / (since**4 + 2.0)
    rows = np.zeros((len(time), REFERENCE_SIZE))
    rows[:, 0], rows[:, 1], rows[:, 2] = 0.5 * np.sin(2 * phase), 1.0 - np.cos(phase), 1.0
    for order in (1, 2, 3):
        before = rows[:, 3 * order - 3 : 3 * order]
        rows[:, 3 * order : 3 * order + 3] = np.gradient(before, time, axis=0)
    return ReferenceMotion("a figure eight", time, rows)


def logged(airframe=REAL, controller=CONTROLLER, reference=None, seed=0, sensors=True) -> FlightLog:
    """The log of a flight, with the noise of logs and poses at 100 Hz of a marker body."""
    reference = reference or figure8()
    duration = DURATION
    times = np.arange(0.0, duration, 0.010)
    start = np.zeros(13)
    start[:3], start[9] = reference.rows[0, :3], 1.0
    poses = EstimatorInput(np.arange(0.003, duration, 0.010))
    memory = np.zeros(6)
    memory[2] = GRAVITY / controller.gains.Kpos_Iz * (1.0 / airframe.thrust_scale - 1.0)
    flown = fly_with_estimator(
        controller.gains, controller.setpoints(reference, times + 0.005), times, airframe, start, poses,
        scale=np.full(round(duration * 1000), airframe.thrust_scale), memory=memory,
    )  # fmt: skip
    chance = np.random.default_rng(seed)
    rows = np.arange(0, len(flown.states), 1000 // RATE)
    state = flown.beliefs[rows].copy()
    state[:, :6] = np.round(state[:, :6], 3)
    force = np.gradient(flown.states[:, 3:6], 0.001, axis=0) + np.array([0.0, 0.0, GRAVITY])
    log = FlightLog("a log", rows / 1000.0, state, flown.control[rows])
    if not sensors:
        return log
    truth = flown.states[:: 10]  # fmt: skip
    place = truth[:, :3] + chance.normal(0.0, 3e-4, (len(truth), 3))
    turned = replace(log, state=np.hstack([flown.states[rows, :10], state[:, 10:]]))
    felt = turned.attitude.inv().apply(force[rows]) + chance.normal(0.0, 0.05, (len(rows), 3))
    return replace(
        log, acceleration=felt, pose_time=np.arange(len(truth)) * 0.010, poses=np.hstack([place, truth[:, 6:10]])
    )  # fmt: skip
