"""Flight logs for validation: state estimate, commands, sensors and poses on the vehicle's clock."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.recording.importers import usd_log
from cfplan.recording.importers.formats import find_importer
from cfplan.recording.importers.mocap_log import subject
from cfplan.vehicle.airframe import GRAVITY

STATE = 13  # columns of the state
FEWEST, SHORTEST = 200, 2.0  # records; s
LONGEST_GAP = 0.5  # s without a record, beyond which a controller's integrals cannot be followed
_GAP, _GAP_MARGIN = 0.03, 0.15  # s without a record that make a gap; s beside a gap that are left out
_RATE = 90.0  # 1/s, least rate of records for recomputing the controller
_MAX_TILT = np.radians(80.0)  # rad of tilt beyond which a vehicle has crashed
_COMMANDS = (("thrustSI", "thrustSi"), ("torquex",), ("torquey",), ("torquez",))  # of ctrlLee, by firmware


@dataclass(frozen=True, slots=True, eq=False)
class FlightLog:
    """The log of a flight: N records, M poses of motion capture."""

    name: str
    time: NDArray  # (N,) s, ascending, from 0
    state: NDArray  # (N, 13) estimated position m, velocity m/s, quaternion x y z w; body rate rad/s as measured
    control: NDArray  # (N, 4) commanded thrust, N, and torques, N m; NaN where not logged
    acceleration: NDArray | None = None  # (N, 3) m/s², specific force in body axes
    voltage: NDArray | None = None  # (N,) V
    setpoint: NDArray | None = None  # (N, 6) m, m/s, as logged by the controller
    setpoint_yaw: NDArray | None = None  # (N,) rad, likewise
    pose_time: NDArray = field(default_factory=partial(np.empty, 0))  # (M,) s
    poses: NDArray = field(default_factory=partial(np.empty, (0, 7)))
    """(M, 7) m and quaternion x y z w, which is zero where motion capture gives no attitude."""

    @property
    def duration(self) -> float:
        """Return the time from the first record to the last, s."""
        return float(self.time[-1])

    @property
    def gaps(self) -> NDArray:
        """Return the times between records, (N - 1,) s."""
        return np.diff(self.time)

    @property
    def body_velocity(self) -> NDArray:
        """Return the estimated velocity in body axes, (N, 3) m/s."""
        return np.asarray(self.attitude.inv().apply(self.state[:, 3:6]))

    @property
    def attitude(self) -> Rotation:
        """Return the estimated attitude, body→world, N of them."""
        return Rotation.from_quat(self.state[:, 6:10])

    def away_from_gaps(self, time: NDArray) -> NDArray:
        """Return which times, (K,) s, are not beside a gap in the records."""
        away = np.ones(len(time), dtype=bool)
        for k in np.flatnonzero(self.gaps > _GAP):
            away &= (time < self.time[k] - _GAP_MARGIN) | (time > self.time[k + 1] + _GAP_MARGIN)
        return away

    def between(self, begin: float, end: float) -> "FlightLog":
        """Return the part from one time to another, s; its times count from its first record.

        Raises InputError if it is empty.
        """
        keep = (self.time >= begin) & (self.time <= end)
        if not keep.any():
            message = f"nothing between {begin:g} and {end:g} s"
            hint = f"it lasts {self.duration:.1f} s: --from and --to lie in it"
            raise InputError(message, where=self.name, hint=hint)
        zero = float(self.time[keep][0])
        part = {
            name: value[keep] for name in ("state", "control", "acceleration", "voltage", "setpoint", "setpoint_yaw")
            if (value := getattr(self, name)) is not None
        }  # fmt: skip
        seen = (self.pose_time >= zero) & (self.pose_time <= end)
        part |= {"time": self.time[keep] - zero, "pose_time": self.pose_time[seen] - zero, "poses": self.poses[seen]}
        return replace(self, **part)


def check_log(log: FlightLog) -> None:
    """Raise InputError if a flight cannot be recomputed: it is too short, has gaps, or crashed."""
    where = log.name
    if len(log.time) < FEWEST or log.duration < SHORTEST:
        message = f"too short: {len(log.time)} records in {log.duration:.1f} s"
        raise InputError(message, where=where, hint=f"{SHORTEST:g} s of flight are needed")
    if np.median(log.gaps) > 1.0 / _RATE:
        message = f"{1 / np.median(log.gaps):.0f} records a second are too few to follow the controller"
        raise InputError(message, where=where, hint="log 100 records a second or more, best on the microSD card")
    if log.gaps.max() > LONGEST_GAP:
        at = log.time[np.argmax(log.gaps)]
        raise InputError(
            f"no record for {log.gaps.max():.2f} s from {at:.2f} s on",
            where=where,
            hint="log fewer variables, or cut the log there: --from and --to take the part before or behind",
        )
    tilt = np.arccos(np.clip(log.attitude.as_matrix()[:, 2, 2], -1.0, 1.0))
    if tilt.max() > _MAX_TILT:
        at = log.time[np.argmax(tilt > _MAX_TILT)]
        raise InputError(
            f"the vehicle crashed: it tilted by more than {np.degrees(_MAX_TILT):.0f}° at {at:.2f} s",
            where=where,
            hint=f"take the part before: --to {max(at - 0.5, 0.0):.1f}",
        )


def read_microsd(file: Path) -> FlightLog:
    """Read a microSD log with the state estimate and the commands of the Lee controller.

    Raises:
        InputError: the file is not such a log, is damaged, or lacks variables; the hint names those to log.
    """
    if find_importer(file) is not usd_log:
        raise InputError("no microSD log of a Crazyflie", where=str(file), hint="give a log or a record of cfplan")
    table = max((columns for _, columns in usd_log.read_tables(file)[0]), key=lambda columns: len(columns["t"]))
    estimate = _estimate(table)
    if estimate is None:
        raise InputError(
            f"it has no position and velocity: {', '.join(list(table)[1:21]) or 'nothing'}",
            where=str(file),
            hint="log stateEstimateZ.x to .vz with .quat, ctrlLee.rpyx to .rpyz or gyro.x to .z, in the card's config",
        )
    attitude, rates = _attitude(table), _rates(table)
    if attitude is None or rates is None:
        raise InputError(
            "it has no attitude or no body rates", where=str(file),
            hint="log stateEstimateZ.quat and gyro.x to .z, or ctrlLee.rpyx to .rpyz and .omegax to .omegaz",
        )  # fmt: skip
    count, time = len(table["t"]), table["t"] - table["t"][0]
    control = [next((table[f"ctrlLee.{name}"] for name in names if f"ctrlLee.{name}" in table), None)
               for names in _COMMANDS]  # fmt: skip
    asked = [np.full(count, np.nan) if column is None else column for column in control]
    pose_time, poses = _poses(table, time)
    return FlightLog(
        name=file.name,
        time=time,
        state=np.column_stack([estimate, attitude, rates]),
        control=np.column_stack(asked),
        acceleration=_columns(table, "acc", "xyz", GRAVITY),
        voltage=table.get("pm.vbat"),
        setpoint=_columns(table, "ctrltargetZ", ("x", "y", "z", "vx", "vy", "vz"), 1e-3),
        setpoint_yaw=_desired_yaw(table),
        pose_time=pose_time,
        poses=poses,
    )


def _columns(table: Mapping[str, NDArray], group: str, names: str | tuple[str, ...], unit: float = 1) -> NDArray | None:
    keys = [f"{group}.{name}" for name in names]
    return np.column_stack([unit * table[key] for key in keys]) if all(key in table for key in keys) else None


def _estimate(table: Mapping[str, NDArray]) -> NDArray | None:
    names = ("x", "y", "z", "vx", "vy", "vz")
    full = _columns(table, "stateEstimate", names)
    return full if full is not None else _columns(table, "stateEstimateZ", names, 1e-3)


def _attitude(table: Mapping[str, NDArray]) -> NDArray | None:
    for columns in (usd_log.SOURCES["estimate"], usd_log.SOURCES["estimate, compressed"]):
        if all(columns[axis][0] in table for axis in "xyz"):
            found = subject("estimate", table, columns).quaternion
            if np.isfinite(found).all():
                return found
    return None


def _desired_yaw(table: Mapping[str, NDArray]) -> NDArray | None:
    """Return the yaw of the setpoint, (N,) rad: the desired attitude's y axis is across it, whatever its tilt."""
    angles = _columns(table, "ctrlLee", ("rpydz", "rpydy", "rpydx"))
    if angles is None:
        return None
    left = Rotation.from_euler("ZYX", angles).as_matrix()[:, :, 1]
    return np.asarray(np.arctan2(-left[:, 0], left[:, 1]))


def _rates(table: Mapping[str, NDArray]) -> NDArray | None:
    gyro = _columns(table, "gyro", "xyz", np.pi / 180)
    return gyro if gyro is not None else _columns(table, "ctrlLee", ("omegax", "omegay", "omegaz"))


def _poses(table: Mapping[str, NDArray], time: NDArray) -> tuple[NDArray, NDArray]:
    """Return the times at which motion capture's poses changed, and the new poses."""
    poses = _columns(table, "locSrv", ("x", "y", "z", "qx", "qy", "qz", "qw"))
    if poses is None:
        return np.empty(0), np.empty((0, 7))
    new = np.r_[True, (np.diff(poses, axis=0) != 0).any(axis=1)]
    return time[new], poses[new]
