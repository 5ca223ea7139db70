"""Read the head of one section of a Vicon CSV: which columns hold which subject, in which unit.

Objects                                                          section
100                                                              rate, Hz
,,Global Angle (Quaternion) cf1:cf1,,,,,,,gate:gate,,,,,,        subject:segment over its first column
Frame,Sub Frame,RX,RY,RZ,RW,TX,TY,TZ,RX,RY,RZ,TX,TY,TZ           columns
,,,,,,mm,mm,mm,deg,deg,deg,mm,mm,mm                              units
"""

import csv
import math
import re
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

from cfplan.errors import InputError
from cfplan.files.text import is_number
from cfplan.recording.importers.mocap_log import EULER_XYZ, PLACE, QUATERNION, ROTATION_VECTOR


class Rotations(StrEnum):
    """How the columns of a subject state its orientation."""

    QUATERNION = "quaternion"  # x y z w
    HELICAL = "helical"  # rotation vector
    EULER = "euler"  # about x, then the turned y, then the turned z, as Vicon's DataStream SDK computes EulerXYZ
    NONE = "none"  # a marker


LENGTHS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
ANGLES = {"rad": 1.0, "deg": math.pi / 180}
_TRANSLATION = (PLACE, ("TX", "TY", "TZ"), LENGTHS)
COLUMNS: dict[Rotations, tuple[tuple[tuple[str, ...], tuple[str, ...], dict[str, float]], ...]] = {
    # kind: channels, their columns and units; the position first
    Rotations.QUATERNION: (_TRANSLATION, (QUATERNION, ("RX", "RY", "RZ", "RW"), {})),
    Rotations.HELICAL: (_TRANSLATION, (ROTATION_VECTOR, ("RX", "RY", "RZ"), ANGLES)),
    Rotations.EULER: (_TRANSLATION, (EULER_XYZ, ("RX", "RY", "RZ"), ANGLES)),
    Rotations.NONE: ((PLACE, ("X", "Y", "Z"), LENGTHS),),
}
# The sections that hold poses or points; the others are forces, joint angles and the like.
READ = ("objects", "segments", "trajectories")
_NAME = re.compile(r"^(?:(?P<frame>global|local)\s+)?angle\s*(?:\((?P<word>[^)]*)\))?\s+(?P<name>.+)$", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Group:
    """The columns of one subject."""

    name: str
    columns: dict[str, tuple[int, float]]  # channel, position first: its column, and the factor to SI units
    assumed: bool  # the header does not say what its angles are


@dataclass(frozen=True, slots=True)
class Section:
    """The content of one section's head."""

    name: str
    rate: float  # Hz, of the rows
    delimiter: str
    frame_columns: tuple[int, ...]  # of Frame and, if there, Sub Frame
    groups: tuple[Group, ...]
    left_out: tuple[str, ...]  # names over columns that are neither a pose nor a point


def read_head(lines: list[str], *, where: str, rotations: Rotations | None) -> Section:
    """Read the five lines of a head. Raises InputError if a line is malformed."""
    name = _first_cell(lines[0])
    rate = _rate(lines[1] if len(lines) > 1 else "", name, where)
    if len(lines) < 4:
        hint = "a section begins with its name, its rate, the subjects and the columns"
        raise InputError(f"section {name!r} ends before its columns", where=where, hint=hint)
    delimiter = max(",;\t", key=lines[3].count)
    try:
        titles, headings, units = (_cells(line, delimiter) for line in (lines[2], lines[3].upper(), (*lines, "")[4]))
    except csv.Error as error:
        message = f"the head of section {name!r} cannot be read: {error}"
        raise InputError(message, where=where, hint="export the section again") from None
    if "FRAME" not in headings:
        hint = "the lines of a section are: its name, its rate, the subjects, the columns, the units, then frames"
        raise InputError(f"section {name!r} has no column Frame", where=where, hint=hint)
    frame_columns = tuple(headings.index(heading) for heading in ("FRAME", "SUB FRAME") if heading in headings)
    if name.lower() not in READ:
        return Section(name, rate, delimiter, frame_columns, (), (f"section {name}",))
    starts = [index for index, cell in enumerate(titles) if cell]
    if not starts:
        hint = "the line above the columns names each subject over its first column"
        raise InputError(f"section {name!r} names no subject above its columns", where=where, hint=hint)
    groups, left_out = [], []
    for first, after in pairwise([*starts, len(headings)]):
        columns = {headings[index]: index for index in reversed(range(first, min(after, len(headings))))}
        group = _group(titles[first], columns, units, where, rotations)
        if group is None:
            left_out.append(titles[first])
        else:
            groups.append(group)
    return Section(name, rate, delimiter, frame_columns, tuple(groups), tuple(left_out))


def _first_cell(line: str) -> str:
    return re.split("[,;\t]", line.strip("\ufeff \t\r\n\"',;"))[0].strip("\"' ")


def _cells(line: str, delimiter: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line.replace("\r", " ")], delimiter=delimiter), [])]


def _rate(line: str, section: str, where: str) -> float:
    text = _first_cell(line)
    rate = float(text) if is_number(text) else math.nan
    if not 0 < rate < 1e6:
        message = f"the rate of section {section!r} is {text[:30]!r}, not a number of Hz"
        hint = "the line below the name of a section holds its rate alone, as 100"
        raise InputError(message, where=where, hint=hint)
    return rate


def _group(
    title: str, headings: dict[str, int], units: list[str], where: str, rotations: Rotations | None
) -> Group | None:
    """Return the subject under a title, or None if it is not a pose. Raises InputError if columns are missing."""
    match = _NAME.match(title)
    frame, word, name = (match[key] or "" for key in ("frame", "word", "name")) if match else ("", "", title)
    parent, _, segment = name.strip().partition(":")
    name = parent if parent == segment else name.strip()  # an object and its only segment
    stated = next((kind for kind in (Rotations.EULER, Rotations.HELICAL) if kind in word.lower()), None)
    if {"X", "Y", "Z"} <= set(headings):
        kind = Rotations.NONE
    elif frame.lower() == "local" or not set(headings) & {"RX", "RY", "RZ", "RW", "TX", "TY", "TZ"}:
        return None
    elif "RW" in headings or word.lower() == Rotations.QUATERNION:
        kind = Rotations.QUATERNION
    else:
        kind = stated or rotations or Rotations.HELICAL
    missing = [heading for _, listed, _ in COLUMNS[kind] for heading in listed if heading not in headings]
    if missing:
        message = f"subject {name!r} has no column {', '.join(missing)}"
        raise InputError(message, where=where, hint="export its rotation and its translation, with all their axes")
    columns: dict[str, tuple[int, float]] = {}
    for channels, listed, known in COLUMNS[kind]:
        found = [headings[heading] for heading in listed]
        unit = _unit([units[column] if column < len(units) else "" for column in found], known, name, where)
        columns |= {channel: (column, unit) for channel, column in zip(channels, found, strict=True)}
    assumed = kind in (Rotations.EULER, Rotations.HELICAL) and stated is None and rotations is None
    return Group(name, columns, assumed)


def _unit(units: list[str], known: dict[str, float], name: str, where: str) -> float:
    """Return the factor to SI, 1 if no unit is known. Raises InputError unless all columns have one known unit."""
    found = sorted({unit.lower().strip("()[] ") for unit in units})
    if not known or (len(found) == 1 and found[0] in known):
        return known.get(found[0], 1.0)
    if any(text == "" or is_number(text) for text in found):
        hint = f"the line after the columns' names says {' or '.join(known)} for each"
        raise InputError(f"no unit over the columns of {name!r}", where=where, hint=hint)
    message = f"the unit of {name!r} is {', '.join(found)}, not {' or '.join(known)}"
    raise InputError(message, where=where, hint="export it again in one of these")
