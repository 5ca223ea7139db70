"""Read text and tables of numbers from files that people write."""

import io
import math
import os
import pathlib
import re
import select
import stat
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError

MAX_FILE_SIZE = 4_000_000  # bytes; a path or a set of limits is a few kilobytes
MAX_NUMBER = 1e6  # metres, seconds or coefficients: a larger number is a slip and would cost digits
TIMES = ("t", "time", "timestamp")  # possible names of the time column
_MAX_UNIX_TIME = 1e10  # s since 1970: beyond this a time is in other units
PIPE_PATIENCE = 5.0  # s without a byte
DECIMAL_COMMA_HINT = "write decimals with a point, as 1.5, and the same separator between all numbers"
UNITS = {  # in SI
    "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "ns": 1e-9,
    "m": 1.0, "cm": 1e-2, "mm": 1e-3, "meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3,
}  # fmt: skip
_UNIT = re.compile(r"\s*\[\s*([^\]]*?)\s*\]")  # after a name
_SEPARATOR = re.compile(r"\s*[,;]\s*|\s+")


def read_text(file: pathlib.Path, *, most: int = MAX_FILE_SIZE) -> str:
    """Read the text of a file of at most `most` bytes.

    Raises:
        InputError: missing, not a file, not readable, too large, empty, not UTF-8 text.
    """
    try:
        if file.is_dir():
            raise InputError("a folder, not a file", where=str(file), hint="name the file in it")
        content = _content(file, most)
    except FileNotFoundError:
        raise InputError(
            "no such file",
            where=str(file),
            hint="check the name; it is relative to the working folder, or to the folder of the path file",
        ) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot be read: {reason}", where=str(file), hint="check its permissions") from None
    if len(content) > most:
        size = f"{most // 1_000_000} MB" if most >= 1_000_000 else f"{most // 1000} kB"
        raise InputError(f"larger than {size}", where=str(file), hint="give fewer points, or those of a path as a CSV")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError("not UTF-8 text", where=f"{file}:{line}", hint="save the file as UTF-8") from None
    if not text.strip():
        raise InputError("the file is empty", where=str(file), hint="check that it is the right file")
    return text


def _content(file: pathlib.Path, most: int) -> bytes:
    """Return at most `most` + 1 bytes of a file, or of a pipe."""
    with open(os.open(file, os.O_RDONLY | os.O_NONBLOCK), "rb", buffering=0) as stream:
        if stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
            return io.BufferedReader(stream).read(most + 1)
        content = b""
        while len(content) <= most:
            if not select.select([stream], [], [], PIPE_PATIENCE)[0]:
                raise InputError(
                    f"a pipe or device that gave nothing for {PIPE_PATIENCE:g} s",
                    where=str(file),
                    hint="name a file, or write to the pipe first",
                )
            more = stream.read(1 << 16)
            if not more:
                break
            content += more
    return content


def read_table(file: pathlib.Path, columns: int, what: str) -> tuple[NDArray, list[int]]:
    """Read rows of `columns` numbers separated by commas, semicolons or blanks, and the line number of each.

    Blank lines, lines that start with # and one header line are skipped. `what` describes a row in error messages.

    Raises:
        InputError: a row of another length, commas that may be decimal ones, or a number that is not finite, with its
            line; no rows.
    """
    _, lines = _split(file, what)
    rows = [_numbers(cells, range(columns), columns, what, f"{file}:{number}") for number, cells in lines]
    return np.array(rows), [number for number, _ in lines]


def read_named_table(
    file: pathlib.Path, names: Sequence[str], what: str, *, more: str = ""
) -> tuple[NDArray, list[int], list[str]]:
    """Read the columns `names`; return the rows in SI units, the line number of each, and the names of other columns.

    A first line that names all of them, in any case, gives their order and, as in `x [mm]`, their units. Without such a
    line the file has these columns alone, in this order; one more, called `more`, may follow. `t` is a time, which may
    count from 1970; a header with a time is used only if `names` has `t`.

    Raises:
        InputError: as read_table(); an unknown unit.
    """
    header, lines = _split(file, what)
    heads = [cell.strip("\"'").lower().partition("[") for cell in header]
    found = ["t" if name in TIMES else name for name, _, _ in heads]
    units = [unit.rstrip("]") for _, _, unit in heads]
    if not set(names) <= set(found) or ("t" in found) != ("t" in names):
        found = [*names, more] if more and len(lines[0][1]) == len(names) + 1 and lines[0][1][-1] else [*names]
        units = [""] * len(found)
    columns = [found.index(name) for name in names]
    if unknown := [units[column] for column in columns if units[column] and units[column] not in UNITS]:
        raise InputError(f"the unit {unknown[0]!r} is unknown", where=str(file), hint=f"known: {', '.join(UNITS)}")
    most = _MAX_UNIX_TIME if names[0] == "t" else MAX_NUMBER
    rows = [_numbers(cells, columns, len(found), what, f"{file}:{number}", first=most) for number, cells in lines]
    others = [name for column, name in enumerate(found) if column not in columns and name]
    return (
        np.array(rows) * [UNITS.get(units[column], 1.0) for column in columns],
        [number for number, _ in lines],
        others,
    )


def _split(file: pathlib.Path, what: str) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the cells of the header, none if there is no header, and the line number and cells of each row."""
    header: list[str] = []
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(read_text(file).splitlines(), start=1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        cells = _SEPARATOR.split(text)
        if not header and not rows and "[" in text:  # units
            cells = _SEPARATOR.split(_UNIT.sub(r"[\1]", text))
        if not header and not rows and not any(is_number(cell) for cell in cells):
            header = cells
            continue
        if may_have_decimal_commas(text):
            raise InputError(
                f"decimal commas, or two kinds of separators: {text[:40]!r}",
                where=f"{file}:{number}",
                hint=DECIMAL_COMMA_HINT,
            )
        rows.append((number, cells))
    if not rows:
        raise InputError("no rows of numbers", where=str(file), hint=f"each row is {what}")
    return header, rows


def may_have_decimal_commas(text: str) -> bool:
    """Return whether a row of numbers has commas between digits, and semicolons or blanks as separators besides."""
    return bool(re.search(r"\d,\d", text) and re.search(r";|[^\s,;]\s+[^\s,;]", text))


def _numbers(
    cells: list[str], columns: Sequence[int], width: int, what: str, where: str, *, first: float = MAX_NUMBER
) -> list[float]:
    """Return the numbers in some columns of a row of `width` cells; `first` is the largest in the first of them."""
    if cells[-1] == "" and len(cells) == width + 1:  # a comma at the end of the line
        cells = cells[:-1]
    if len(cells) != width:
        raise InputError(f"the row has {len(cells)} numbers, not {width}", where=where, hint=f"each row is {what}")
    for column in columns:
        cell, most = cells[column], first if column == columns[0] else MAX_NUMBER
        if not is_number(cell):
            raise InputError(
                f"column {column + 1} is not a number: {cell[:40]!r}", where=where, hint="write a plain decimal number"
            )
        if not math.isfinite(float(cell)):
            raise InputError(
                f"column {column + 1} is not a finite number: {cell[:40]}",
                where=where,
                hint="write a plain decimal number",
            )
        if abs(float(cell)) > most:
            raise InputError(
                f"column {column + 1} is larger than {most:g}: {cell[:40]}",
                where=where,
                hint="write metres and seconds",
            )
    return [float(cells[column]) for column in columns]


def is_number(text: str) -> bool:
    """Return whether Python reads the text as a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True
