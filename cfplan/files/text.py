"""Text and tables of numbers from files that people write."""

import math
import pathlib
import re

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError

LARGEST_FILE = 4_000_000
# bytes; a path or a set of limits is a few kilobytes
LARGEST_NUMBER = 1e6
# metres, seconds or coefficients: beyond this it is a slip, and arithmetic would suffer
_SEPARATOR = re.compile(r"\s*[,;]\s*|\s+")


def read_text(file: pathlib.Path) -> str:
    """The text of a file of reasonable size.

    Raises:
        InputError: not there, not a file, not readable, too large, empty, not UTF-8 text.
    """
    try:
        if file.is_dir():
            raise InputError("a folder, not a file", where=str(file), hint="name the file in it")
        with file.open("rb") as stream:
            content = stream.read(LARGEST_FILE + 1)
    except FileNotFoundError:
        raise InputError(
            "no such file",
            where=str(file),
            hint="is the name right? It is taken from the working folder, or from the path file's",
        ) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot be read: {reason}", where=str(file), hint="look at its permissions") from None
    if len(content) > LARGEST_FILE:
        raise InputError(f"larger than {LARGEST_FILE // 1_000_000} MB", where=str(file), hint="thin the points out")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError("not UTF-8 text", where=f"{file}:{line}", hint="save the file as UTF-8") from None
    if not text.strip():
        raise InputError("the file is empty", where=str(file), hint="is it the right file?")
    return text


def read_table(file: pathlib.Path, columns: int, what: str) -> tuple[NDArray, list[int]]:
    """Rows of `columns` numbers apart by commas, semicolons or blanks, and the line of each.

    Blank lines, lines that start with # and one header line are passed over.

    Raises:
        InputError: a row of another length, or what is not a finite number, with the line; no rows at all.
    """
    rows: list[list[float]] = []
    lines: list[int] = []
    header_allowed = True
    for number, line in enumerate(read_text(file).splitlines(), start=1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        cells = _SEPARATOR.split(text)
        if cells[-1] == "" and len(cells) == columns + 1:  # a comma at the end of the line
            cells.pop()
        if header_allowed and not any(_is_number(cell) for cell in cells):
            header_allowed = False
            continue
        header_allowed = False
        rows.append(_numbers(cells, columns, what, f"{file}:{number}"))
        lines.append(number)
    if not rows:
        raise InputError("no rows of numbers", where=str(file), hint=f"each row is {what}")
    return np.array(rows), lines


def _numbers(cells: list[str], columns: int, what: str, where: str) -> list[float]:
    if len(cells) != columns:
        raise InputError(f"the row has {len(cells)} numbers, not {columns}", where=where, hint=f"each row is {what}")
    for column, cell in enumerate(cells, start=1):
        if not _is_number(cell):
            raise InputError(
                f"column {column} is not a number: {cell[:40]!r}", where=where, hint="write a plain decimal number"
            )
        if not math.isfinite(float(cell)):
            raise InputError(
                f"column {column} is not a finite number: {cell[:40]}", where=where, hint="write a plain decimal number"
            )
        if abs(float(cell)) > LARGEST_NUMBER:
            raise InputError(
                f"column {column} is out of all bounds: {cell[:40]}", where=where, hint="write metres and seconds"
            )
    return [float(cell) for cell in cells]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
