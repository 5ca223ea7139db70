"""Read Vicon Tracker's and Nexus's CSV: sections of frames at a fixed rate, a subject every few columns."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.recording.importers.csv_numbers import place, read_numbers
from cfplan.recording.importers.mocap_log import (
    LoggedSubject,
    MocapLog,
    check_lengths,
    growing,
    quaternions,
    unit_quaternions,
    unknown_rotations,
)  # fmt: skip
from cfplan.recording.importers.vicon_header import Group, Rotations, Section, read_head

FORMAT = "Vicon CSV"
LARGEST_ROOM = 100.0  # m from the origin; beyond it the unit is wrong
_MARK = b"\xef\xbb\xbf"  # of the byte order, as some programs write it first
_BEGIN = re.compile(rb"[\s,;\"]*[A-Za-z][\w ]*\"?[,;\t ]*\r?\n\"?[\d.,]+\"?[,;\t ]*\r?\n")
_FRAME = re.compile(rb"(?m)^\"?frame\"?[,;\t]\"?sub ?frame", re.IGNORECASE)
_LEADING = re.compile(rb"[\s,;]*")
_BLANK = re.compile(rb"\n[ \t,;\r]+(?=\n|\Z)")
_SECTION = re.compile(rb"\n\n+(?=[^\n\d\"-])")  # what begins with a number goes on with the frames before
_HEAD = re.compile(rb"(?:[^\n]*\n?){5}")


def recognises(file: Path, head: bytes) -> bool:
    """Return whether two lines are a section's name and rate, or there are columns Frame and Sub Frame."""
    head = head.removeprefix(_MARK)
    return bool(head) and (_BEGIN.match(head) is not None or _FRAME.search(head) is not None)


def read(file: Path, rotations: Rotations | None = None) -> MocapLog:
    """Read every subject of every section; markers too, as positions without orientation.

    `rotations` says what three angles are where the header does not; the default is helical.

    Raises InputError where a head, a unit or a number is wrong; a last line that is cut off only ends the log.
    """
    data = _BLANK.sub(b"\n", file.read_bytes().removeprefix(_MARK))
    first = _LEADING.match(data).end()  # type: ignore[union-attr]  # it always matches
    begins = [first, *(match.end() for match in _SECTION.finditer(data, first))]
    subjects: dict[str, LoggedSubject] = {}
    sections: list[Section] = []
    notes: list[str] = []
    origin, truncated = None, False
    for begin, end in zip(begins, [*begins[1:], len(data)], strict=True):
        frames = _HEAD.match(data, begin, end).end()  # type: ignore[union-attr]  # it always matches
        lines = data[begin:frames].decode("utf-8", errors="replace").removesuffix("\n").split("\n")
        section = read_head(lines, where=place(data, begin, str(file)), rotations=rotations)
        sections.append(section)
        notes += [f"left out, as it holds no pose: {name}" for name in section.left_out]
        if not section.groups or frames == end:
            continue
        columns = [
            *section.frame_columns,
            *(c for g in section.groups for c in (*g.rotation_columns, *g.position_columns)),
        ]
        values, cut = _frames(data, frames, end, columns, section, file)
        truncated = truncated or cut
        if origin is None:
            origin = next(iter(values[np.isfinite(values[:, 0]), 0]), None)
        time = _times(values[:, : len(section.frame_columns)], origin or 0.0, section.rate)
        keep = growing(time, f"frames of section {section.name}", notes)
        time, values = time[keep], values[keep]
        for group in section.groups:
            if group.name in subjects:
                notes.append(f"{group.name} stands in the file twice; the first is used")
                continue
            turn, there = group.rotation_columns, group.position_columns
            rotation, position = (values[:, [columns.index(c) for c in part]] for part in (turn, there))
            subjects[group.name] = _subject(group, time, rotation, position, file)
    rates = dict.fromkeys(f"{section.rate:g}" for section in sections if section.groups)
    if len(rates) > 1:
        notes.append(f"sections of {' and '.join(rates)} Hz, each with its own times")
    assumed = [group.name for section in sections for group in section.groups if group.assumed]
    if assumed:
        notes.append(f"the header does not say what the angles of {', '.join(assumed)} are: taken as helical")
    if truncated:
        notes.append("the last line is cut off and left out")
    return MocapLog(FORMAT, tuple(subjects.values()), tuple(dict.fromkeys(notes)), truncated)


def _frames(
    data: bytes, begin: int, end: int, columns: list[int], section: Section, file: Path
) -> tuple[NDArray, bool]:
    """Return (frames, columns) of a section, and whether its last line was cut off."""
    first_line = data[begin : data.find(b"\n", begin, end) + 1 or end]
    width = max(first_line.count(section.delimiter.encode()), *columns) + 1
    commas = section.delimiter == ";" and data.count(b",", begin, end) > data.count(b".", begin, end)
    point = "," if commas else "."
    return read_numbers(data, begin, end, columns, width, str(file), delimiter=section.delimiter, point=point)


def _times(frames: NDArray, origin: float, rate: float) -> NDArray:
    """Return (N,) s of frame numbers, or of frames and sub-frames, as columns."""
    sub_frame = np.nan_to_num(frames[:, 1]) if frames.shape[1] > 1 else np.zeros(len(frames))
    with np.errstate(over="ignore", invalid="ignore"):  # absurd numbers do not grow, or make times that none has
        return ((frames[:, 0] - origin) * (1 + sub_frame.max(initial=0.0)) + sub_frame) / rate


def _subject(group: Group, time: NDArray, rotation: NDArray, position: NDArray, file: Path) -> LoggedSubject:
    """Return one subject's poses; a row of zeros alone is an occlusion, as some exports write it."""
    unseen = np.isnan(position).any(axis=1) | (np.c_[rotation, position] == 0).all(axis=1)
    position = np.where(unseen[:, None], np.nan, position * group.position_scale)
    reach = np.max(np.abs(position[~unseen]), initial=0.0)
    if reach > LARGEST_ROOM:
        raise InputError(
            f"{group.name!r} is {reach:.0f} m from the origin",
            where=str(file),
            hint="the unit over its columns is wrong; export it again",
        )
    rotation = np.where(unseen[:, None], np.nan, rotation * group.rotation_scale)
    if group.rotations is Rotations.NONE:
        quaternion = unknown_rotations(len(time))
    elif group.rotations is Rotations.QUATERNION:
        check_lengths(rotation, time, group.name, where=str(file))
        quaternion = unit_quaternions(rotation)
    elif group.rotations is Rotations.EULER:
        # capital letters: each about the axes as the rotations before have turned them
        quaternion = quaternions(rotation, lambda angles: Rotation.from_euler("XYZ", angles))
    else:
        quaternion = quaternions(rotation, Rotation.from_rotvec)
    return LoggedSubject(group.name, time, position, quaternion)
