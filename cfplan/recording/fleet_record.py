"""The record of a fleet's flight: a folder with a record per vehicle, and fleet.json, which names them.

All vehicles of a fleet are flown by one computer, so their records share its clock. Time 0 is where the first of them
begins its path.
"""

import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.files.atomic import write_atomically
from cfplan.files.json_values import json_value, replace_surrogates
from cfplan.numbers import coordinates
from cfplan.recording.overlay import Trial, trial_of_record
from cfplan.recording.reader import read_record
from cfplan.recording.record import Record
from cfplan.recording.summary import UNKNOWN, reference_span

FLEET_FILE = "fleet.json"
LONGEST_GAP = 0.1  # s between two poses, longest gap bridged by a straight line


@dataclass(frozen=True, slots=True, eq=False)
class PairDistance:
    """The distance between the columns of two vehicles, at each pose of the first."""

    pair: tuple[str, str]
    time: NDArray  # (N,) s from the fleet's start
    distance: NDArray  # (N,) m, horizontal, at any heights; NaN where the second was not seen
    place: NDArray  # (N, 2) m, x and y, in the middle between them

    @property
    def nearest(self) -> int | None:
        """Return the row of the nearest approach; None where they never were seen together."""
        return int(np.nanargmin(self.distance)) if np.isfinite(self.distance).any() else None

    def to_json(self) -> dict[str, Any]:
        """Return the nearest approach for JSON: distance, place and time; null where it is not known."""
        row = self.nearest
        known = {} if row is None else json_value(
            {"distance": self.distance[row], "place": self.place[row], "time": self.time[row]}
        )  # fmt: skip
        return {"pair": list(self.pair), "distance": None, "place": None, "time": None} | known


@dataclass(frozen=True, slots=True, eq=False)
class FleetRecord:
    """The records of vehicles that flew together."""

    name: str
    apart: float  # m, at least, between the columns of any two vehicles, as planned
    records: Mapping[str, Record]  # by the names of the vehicles, at least one
    notes: tuple[str, ...]  # records that are missing or end early, one sentence each

    @property
    def start(self) -> float:
        """Return when the first vehicle began its path, s on the clock of the records; else when recording began."""
        begins = [reference_span(record)[0] for record in self.records.values()]
        known = [begin for begin in begins if math.isfinite(begin)]
        return min(known or [record.start for record in self.records.values()])

    @property
    def trials(self) -> tuple[Trial, ...]:
        """Return the flights with their references, at times from the fleet's start."""
        return tuple(_trial(name, record, self.start) for name, record in self.records.items())

    def pairs(self) -> tuple[PairDistance, ...]:
        """Return the distance of each pair over time."""
        return tuple(_pair(a, b) for a, b in itertools.combinations(self.trials, 2))

    def to_json(self) -> dict[str, Any]:
        """Return the nearest approach of each pair, and the notes, for JSON."""
        pairs = [pair.to_json() for pair in self.pairs()]
        return {"fleet": self.name, "apart": self.apart, "pairs": pairs, "missing": list(self.notes)}

    def pair_rows(self) -> list[tuple[str, ...]]:
        """Return a row of text per pair, the nearest first: names, least distance, planned distance, time, place."""
        rows: list[tuple[str, ...]] = []
        for pair in sorted(self.pairs(), key=lambda each: np.fmin.reduce(each.distance, initial=np.inf)):
            row, names = pair.nearest, " – ".join(pair.pair)
            if row is None:
                rows.append((names, UNKNOWN, f"{self.apart:.3f} m", UNKNOWN, UNKNOWN))
                continue
            x, y = pair.place[row]
            near = f"{pair.distance[row]:.3f} m", f"{self.apart:.3f} m", f"{pair.time[row]:.2f} s"
            rows.append((names, *near, coordinates((x, y), ".2f")))
        return rows


def distances_to_others(trials: tuple[Trial, ...]) -> list[NDArray]:
    """Return the distance to the nearest other at each pose of each trial, (N,) m; NaN where none was seen."""
    found = []
    for trial in trials:
        others = [_pair(trial, other).distance for other in trials if other is not trial]
        found.append(np.fmin.reduce(others) if others else np.full(len(trial.time), np.nan))
    return found


def write_fleet_file(folder: Path, name: str, apart: float, vehicles: Mapping[str, Path]) -> None:
    """Write fleet.json; `vehicles` are the folders of the records, inside this one. Raises InputError if it cannot."""
    content = {"name": name, "apart": apart, "vehicles": {each: place.name for each, place in vehicles.items()}}
    write_atomically(folder / FLEET_FILE, (json.dumps(content, indent=2) + "\n").encode())


def is_fleet_record(place: Path) -> bool:
    """Return whether a folder is the record of a fleet."""
    return (place / FLEET_FILE).is_file()


def read_fleet_record(folder: Path) -> FleetRecord:
    """Read the records of a fleet; those that are missing or cannot be read are named in `notes`.

    Raises InputError where fleet.json is damaged, or no record can be read.
    """
    name, apart, places = _read_fleet_file(folder / FLEET_FILE)
    records, notes = {}, []
    for vehicle, place in places.items():
        try:
            record = records[vehicle] = read_record(folder / place)
        except InputError as error:
            notes.append(f"The record of {vehicle} is missing: {error.what} ({error.where}).")
            continue
        if record.truncated:
            notes.append(f"The record of {vehicle} ends early: data after its last complete chunk is lost.")
    if not records:
        raise InputError(
            f"no record of the fleet can be read: {notes[0]}" if notes else "the fleet has no vehicles",
            where=str(folder),
            hint="copy the whole folder of the flight, with a folder per vehicle",
        )
    return FleetRecord(name, apart, records, tuple(notes))


def _read_fleet_file(file: Path) -> tuple[str, float, dict[str, str]]:
    """Return name, `apart`, and the folder of each vehicle's record by its name."""
    try:
        content = replace_surrogates(json.loads(file.read_text(encoding="utf-8")))
        places = {str(name): Path(str(place)).name for name, place in content["vehicles"].items()}
        name, apart = str(content["name"]), float(content["apart"])
        if not 0.0 < apart < 100.0:
            raise ValueError(f"apart is {apart:g} m")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"the fleet's file cannot be read ({type(error).__name__}: {error})".replace("\n", " "),
            where=str(file),
            hint="name the folder of one vehicle's record instead",
        ) from error
    return name, apart, places


def _trial(name: str, record: Record, start: float) -> Trial:
    """Return a record as a trial whose time 0 is at `start`, s on its clock."""
    begin, _ = reference_span(record)
    later = (begin if math.isfinite(begin) else record.start) - start
    trial = trial_of_record(record, name)
    reference = trial.reference and replace(trial.reference, name=name, time=trial.reference.time + later)
    return replace(trial, time=trial.time + later, reference=reference)


def _pair(a: Trial, b: Trial) -> PairDistance:
    of_a, of_b = a.position[:, :2], _columns_at(b, a.time)
    distance = np.linalg.norm(of_a - of_b, axis=1)
    return PairDistance((a.name, b.name), a.time, distance, 0.5 * (of_a + of_b))


def _columns_at(trial: Trial, times: NDArray) -> NDArray:
    """Return x and y at each of the times, straight between poses, (N, 2) m; NaN in gaps."""
    seen = np.isfinite(trial.position).all(axis=1)
    time, position = trial.time[seen], trial.position[seen, :2]
    if len(time) < 2:
        return np.full((len(times), 2), np.nan)
    after = np.clip(np.searchsorted(time, times), 1, len(time) - 1)
    unseen = (times < time[0]) | (times > time[-1]) | (time[after] - time[after - 1] > LONGEST_GAP)
    found = np.stack([np.interp(times, time, axis) for axis in position.T], axis=1)
    return np.where(unseen[:, None], np.nan, found)
