"""Read Vicon Tracker's and Nexus's CSV: sections of frames at a fixed rate, a subject every few columns."""

import mmap
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.recording.importers.csv_numbers import BLOCK, Lines, is_cut_off, numbers, place
from cfplan.recording.importers.mocap_log import LoggedSubject, MocapLog, ascending, unit_quaternions
from cfplan.recording.importers.vicon_header import Group, Rotations, Section, read_head

FORMAT = "Vicon CSV"
LARGEST_ROOM = 100.0  # m from the origin; beyond it the unit is wrong
_HEAD_LINES = 5
_BEGIN = re.compile(rb"[\s,;\"]*[A-Za-z][\w ]*\"?[,;\t ]*\r?\n\"?[\d.,]+\"?[,;\t ]*\r?\n")
_FRAME = re.compile(rb"(?m)^\"?frame\"?[,;\t]\"?sub ?frame", re.IGNORECASE)
_BLANK = re.compile(rb"\n[ \t,;\r]*\n")
_CONTENT = re.compile(rb"[^\s,;]")


@dataclass(slots=True)
class _Rows:
    """The numbers of one section, as they come."""

    section: Section
    blocks: list[NDArray] = field(default_factory=list)


def recognises(file: Path, head: bytes) -> bool:
    """Return whether two lines are a section's name and rate, or there are columns Frame and Sub Frame."""
    head = head.removeprefix(b"\xef\xbb\xbf")
    return bool(head) and (_BEGIN.match(head) is not None or _FRAME.search(head) is not None)


def read(file: Path, rotations: Rotations | None = None, *, block: int = BLOCK) -> MocapLog:
    """Read every subject of every section; markers too, as positions without orientation.

    `rotations` says what three angles are where the header does not; the default is helical.

    Raises InputError where a head, a unit or a number is wrong; a last line that is cut off only ends the log.
    """
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        reading = _Reading(data, file, rotations, block)
        parts = reading.sections()
        return _log(parts, reading, file)


class _Reading:
    """One pass through a mapped file."""

    def __init__(self, data: mmap.mmap, file: Path, rotations: Rotations | None, block: int):
        self.data, self.file, self.rotations, self.block = data, file, rotations, block
        self.truncated = False

    def sections(self) -> list[_Rows]:
        """Read all sections of the file, in order."""
        parts: list[_Rows] = []
        for begin, end in self._stretches():
            if parts and self.data[begin : begin + 1] in b'0123456789-"':  # a blank line between frames
                self._append(parts[-1], begin, end)
                continue
            lines, frames = self._lines(begin, end)
            section = read_head(lines, where=place(self.data, begin, self.file), rotations=self.rotations)
            parts.append(_Rows(section))
            self._append(parts[-1], frames, end)
        return parts

    def _stretches(self) -> Iterator[tuple[int, int]]:
        """Yield begin and end of each stretch between blank lines."""
        offset = 3 if self.data[:3] == b"\xef\xbb\xbf" else 0
        while (first := _CONTENT.search(self.data, offset)) is not None:
            begin = max(self.data.rfind(b"\n", offset, first.start()) + 1, offset)
            blank = _BLANK.search(self.data, first.start())
            end = blank.start() + 1 if blank else len(self.data)
            yield begin, end
            offset = end

    def _lines(self, begin: int, end: int) -> tuple[list[str], int]:
        """Return the lines of a head and where its frames begin. Most of a line of subjects may be blank."""
        lines: list[str] = []
        while len(lines) < _HEAD_LINES and begin < end:
            after = self.data.find(b"\n", begin, end) + 1 or end
            lines.append(self.data[begin:after].decode("utf-8", errors="replace").rstrip("\r\n"))
            begin = after
        return lines, begin

    def _append(self, rows: _Rows, begin: int, end: int) -> None:
        """Turn the frames from begin to end into numbers, a block at a time."""
        if begin >= end or not rows.section.groups:
            return
        first_line = self.data[begin : self.data.find(b"\n", begin, end) + 1 or end]
        delimiter = rows.section.delimiter
        width = first_line.count(delimiter.encode()) + 1
        point = "," if delimiter == ";" and b"," in first_line else "."
        wanted = _wanted(rows.section)
        if max(wanted) >= width:
            if is_cut_off(self.data, begin, end):
                self.truncated = True
                return
            raise InputError(
                f"{width} cells where the columns are {rows.section.headings}",
                where=place(self.data, begin, self.file),
                hint="export the section again, with all its columns",
            )
        values, cut = numbers(
            self.data, Lines(begin, end, delimiter, width, wanted, point), self.file, block=self.block
        )
        self.truncated = self.truncated or cut
        if len(values):
            rows.blocks.append(values)


def _wanted(section: Section) -> list[int]:
    sub_frame = [] if section.sub_frame_column is None else [section.sub_frame_column]
    return [section.frame_column, *sub_frame, *_columns(section)]


def _columns(section: Section) -> list[int]:
    return [c for group in section.groups for c in (*group.rotation_columns, *group.position_columns)]


def _log(parts: list[_Rows], reading: _Reading, file: Path) -> MocapLog:
    subjects: dict[str, LoggedSubject] = {}
    notes: list[str] = []
    origin: float | None = None
    for part in parts:
        section = part.section
        notes += [f"left out, as it holds no pose: {name}" for name in section.left_out]
        if not part.blocks:
            continue
        values = np.concatenate(part.blocks) if len(part.blocks) > 1 else part.blocks[0]
        frame = values[:, 0]
        if origin is None:
            origin = float(frame[np.isfinite(frame)][0]) if np.isfinite(frame).any() else 0.0
        sub_frame = np.zeros(len(frame)) if section.sub_frame_column is None else np.nan_to_num(values[:, 1])
        with np.errstate(over="ignore", invalid="ignore"):  # absurd numbers do not grow, or make times that none has
            time = ((frame - origin) * (1 + sub_frame.max()) + sub_frame) / section.rate
        keep = ascending(time)
        if not keep.all():
            notes.append(f"{np.sum(~keep)} frames of section {section.name} left out, as their numbers do not grow")
        column = 1 + (section.sub_frame_column is not None)
        for group in section.groups:
            after = column + len(group.rotation_columns) + len(group.position_columns)
            rows = values[:, column:after] if keep.all() else values[keep, column:after]
            if group.name in subjects:
                notes.append(f"{group.name} stands in the file twice; the first is used")
            else:
                subjects[group.name] = _subject(group, time[keep], rows, file)
            column = after
    rates = dict.fromkeys(f"{part.section.rate:g}" for part in parts if part.section.groups)
    if len(rates) > 1:
        notes.append(f"sections of {' and '.join(rates)} Hz, each with its own times")
    assumed = [group.name for part in parts for group in part.section.groups if group.assumed]
    if assumed:
        notes.append(f"the header does not say what the angles of {', '.join(assumed)} are: taken as helical")
    if reading.truncated:
        notes.append("the last line is cut off and left out")
    return MocapLog(FORMAT, tuple(subjects.values()), tuple(dict.fromkeys(notes)), reading.truncated)


def _subject(group: Group, time: NDArray, values: NDArray, file: Path) -> LoggedSubject:
    """Return one subject's poses; a row of zeros alone is an occlusion, as some exports write it."""
    count = len(group.rotation_columns)
    unseen = np.isnan(values[:, count:]).any(axis=1) | (values == 0).all(axis=1)
    position = np.where(unseen[:, None], np.nan, values[:, count:] * group.position_scale)
    reach = np.max(np.abs(position[~unseen]), initial=0.0)
    if reach > LARGEST_ROOM:
        raise InputError(
            f"{group.name!r} is {reach:.0f} m from the origin",
            where=str(file),
            hint="the unit over its columns is wrong; export it again",
        )
    rotation = np.where(unseen[:, None], np.nan, values[:, :count] * group.rotation_scale)
    try:
        quaternion = _quaternion(group.rotations, rotation)
    except ValueError as error:
        row, length = error.args
        raise InputError(
            f"the quaternion of {group.name!r} has length {length:.3g} at {time[row]:.3f} s",
            where=str(file),
            hint="export the rotation again, as a quaternion or as a vector",
        ) from None
    return LoggedSubject(group.name, time, position, quaternion)


def _quaternion(kind: Rotations, rotation: NDArray) -> NDArray:
    """Return (N, 4) from the columns' rotations, NaN where those are NaN."""
    if kind is Rotations.QUATERNION:
        return unit_quaternions(rotation)
    quaternion = np.full((len(rotation), 4), np.nan)
    if kind is not Rotations.NONE:
        known = np.isfinite(rotation).all(axis=1)
        turn = rotation[known]
        # capital letters: each about the axes as the rotations before have turned them
        made = Rotation.from_euler("XYZ", turn) if kind is Rotations.EULER else Rotation.from_rotvec(turn)
        quaternion[known] = made.as_quat()
    return quaternion
