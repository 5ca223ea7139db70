"""Read lines of numbers from a mapped text file, a block of lines at a time, so that its size hardly matters."""

import mmap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv

from cfplan.errors import InputError
from cfplan.files.text import is_number

BLOCK = 1 << 24  # bytes turned into numbers at a time
_AT_ONCE = 1 << 20  # bytes of them that one core takes: they fit into its cache
_LONGEST_CELL = 64  # bytes
_NO_NUMBER = ["", " ", "NaN", "nan", "-nan", "NA", "-nan(ind)"]  # what a cell without a value holds


@dataclass(frozen=True, slots=True)
class Lines:
    """Which lines and cells of a file hold the numbers."""

    begin: int  # byte of the first line
    end: int  # byte behind the last line
    delimiter: str
    width: int  # cells of every line
    wanted: Sequence[int]  # the cells to read
    point: str = "."  # of the decimals


def numbers(data: mmap.mmap, lines: Lines, file: Path, *, block: int = BLOCK) -> tuple[NDArray, bool]:
    """Return (rows, wanted), NaN for empty cells, and whether the last line was cut off, which is then left out.

    Raises InputError with the file's line where one has another number of cells, or a wanted one is no number.
    """
    blocks, cut = [], False
    for begin, end in _blocks(data, lines, block):
        try:
            blocks.append(_block(data[begin:end], lines))
        except pa.ArrowInvalid as error:
            last = data.rfind(b"\n", begin, end) + 1 or begin
            cut = is_cut_off(data, last, end)
            mistake = _mistake(data, begin, last if cut else end, lines, file)
            if mistake is not None or not cut:
                raise mistake or _unreadable(data, begin, file) from error
            if last > begin:
                try:
                    blocks.append(_block(data[begin:last], lines))
                except pa.ArrowInvalid:
                    raise _unreadable(data, begin, file) from error
    if not blocks:
        return np.empty((0, len(lines.wanted))), cut
    return np.concatenate(blocks, axis=1).T, cut


def place(data: mmap.mmap, offset: int, file: Path) -> str:
    """Return `file:line` of a byte."""
    starts = range(0, offset, BLOCK)
    before = sum(data[start : min(start + BLOCK, offset)].count(b"\n") for start in starts)
    return f"{file}:{before + 1}"


def is_cut_off(data: mmap.mmap, begin: int, end: int) -> bool:
    """Return whether begin to end is the file's last line, without its line end."""
    return begin < end == len(data) and data.find(b"\n", begin, end) < 0


def _blocks(data: mmap.mmap, lines: Lines, size: int) -> Iterator[tuple[int, int]]:
    begin = lines.begin
    while begin < lines.end:
        end = lines.end if lines.end - begin <= size else data.rfind(b"\n", begin, begin + size) + 1 or lines.end
        yield begin, end
        begin = end


def _block(text: bytes, lines: Lines) -> NDArray:
    """Return (wanted, rows): a column of the file is a row here, contiguous in memory as Arrow has it."""
    names = [str(index) for index in range(lines.width)]
    kept = [names[index] for index in lines.wanted]
    table = csv.read_csv(
        pa.BufferReader(text),
        read_options=csv.ReadOptions(column_names=names, block_size=max(_AT_ONCE, _LONGEST_CELL * lines.width)),
        parse_options=csv.ParseOptions(delimiter=lines.delimiter),
        convert_options=csv.ConvertOptions(
            include_columns=kept,
            column_types=dict.fromkeys(kept, pa.float64()),
            null_values=_NO_NUMBER,
            decimal_point=lines.point,
        ),
    )
    return np.stack([column.to_numpy() for column in table.columns])


def _unreadable(data: mmap.mmap, begin: int, file: Path) -> InputError:
    return InputError(
        "the numbers behind this line cannot be read",
        where=place(data, begin, file),
        hint="export the log again, with plain decimal numbers and without quotes",
    )


def _mistake(data: mmap.mmap, begin: int, end: int, lines: Lines, file: Path) -> InputError | None:
    """Find the first line, and the cell in it, that is not a row of numbers."""
    while begin < end:
        after = data.find(b"\n", begin, end) + 1 or end
        line = data[begin:after].decode("utf-8", errors="replace").strip("\r\n")
        cells = line.split(lines.delimiter)
        if line and len(cells) != lines.width:
            return InputError(
                f"{len(cells)} cells, {lines.width} in the lines before it",
                where=place(data, begin, file),
                hint="export it again, or remove the line",
            )
        for index in lines.wanted if line else ():
            text = cells[index].strip().strip('"')
            if text not in _NO_NUMBER and not is_number(text.replace(lines.point, ".")):
                return InputError(
                    f"{text[:30]!r} in column {index + 1} is not a number",
                    where=place(data, begin, file),
                    hint="export it again, or leave the cell empty: not seen",
                )
        begin = after
    return None
