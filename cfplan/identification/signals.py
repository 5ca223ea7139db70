"""The part of a record that identification uses: the streamed flight in the air, as arrays on the vehicle's clock."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.flight.telemetry import Phase
from cfplan.recording.record import Estimates, Poses, Record, Setpoints, StatusReports
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.motor_commands import command_shares

SHORTEST = 5.0  # s, least duration of a usable flight
_BEGINS = (Phase.GO_TO_START, Phase.STREAM)
_ENDS = (Phase.LAND, Phase.DISARM, Phase.CLOSED)
_LARGEST_GAPS = {"poses": 0.1, "estimates": 0.1, "status": 0.2}  # s, median interval; sparser streams are rejected
_UNIT = 0.1  # by which the length of a quaternion may differ from 1
_UNDELAYED_PERCENTILE = 5  # of the poses' delays: the delay of poses that nothing held back

_Stream = Setpoints | Poses | Estimates | StatusReports


@dataclass(frozen=True, slots=True)
class FlightSignals:
    """One flight; times are s from its beginning, on the clock of the vehicle's messages as dated by the pilot."""

    airframe: Airframe  # as the pilot set the controller
    duration: float  # s
    behind: float  # s by which the pilot dated poses back
    pose_time: NDArray  # (N,) s, dated back by `behind`
    position: NDArray  # (N, 3) m
    quaternion: NDArray  # (N, 4) body→world x y z w, of the markers' body
    status_time: NDArray  # (M,) s
    gyro: NDArray  # (M, 3) rad/s
    command: NDArray  # (M, 4) fraction of the full command of each motor
    voltage: NDArray  # (M,) V
    estimate_time: NDArray  # (K,) s
    estimate: NDArray  # (K, 10) position, velocity, quaternion as estimated on board
    sent_time: NDArray  # (L,) s
    setpoint: NDArray  # (L, 9) position, velocity, acceleration
    begin: float = 0.0  # s, of the record's clock, at which these times are 0

    @property
    def collective(self) -> NDArray:
        """(M,) sum of the motors' commands, 4 at most"""
        return self.command.sum(axis=1)


def read_signals(record: Record) -> FlightSignals:
    """Return a record's flight. Raises InputError where there is none, or too little of it."""
    where = str(record.folder)
    begin, end = _airborne(record, where)
    status = _rows(record.status, begin, end, ("body_rate", "battery_voltage"))
    poses = _rows(record.poses, begin, end, ("position", "quaternion", "received"))
    estimates = _rows(record.estimates, begin, end, ("position", "velocity", "quaternion"))
    setpoints = _rows(record.setpoints, begin, end, ("position", "velocity", "acceleration"))
    for name, times in (("poses", poses["time"]), ("estimates", estimates["time"]), ("status", status["time"])):
        if len(times) < 20 or np.median(np.diff(times)) > _LARGEST_GAPS[name]:
            raise InputError(
                f"too few messages of {name}: {len(times)} in {end - begin:.1f} s of flight",
                where=where,
                hint="use a record of `cfplan fly`, with motion capture and the vehicle's logs",
            )
    command = command_shares(status["motor"], status["battery_voltage"], record.header.vehicle)
    if not command.any() or len(setpoints["time"]) < 20:
        raise InputError("it holds no motor commands or no setpoints", where=where, hint="use a record of `cfplan fly`")
    end = min(end, *(float(stream["time"][-1]) for stream in (status, poses, estimates)))
    return FlightSignals(
        airframe=record.header.vehicle,
        duration=end - begin,
        behind=float(np.percentile(poses["received"] - poses["time"], _UNDELAYED_PERCENTILE)),
        pose_time=poses["time"] - begin,
        position=poses["position"],
        quaternion=poses["quaternion"],
        status_time=status["time"] - begin,
        gyro=status["body_rate"],
        command=command,
        voltage=status["battery_voltage"],
        estimate_time=estimates["time"] - begin,
        estimate=np.hstack([estimates["position"], estimates["velocity"], estimates["quaternion"]]),
        sent_time=setpoints["time"] - begin,
        setpoint=np.hstack([setpoints["position"], setpoints["velocity"], setpoints["acceleration"]]),
        begin=begin,
    )


def _airborne(record: Record, where: str) -> tuple[float, float]:
    """Return begin and end, s, of the streaming of setpoints in the air."""
    phases = [str(phase) for phase in record.phases.phase]
    begins = [time for time, phase in zip(record.phases.time, phases, strict=True) if phase in _BEGINS]
    if not begins:
        raise InputError("no flight in it", where=where, hint="name the record of a flight along flights/identify.yaml")
    begin = float(begins[0])
    ends = [t for t, phase in zip(record.phases.time, phases, strict=True) if phase in _ENDS and t > begin]
    end = float(ends[0]) if ends else record.start + record.duration
    if end - begin < SHORTEST:
        raise InputError(
            f"too short: {end - begin:.1f} s of flight, and {SHORTEST:g} s are needed",
            where=where,
            hint="fly flights/identify.yaml to its end",
        )
    return begin, end


def _rows(stream: _Stream, begin: float, end: float, finite: tuple[str, ...]) -> dict[str, NDArray]:
    """Return a stream's columns between two times, in order of time, without rows that are not finite."""
    columns: dict[str, NDArray] = {field.name: np.asarray(getattr(stream, field.name)) for field in fields(stream)}
    time = columns["time"]
    keep = (time >= begin - 0.5) & (time <= end + 0.5)
    for name in finite:
        keep &= np.isfinite(columns[name]).all(axis=tuple(range(1, columns[name].ndim)))
    if "quaternion" in columns:
        keep &= np.abs(np.linalg.norm(columns["quaternion"], axis=1) - 1.0) < _UNIT
    order = np.flatnonzero(keep)[np.argsort(time[keep], kind="stable")]
    order = order[np.diff(time[order], prepend=-np.inf) > 0.0]
    return {name: values[order] for name, values in columns.items()}
