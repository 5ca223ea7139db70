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

from cfplan.errors import InputError
from cfplan.files.text import is_number


class Rotations(StrEnum):
    """How the columns of a subject state its orientation."""

    QUATERNION = "quaternion"  # x y z w
    HELICAL = "helical"  # rotation vector
    EULER = "euler"  # about x, then the turned y, then the turned z, as Vicon's DataStream SDK computes EulerXYZ
    NONE = "none"  # a marker


LENGTHS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
ANGLES = {"rad": 1.0, "deg": math.pi / 180}
# The sections that hold poses or points; the others are forces, joint angles and the like.
READ = ("objects", "segments", "trajectories")
_QUATERNION, _ANGLES, _POSITION, _POINT = (
    ("RX", "RY", "RZ", "RW"), ("RX", "RY", "RZ"), ("TX", "TY", "TZ"), ("X", "Y", "Z"),
)  # fmt: skip
_NAME = re.compile(r"^(?:(?P<frame>global|local)\s+)?angle\s*(?:\((?P<word>[^)]*)\))?\s+(?P<name>.+)$", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Group:
    """The columns of one subject."""

    name: str
    rotations: Rotations
    rotation_columns: tuple[int, ...]
    rotation_scale: float  # to rad
    position_columns: tuple[int, ...]
    position_scale: float  # to m
    assumed: bool  # the header does not say what its angles are


@dataclass(frozen=True, slots=True)
class Section:
    """One head, read."""

    name: str
    rate: float  # Hz, of the rows
    delimiter: str
    frame_column: int
    sub_frame_column: int | None
    groups: tuple[Group, ...]
    left_out: tuple[str, ...]  # names over columns that are neither a pose nor a point
    headings: int  # columns that it names


def read_head(lines: list[str], *, where: str, rotations: Rotations | None) -> Section:
    """Read the five lines of a head. Raises InputError where a line is malformed."""
    name = _first_cell(lines[0])
    rate = _rate(lines[1] if len(lines) > 1 else "", name, where)
    if len(lines) < 4:
        raise InputError(
            f"section {name!r} ends before its columns",
            where=where,
            hint="a section begins with its name, its rate, the subjects and the columns",
        )
    delimiter = max(",;\t", key=lines[3].count)
    try:
        names, headings, units = (_cells(line, delimiter) for line in (lines[2], lines[3], (*lines, "")[4]))
    except csv.Error as error:
        raise InputError(
            f"the head of section {name!r} cannot be read: {error}", where=where, hint="export the section again"
        ) from None
    headings = [heading.upper() for heading in headings]
    if "FRAME" not in headings:
        raise InputError(
            f"section {name!r} has no column Frame",
            where=where,
            hint="the lines of a section are: its name, its rate, the subjects, the columns, the units, then frames",
        )
    groups, left_out = [], []
    if name.lower() in READ:
        starts = [index for index, cell in enumerate(names) if cell]
        if not starts:
            raise InputError(
                f"section {name!r} names no subject above its columns",
                where=where,
                hint="the line above the columns names each subject over its first column",
            )
        for first, after in zip(starts, [*starts[1:], len(headings)], strict=True):
            group = _group(names[first], headings, units, range(first, min(after, len(headings))), where, rotations)
            if group is None:
                left_out.append(names[first])
            else:
                groups.append(group)
    else:
        left_out.append(f"section {name}")
    sub_frame = headings.index("SUB FRAME") if "SUB FRAME" in headings else None
    used = [index for index, heading in enumerate(headings) if heading]
    return Section(
        name, rate, delimiter, headings.index("FRAME"), sub_frame, tuple(groups), tuple(left_out), used[-1] + 1
    )


def _first_cell(line: str) -> str:
    return re.split("[,;\t]", line.strip("\ufeff \t\r\n\"',;"))[0].strip("\"' ")


def _cells(line: str, delimiter: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line.replace("\r", " ")], delimiter=delimiter), [])]


def _rate(line: str, section: str, where: str) -> float:
    text = _first_cell(line)
    try:
        rate = float(text.replace(",", "."))
    except ValueError:
        rate = math.nan
    if not 0 < rate < 1e6:
        raise InputError(
            f"the rate of section {section!r} is {text[:30]!r}, not a number of Hz",
            where=where,
            hint="the line below the name of a section holds its rate alone, as 100",
        )
    return rate


def _group(
    title: str, headings: list[str], units: list[str], columns: range, where: str, rotations: Rotations | None
) -> Group | None:
    """Return the subject under a title; None where it is no pose. Raises InputError where columns are missing."""
    at = {headings[index]: index for index in reversed(columns) if headings[index]}
    match = _NAME.match(title)
    word = (match["word"] or "").lower() if match else ""
    name = _subject(match["name"] if match else title)
    if set(_POINT) <= set(at):
        scale = _unit(units, tuple(at[c] for c in _POINT), LENGTHS, name, where)
        return Group(name, Rotations.NONE, (), 1.0, tuple(at[c] for c in _POINT), scale, False)
    if (match and (match["frame"] or "").lower() == "local") or not set(at) & {*_QUATERNION, *_POSITION}:
        return None
    wanted = _QUATERNION if "RW" in at or word == Rotations.QUATERNION else _ANGLES
    missing = [column for column in (*wanted, *_POSITION) if column not in at]
    if missing:
        raise InputError(
            f"subject {name!r} has no column {', '.join(missing)}",
            where=where,
            hint="export its rotation and its translation, with all their axes",
        )
    turn, place = tuple(at[c] for c in wanted), tuple(at[c] for c in _POSITION)
    length = _unit(units, place, LENGTHS, name, where)
    if wanted is _QUATERNION:
        return Group(name, Rotations.QUATERNION, turn, 1.0, place, length, False)
    stated = Rotations.EULER if "euler" in word else Rotations.HELICAL if "helical" in word else None
    kind = stated or rotations or Rotations.HELICAL
    angle = _unit(units, turn, ANGLES, name, where)
    return Group(name, kind, turn, angle, place, length, assumed=stated is None and rotations is None)


def _subject(name: str) -> str:
    """Return `cf1` for `cf1:cf1`, an object and its only segment; other names as they are."""
    subject, _, segment = name.strip().partition(":")
    return subject if subject == segment else name.strip()


def _unit(units: list[str], columns: tuple[int, ...], known: dict[str, float], name: str, where: str) -> float:
    """Return the factor to SI. Raises InputError unless all the columns have one known unit."""
    found = sorted({units[column].lower().strip("()[] ") if column < len(units) else "" for column in columns})
    if len(found) == 1 and found[0] in known:
        return known[found[0]]
    if any(text == "" or is_number(text) for text in found):
        raise InputError(
            f"no unit over the columns of {name!r}",
            where=where,
            hint=f"the line after the columns' names says {' or '.join(known)} for each",
        )
    raise InputError(
        f"the unit of {name!r} is {', '.join(found)}, not {' or '.join(known)}",
        where=where,
        hint="export it again in one of these",
    )
