"""Read the CSV of Vicon Tracker and Nexus: sections of frames at a fixed rate, a few columns per subject."""

import re
from itertools import pairwise
from pathlib import Path

import numpy as np

from cfplan.errors import InputError
from cfplan.recording.importers.csv_numbers import decimal_point, line_at, read_numbers
from cfplan.recording.importers.mocap_log import LoggedSubject, MocapLog, Table, in_order, subject, without_zeros
from cfplan.recording.importers.vicon_header import Group, Rotations, Section, read_head

FORMAT = "Vicon CSV"
LARGEST_ROOM = 100.0  # m from the origin; beyond it the unit is wrong
_MARK = b"\xef\xbb\xbf"  # byte order mark, which some programs write first
HEAD = re.compile(  # a section's name and its rate, or in some line the columns Frame and Sub Frame
    rb"(?:\xef\xbb\xbf)?(?:[\s,;\"]*[A-Za-z][\w ]*\"?[,;\t ]*\r?\n\"?[\d.,]+\"?[,;\t ]*\r?\n"
    rb"|(?s:.*\n|)(?i:\"?frame\"?[,;\t]\"?sub ?frame))"
)
_BLANK = re.compile(rb"\n[ \t,;\r]+(?=\n|\Z)")
_LEADING = re.compile(rb"[\s,;]*")
_SECTION = re.compile(rb"\n\n+(?=[^\n\d\"-])")  # a line that begins with a number continues the frames before
_FIVE_LINES = re.compile(rb"(?:[^\n]*\n?){5}")


def read(file: Path, rotations: Rotations | None = None) -> MocapLog:
    """Read every subject of every section; markers too, as positions without orientation.

    `rotations` is the kind of three angles if the header does not say; the default is helical.

    Raises InputError if a head, a unit or a number is wrong; a last line that is cut off only ends the log.
    """
    data = _BLANK.sub(b"\n", file.read_bytes().removeprefix(_MARK))
    subjects: dict[str, LoggedSubject] = {}
    notes: list[str] = []
    rates: dict[str, None] = {}
    assumed: list[str] = []
    origin, truncated = None, False
    first = _matched(_LEADING, data, 0, len(data)).end()
    for begin, end in pairwise([first, *(match.end() for match in _SECTION.finditer(data, first)), len(data)]):
        head = _matched(_FIVE_LINES, data, begin, end)
        lines = head[0].decode("utf-8", errors="replace").removesuffix("\n").split("\n")
        section = read_head(lines, where=f"{file}:{line_at(data, begin)}", rotations=rotations)
        notes += [f"left out, as it holds no pose: {name}" for name in section.left_out]
        assumed += [group.name for group in section.groups if group.assumed]
        if section.groups:
            rates[f"{section.rate:g}"] = None
        if not section.groups or head.end() == end:
            continue
        table, cut = _frames(data, head.end(), end, section, str(file))
        truncated = truncated or cut
        frame, *sub_frame = (table[column] for column in section.frame_columns)
        if origin is None:
            origin = next(iter(frame[np.isfinite(frame)]), None)
        part = np.nan_to_num(sub_frame[0]) if sub_frame else np.zeros(len(frame))
        with np.errstate(over="ignore", invalid="ignore"):  # absurd numbers do not increase, or overflow
            time = ((frame - (origin or 0.0)) * (1 + part.max(initial=0.0)) + part) / section.rate
        table = in_order({**table, "t": time}, f"frames of section {section.name}", notes)
        for group in section.groups:
            if group.name in subjects:
                notes.append(f"{group.name} occurs twice in the file; the first is used")
            else:
                subjects[group.name] = _subject(group, table, str(file))
    if len(rates) > 1:
        notes.append(f"sections of {' and '.join(rates)} Hz, each with its own times")
    if assumed:
        notes.append(f"the header does not say what the angles of {', '.join(assumed)} are: taken as helical")
    if truncated:
        notes.append("the last line is cut off and left out")
    return MocapLog(FORMAT, tuple(subjects.values()), tuple(dict.fromkeys(notes)), truncated)


def _frames(data: bytes, begin: int, end: int, section: Section, where: str) -> tuple[Table, bool]:
    """Return the columns of a section, and whether its last line was cut off."""
    poses = sorted(column for group in section.groups for column, _ in group.columns.values())
    columns = [*section.frame_columns, *poses]
    first_line = data[begin : data.find(b"\n", begin, end) + 1 or end]
    width = max(first_line.count(section.delimiter.encode()), *columns) + 1
    point = decimal_point(data, begin, end, section.delimiter)
    return read_numbers(data, begin, end, columns, width, where, delimiter=section.delimiter, point=point)


def _subject(group: Group, table: Table, where: str) -> LoggedSubject:
    """Return one subject's poses; a row of zeros is an occlusion, as some exports write it."""
    found = subject(group.name, without_zeros(table, group.columns), group.columns, where=where)
    reach = np.nanmax(np.abs(found.position), initial=0.0)
    if reach > LARGEST_ROOM:
        raise InputError(
            f"{group.name!r} is {reach:.0f} m from the origin",
            where=where,
            hint="the unit over its columns is wrong; export it again",
        )
    return found


def _matched(pattern: re.Pattern[bytes], data: bytes, begin: int, end: int) -> re.Match[bytes]:
    """Return the match of a pattern that matches anything."""
    match = pattern.match(data, begin, end)
    assert match is not None
    return match
