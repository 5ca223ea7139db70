"""Prepare a flight for validation, from a record of cfplan or a microSD log, with its reference at the actual start."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.flight.firmware import gains_for
from cfplan.flight.pilot.vehicle_rules import EXTERNAL_ATTITUDE_STD, EXTERNAL_POSITION_STD
from cfplan.identification.flight_log import FlightLog
from cfplan.identification.reference import ReferenceMotion, reference_of_setpoints
from cfplan.identification.replay import Controller, find_start
from cfplan.identification.signals import FlightSignals, read_signals
from cfplan.identification.validate import poses_of
from cfplan.recording.record import Record, meant_motion
from cfplan.simulation.engine.estimated_loop import EstimatorInput
from cfplan.simulation.engine.layout import SETPOINT_SIZE
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.rotations import yaw_of

Triple = tuple[float, float, float]
LINK_DELAY = 0.005  # s from sending a setpoint to its effect
_LATEST = 0.030  # s, largest delay in the times of estimate messages


@dataclass(frozen=True, slots=True, eq=False)
class LoggedFlight:
    """A flight with all inputs of its prediction."""

    log: FlightLog
    reference: ReferenceMotion
    controller: Controller
    airframe: Airframe  # of its plan, or of its kind
    poses: EstimatorInput


def flight_of_record(record: Record, begin: float = 0.0, end: float = math.inf) -> LoggedFlight:
    """Return the flight of a record, or the part between two times, s from its first setpoint.

    The commands of single motors are sampled too seldom to show torques, so torques are unknown. Raises InputError if
    the record holds no flight, or too little of one.
    """
    signals = read_signals(record)
    airframe, time = signals.airframe, signals.estimate_time - _delay_of_setpoints(signals)
    inside = (time >= 0.0) & (time <= signals.duration)
    zero, time = float(time[inside][0]), time[inside] - float(time[inside][0])

    def at(values: NDArray) -> NDArray:
        columns = values.reshape(len(signals.status_time), -1).T
        return np.column_stack([np.interp(time + zero, signals.status_time, column) for column in columns])

    control = np.full((len(time), 4), np.nan)
    control[:, :1] = airframe.motor_thrust_max * at(signals.collective)
    log = FlightLog(
        name=record.folder.name,
        time=time,
        state=np.hstack([signals.estimate[inside], at(signals.gyro)]),
        control=control,
        voltage=at(signals.voltage)[:, 0],
        pose_time=signals.pose_time - zero,
        poses=np.hstack([signals.position, signals.quaternion]),
    )
    reference = _reference(record, signals.begin + zero)
    first = float(reference.time[0]) + begin
    begun = log.between(first, min(float(reference.time[-1]), first + end - begin))
    missed = float(log.time[log.time >= first][0])
    known = tuple(airframe.drag[axis] / airframe.mass for axis in (0, 0, 0))
    poses = EstimatorInput(
        begun.pose_time, position_deviation=EXTERNAL_POSITION_STD, attitude_deviation=EXTERNAL_ATTITUDE_STD,
        drag=(known[0], known[1], known[2]),
    )  # fmt: skip
    return LoggedFlight(begun, reference.moved(-missed, np.zeros(3)), Controller(gains_for(airframe)), airframe, poses)


def flight_of_log(
    log: FlightLog, controller: Controller, airframe: Airframe, reference: ReferenceMotion | None = None,
    offset: Triple | None = None,
) -> LoggedFlight:  # fmt: skip
    """Return the flight of a log along a reference of unknown start, or without one along the logged setpoints.

    `offset`, m, is the place of the reference's origin; without it that of the log. Raises InputError without either.
    """
    if reference is None:
        if log.setpoint is None:
            hint = "log ctrltargetZ.x to .vz, or name the trajectory: --polynomials or --plan"
            raise InputError("it has no setpoints", where=log.name, hint=hint)
        begun = reference_of_setpoints(log.time, log.setpoint, log.setpoint_yaw)
    elif offset is None:
        begun = find_start(log, reference, controller, airframe)
    else:
        begun = find_start(replace(log, setpoint=None), reference, controller, airframe, np.array(offset))
    return LoggedFlight(log, begun, controller, airframe, poses_of(log))


def _reference(record: Record, zero: float) -> ReferenceMotion:
    """Return the planned motion, with the setpoints as sent."""
    sent, time = record.setpoints, record.setpoints.time - zero
    attitude, acceleration, _ = meant_motion(sent)
    yaw = np.array([yaw_of(each) for each in attitude])
    motion = reference_of_setpoints(time, np.hstack([sent.position, sent.velocity, acceleration]), yaw)
    rows = np.zeros((len(sent.time), SETPOINT_SIZE))
    rows[:, 0:3], rows[:, 3:6], rows[:, 6:9] = sent.position, sent.velocity, sent.acceleration
    rows[:, 9:13], rows[:, 13:16] = sent.quaternion, sent.body_rate
    return ReferenceMotion("setpoints as sent", motion.time, motion.rows, time + LINK_DELAY, rows)


def _delay_of_setpoints(signals: FlightSignals) -> float:
    """Return the delay in the times of estimate messages, s, from estimated positions against poses."""
    shifts = np.arange(0.0, _LATEST, 0.001)
    places, known = signals.position, signals.pose_time

    def apart(shift: float) -> float:
        at = np.column_stack([np.interp(known, signals.estimate_time - shift, column)
                              for column in signals.estimate[:, :3].T])  # fmt: skip
        distance = (at - places)[50:-50]
        return float(np.mean((distance - distance.mean(axis=0)) ** 2))

    return float(min(shifts, key=apart))
