"""Read text and tables of numbers from files that people write."""

import io
import math
import os
import pathlib
import re
import select
import stat

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError

MAX_FILE_SIZE = 4_000_000  # bytes; a path or a set of limits is a few kilobytes
MAX_NUMBER = 1e6  # metres, seconds or coefficients: a larger number is a slip and would cost digits
PIPE_PATIENCE = 5.0  # s without a byte
DECIMAL_COMMA_HINT = "write decimals with a point, as 1.5, and the same separator between all numbers"
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
        if header_allowed and not any(is_number(cell) for cell in cells):
            header_allowed = False
            continue
        header_allowed = False
        if may_have_decimal_commas(text):
            raise InputError(
                f"decimal commas, or two kinds of separators: {text[:40]!r}",
                where=f"{file}:{number}",
                hint=DECIMAL_COMMA_HINT,
            )
        rows.append(_numbers(cells, columns, what, f"{file}:{number}"))
        lines.append(number)
    if not rows:
        raise InputError("no rows of numbers", where=str(file), hint=f"each row is {what}")
    return np.array(rows), lines


def may_have_decimal_commas(text: str) -> bool:
    """Return whether a row of numbers has commas between digits, and semicolons or blanks as separators besides."""
    return bool(re.search(r"\d,\d", text) and re.search(r";|[^\s,;]\s+[^\s,;]", text))


def _numbers(cells: list[str], columns: int, what: str, where: str) -> list[float]:
    if len(cells) != columns:
        raise InputError(f"the row has {len(cells)} numbers, not {columns}", where=where, hint=f"each row is {what}")
    for column, cell in enumerate(cells, start=1):
        if not is_number(cell):
            raise InputError(
                f"column {column} is not a number: {cell[:40]!r}", where=where, hint="write a plain decimal number"
            )
        if not math.isfinite(float(cell)):
            raise InputError(
                f"column {column} is not a finite number: {cell[:40]}", where=where, hint="write a plain decimal number"
            )
        if abs(float(cell)) > MAX_NUMBER:
            raise InputError(
                f"column {column} is larger than {MAX_NUMBER:g}: {cell[:40]}",
                where=where,
                hint="write metres and seconds",
            )
    return [float(cell) for cell in cells]


def is_number(text: str) -> bool:
    """Return whether Python reads the text as a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True
