"""Earlier flights of a plan: their deviations, and the correction of the part that repeats.

Shifting a trajectory moves the vehicle by the same shift: in the dry run to within a tenth, for changes over 0.5 s or
more. So the deviation from the commanded trajectory is the same with a correction as without, and the best correction
is the negative mean deviation over all flights. Deviations that do not repeat average out, and each further flight
changes the correction less.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.geometry.path_file import fingerprint
from cfplan.planning.plan_file import load_plan
from cfplan.planning.plan_result import Plan
from cfplan.recording.header import FINGERPRINT, FLOWN
from cfplan.recording.reader import read_record
from cfplan.recording.record import PLAN_FILE, UNCORRECTED_FILE, Record
from cfplan.recording.summary import finished, reference_span
from cfplan.safety.limits import Limits
from cfplan.vehicle.correction import PlanCorrection, fit_correction
from cfplan.vehicle.trajectory import Trajectory

SPACING = 0.25  # s between knots of a correction, which has a bandwidth of 2 Hz (see docs/flying.md)
LARGEST = 0.2  # m; a vehicle with a larger deviation does not match its airframe
# s of hover after the end that count as flight, about as long as the pilot holds it. The shift at the end also applies
# there, while a vehicle that lagged by 4 cm arrives within half a second and would be displaced by all of it.
HOVER = 1.25
_MIN_FLIGHTS = 3  # flights needed to separate repeated deviation from chance
_CHANCE = 2.0  # times the variance expected by chance; a larger one repeats
_FLOWN_HINT = "name records of flights that flew the whole plan and landed"


@dataclass(frozen=True, slots=True, eq=False)
class EarlierFlight:
    """One flight of a plan."""

    where: str  # its record, for errors
    planned: Trajectory  # the plan without correction
    asked: Trajectory  # the commanded trajectory, with or without correction; with the same s
    times: NDArray  # (N,) s from the start, ascending, to HOVER after the end
    position: NDArray  # (N, 3) m, measured


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """The result of learning from earlier flights of a plan."""

    correction: PlanCorrection
    shift: float  # m, its largest value
    before: float  # m, largest distance from the plan in the last flight
    expected: float  # m, the same with the correction, mean over the flights
    unrepeated: float  # m rms, difference of a flight from the others; NaN for one flight
    exhausted: bool  # whether the deviation of the last flight does not repeat

    def describe(self) -> str:
        """Return it in one line."""
        text = (
            f"{100 * self.before:.1f} cm largest deviation in the last, {100 * self.expected:.1f} cm expected with a "
            f"correction of {100 * self.shift:.1f} cm at most"
        )
        if np.isfinite(self.unrepeated):
            text += f"; {100 * self.unrepeated:.1f} cm rms does not repeat"
        return text + (", which is all that is left" if self.exhausted else "")


def learn_correction(flights: Sequence[EarlierFlight]) -> Learned:
    """Return the correction of a plan from flights of it, the last one last.

    Raises InputError with the record where poses are missing, or the vehicle strayed by more than LARGEST.
    """
    duration, count = flights[0].planned.duration, len(flights)
    seen = [_deviation(flight) for flight in flights]
    each = [fit_correction(one.time, one.off, duration, SPACING) for one in seen]
    mean = np.mean([one.coefficients for one in each], axis=0)
    correction, last = PlanCorrection(-mean, duration), seen[-1]

    even = np.linspace(0.0, duration, max(round(duration / SPACING), 2) * 4)
    differing = [_rms(PlanCorrection(one.coefficients - mean, duration).at(even)[:, 0]) for one in each]
    variance = float(np.sum(np.square(differing))) / (count - 1) if count > 1 else np.nan
    left = _rms(each[-1].at(last.time)[:, 0] + last.shift)  # from the plan, as far as it can be learned
    return Learned(
        correction,
        shift=_largest(correction.at(even)[:, 0]),
        before=_largest(last.off + last.shift),
        expected=float(np.mean([_largest(one.off + correction.at(one.time)[:, 0]) for one in seen])),
        unrepeated=float(np.sqrt(variance)),
        exhausted=bool(count >= _MIN_FLIGHTS and left**2 <= _CHANCE * variance * count / (count - 1)),
    )


class _Deviation(NamedTuple):
    """The deviation of a vehicle in one flight."""

    time: NDArray  # (N,) s, when the plan is where the vehicle was wanted
    off: NDArray  # (N, 3) m, from the commanded trajectory
    shift: NDArray  # (N, 3) m, of the commanded trajectory from the plan


def _deviation(flight: EarlierFlight) -> _Deviation:
    """Return the deviation of a flight. Raises InputError like learn_correction()."""
    end = flight.asked.duration + HOVER
    known = np.isfinite(flight.position).all(axis=1) & (flight.times >= 0.0) & (flight.times <= end)
    times = flight.times[known]
    ends = np.concatenate([[0.0], times, [end]])
    longest = int(np.diff(ends).argmax())
    if ends[longest + 1] - ends[longest] > SPACING:
        raise InputError(
            f"no poses for {ends[longest + 1] - ends[longest]:.2f} s from {ends[longest]:.2f} s of the plan on",
            where=flight.where, hint="leave this record out",
        )  # fmt: skip
    s = flight.asked.s_at(times)
    asked = flight.asked.path(s)
    off = flight.position[known] - asked
    far = np.linalg.norm(off, axis=1)
    if far.max() > LARGEST:
        raise InputError(
            f"the vehicle strayed by {far.max():.2f} m at {times[far.argmax()]:.2f} s; at most {LARGEST:.2f} m are "
            "corrected",
            where=flight.where, hint="fly flights/identify.yaml and `cfplan identify` its record, or fly slower",
        )  # fmt: skip
    return _Deviation(flight.planned.time_at(s), off, asked - flight.planned.path(s))


def _largest(off: NDArray) -> float:
    return float(np.linalg.norm(off, axis=1).max())


def _rms(off: NDArray) -> float:
    return float(np.sqrt(np.square(off).sum(axis=1).mean()))


@dataclass(frozen=True, slots=True, eq=False)
class EarlierFlights:
    """Records of flights of one plan, which can be flown again."""

    name: str
    plan_file: Path  # file of the uncorrected plan
    flights: tuple[EarlierFlight, ...]
    uri: str  # of the vehicle in the last flight


def earlier_flights(folders: Sequence[Path], path_or_plan: Path, limits: Limits, *, on_board: bool) -> EarlierFlights:
    """Read records of flights of a path file or plan file under these limits, the last one last.

    Raises InputError where a record is not a complete flight, or airframe, limits, room or plan differ from today's.
    """
    read = [_read(Path(folder), limits, on_board) for folder in folders]
    record, file, plan = read[-1][:3]
    for other, _, its_plan, _ in read:
        if not _same_motion(its_plan, plan):
            raise InputError(
                "its plan differs from that of the other records", where=str(other.folder),
                hint="name records of flights of one plan: the first flight, and those flown --after it",
            )  # fmt: skip
    _check_source(path_or_plan, record, file, plan)
    return EarlierFlights(record.header.name, file, tuple(flight for *_, flight in read), record.header.uri)


def _read(folder: Path, limits: Limits, on_board: bool) -> tuple[Record, Path, Plan, EarlierFlight]:
    """Return a record, the file of its uncorrected plan, that plan, and the flight."""
    record = read_record(folder)
    where = str(record.folder)
    if len(record.commitments.time):
        raise InputError("its plan was changed in the air", where=where, hint="name flights of a path or a plan file")
    if not finished(record):
        raise InputError("its plan was not flown to the end", where=where, hint=_FLOWN_HINT)
    if (FLOWN in record.header.provenance) is not on_board:
        how = (
            ("streamed", "omit --on-board: it is for records of flights on board")
            if on_board
            else ("on board", "add --on-board")
        )
        raise InputError(f"it was flown {how[0]}", where=where, hint=how[1])
    asked = load_plan(record.folder / PLAN_FILE)
    corrected = record.folder / UNCORRECTED_FILE
    file = corrected if corrected.is_file() else record.folder / PLAN_FILE
    plan = load_plan(file) if file == corrected else asked
    _check_limits(plan.limits, limits, where)
    times = record.poses.time - reference_span(record)[0]
    order = np.argsort(times, kind="stable")
    flight = EarlierFlight(where, plan.trajectory, asked.trajectory, times[order], record.poses.position[order])
    return record, file, plan, flight


def _check_limits(then: Limits, now: Limits, where: str) -> None:
    """Raise InputError if limits or vehicle of a plan have changed."""
    for what, before, today in (
        ("the airframe", then.airframe, now.airframe),
        ("the limits of plans", then.plan, now.plan),
        ("the room", then.space, now.space),
    ):
        if before != today:
            raise InputError(
                f"{what} in safety.yaml changed since this flight", where=where,
                hint="fly once without --after, and name that record",
            )  # fmt: skip


def _check_source(path_or_plan: Path, record: Record, file: Path, plan: Plan) -> None:
    """Raise InputError if the path file or plan file is not the one that was flown."""
    if path_or_plan.suffix == file.suffix:
        same = _same_motion(load_plan(path_or_plan), plan)
    else:
        same = record.header.provenance.get(FINGERPRINT) == fingerprint(path_or_plan)
    if not same:
        raise InputError(
            f"does not match the plan flown in {record.folder}", where=str(path_or_plan),
            hint=f"to fly the plan of that flight again, name {file}",
        )  # fmt: skip


def _same_motion(first: Plan, second: Plan) -> bool:
    a, b = first.trajectory, second.trajectory
    columns = ((a.path.breaks, b.path.breaks), (a.path.coefficients, b.path.coefficients), (a.profile.h, b.profile.h),
               (a.profile.yaw, b.profile.yaw))  # fmt: skip
    return all(np.array_equal(*each) for each in columns)
