"""Read columns of numbers from the text of a file."""

import re
from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv

from cfplan.errors import InputError

_BLOCK = 1 << 20  # bytes that one core takes; they fit into its cache
_LONGEST_CELL = 64  # bytes
_NO_NUMBER = ["", " ", "NaN", "nan", "-nan", "NA", "-nan(ind)"]  # what a cell without a value holds
_NUMBER = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|inf(inity)?)", re.IGNORECASE | re.ASCII)


def read_numbers(
    data: bytes, begin: int, end: int, columns: Sequence[int], width: int, where: str, *, delimiter: str = ",",
    point: str = ".",
) -> tuple[NDArray, bool]:  # fmt: skip
    """Return (rows, columns), NaN for empty cells, and whether the last line was cut off, which is then left out.

    Lines from byte `begin` to `end` have `width` cells each; `point` is that of the decimals.

    Raises InputError with the file's line where one has another number of cells, or a cell of `columns` is no number.
    """
    if begin == end:
        return np.empty((0, len(columns))), False
    names = [str(index) for index in range(width)]
    kept = [names[column] for column in columns]
    try:
        table = csv.read_csv(
            pa.BufferReader(memoryview(data)[begin:end]),
            read_options=csv.ReadOptions(column_names=names, block_size=max(_BLOCK, _LONGEST_CELL * width)),
            parse_options=csv.ParseOptions(delimiter=delimiter),
            convert_options=csv.ConvertOptions(
                include_columns=kept,
                column_types=dict.fromkeys(kept, pa.float64()),
                null_values=_NO_NUMBER,
                decimal_point=point,
            ),
        )
    except pa.ArrowInvalid:
        last = max(data.rfind(b"\n", begin, end) + 1, begin)
        if last < end == len(data):  # the file ends within a line
            rows, _ = read_numbers(data, begin, last, columns, width, where, delimiter=delimiter, point=point)
            return rows, True
        raise _mistake(data, begin, end, columns, width, where, delimiter, point) from None
    return np.stack([column.to_numpy() for column in table.columns], axis=1), False


def place(data: bytes, offset: int, where: str) -> str:
    """Return `file:line` of a byte."""
    line = data.count(b"\n", 0, offset) + 1
    return f"{where}:{line}"


def _mistake(
    data: bytes, begin: int, end: int, columns: Sequence[int], width: int, where: str, delimiter: str, point: str
) -> InputError:
    """Find the first line, and the cell in it, that is not a row of numbers."""
    with_point = str.maketrans({point: ".", ".": point})
    start = begin
    while start < end:
        after = data.find(b"\n", start, end) + 1 or end
        line = data[start:after].decode("utf-8", errors="replace").strip("\r\n")
        cells = line.split(delimiter)
        if line and len(cells) != width:
            return InputError(
                f"{len(cells)} cells, {width} in the lines before it",
                where=place(data, start, where),
                hint="export it again, or remove the line",
            )
        for column in columns if line else ():
            text = cells[column].strip().strip('"')
            if text not in _NO_NUMBER and not _NUMBER.fullmatch(text.translate(with_point)):
                return InputError(
                    f"{text[:30]!r} in column {column + 1} is not a number",
                    where=place(data, start, where),
                    hint="export it again, or leave the cell empty: not seen",
                )
        start = after
    return InputError(
        "the numbers behind this line cannot be read",
        where=place(data, begin, where),
        hint="export the log again, with plain decimal numbers and without quotes",
    )
