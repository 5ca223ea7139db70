"""Read columns of numbers from the text of a file."""

import io
import re
from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv

from cfplan.errors import InputError

_BLOCK = 1 << 20  # bytes per task, which fit into a core's cache
_LONGEST_CELL = 64  # bytes
_NO_NUMBER = ["", " ", "NaN", "nan", "-nan", "NA", "-nan(ind)", "NULL"]  # contents of a cell without a value
_NUMBER = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|inf(inity)?)", re.IGNORECASE | re.ASCII)


def read_numbers(
    data: bytes, begin: int, end: int, columns: Sequence[int], width: int, where: str, *, delimiter: str = ",",
    point: str = ".",
) -> tuple[dict[int | str, NDArray], bool]:  # fmt: skip
    """Return each of `columns`, NaN for empty cells, and whether the last line was cut off, which is then left out.

    Lines from byte `begin` to `end` have `width` cells each; `point` is the decimal separator.

    Raises InputError, with the line number, if a line has another number of cells, or a cell is not a number.
    """
    if begin == end:
        return {column: np.empty(0) for column in columns}, False
    kept = [str(column) for column in columns]
    try:
        table = csv.read_csv(
            pa.BufferReader(memoryview(data)[begin:end]),
            csv.ReadOptions(
                column_names=[str(index) for index in range(width)], block_size=max(_BLOCK, _LONGEST_CELL * width)
            ),
            csv.ParseOptions(delimiter=delimiter),
            csv.ConvertOptions(
                include_columns=kept,
                column_types=dict.fromkeys(kept, pa.float64()),
                null_values=_NO_NUMBER,
                decimal_point=point,
            ),
        )
    except pa.ArrowInvalid:
        last = max(data.rfind(b"\n", begin, end) + 1, begin)
        if last < end == len(data):  # the file ends within a line
            return read_numbers(data, begin, last, columns, width, where, delimiter=delimiter, point=point)[0], True
        raise _mistake(data, begin, end, columns, width, where, delimiter=delimiter, point=point) from None
    return {column: values.to_numpy() for column, values in zip(columns, table.columns, strict=True)}, False


def decimal_point(data: bytes, begin: int, end: int, delimiter: str) -> str:
    """Return the decimal separator of numbers that `delimiter` separates."""
    return "," if delimiter != "," and data.count(b",", begin, end) > data.count(b".", begin, end) else "."


def line_at(data: bytes, offset: int) -> int:
    """Return the number of the line, from 1, that holds a byte."""
    return data.count(b"\n", 0, offset) + 1


def _mistake(
    data: bytes, begin: int, end: int, columns: Sequence[int], width: int, where: str, *, delimiter: str, point: str
) -> InputError:
    """Return the error for the first line, and the cell in it, that cannot be read."""
    with_point = str.maketrans({point: ".", ".": point})
    for number, line in enumerate(io.BytesIO(data[begin:end]), line_at(data, begin)):
        text = line.decode("utf-8", errors="replace").strip("\r\n")
        cells = text.split(delimiter)
        if text and len(cells) != width:
            message, hint = f"{len(cells)} cells, {width} in the lines before it", "export it again, or remove the line"
            return InputError(message, where=f"{where}:{number}", hint=hint)
        for column in columns if text else ():
            cell = cells[column].strip().strip('"')
            if cell not in _NO_NUMBER and not _NUMBER.fullmatch(cell.translate(with_point)):
                message = f"{cell[:30]!r} in column {column + 1} is not a number"
                hint = "export it again, or leave the cell empty: not seen"
                return InputError(message, where=f"{where}:{number}", hint=hint)
    return InputError(
        "the numbers after this line cannot be read",
        where=f"{where}:{line_at(data, begin)}",
        hint="export the log again, with plain decimal numbers and without quotes",
    )
