"""Tables that fit the terminal: text wraps, numbers do not, and tables that are still too wide are transposed."""

import re
from collections.abc import Iterator, Sequence

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

_MIN_TEXT_WIDTH = 12  # characters, least width to which a column of text is wrapped
_MAX_NUMBER_WIDTH = 24  # characters, with its unit; longer cells are sentences that begin with a number
_NUMBER = re.compile(r"[-+–(≤≥<>]?\s*\d.*|[-–]?")
_UNBOUNDED = 100_000  # characters, width of a console that fits any table

Rows = Sequence[Sequence[str]]


def print_fitting(console: Console, title: str, columns: Sequence[str], rows: Rows) -> None:
    """Print a table no wider than the console; if wrapping is not enough, with a column for each row."""
    with console.capture() as drawn:
        console.print(Text(title, "italic"))
        for table in _fitting(console, columns, rows):
            console.print(table)
    console.file.writelines(f"{line.rstrip()}\n" for line in drawn.get().splitlines())


def _fitting(console: Console, columns: Sequence[str], rows: Rows) -> Iterator[Table]:
    """Yield the table itself if it fits, else transposed parts of it, each with as many of the rows as fit."""
    table = _table(columns, rows)
    if not rows or len(columns) < 3 or _fits(console, table):
        yield table
        return
    while rows:
        count = 1
        while count < len(rows) and _fits(console, _turned(columns, rows[: count + 1])):
            count += 1
        yield _turned(columns, rows[:count])
        rows = rows[count:]


def _fits(console: Console, table: Table) -> bool:
    return console.measure(table, options=console.options.update_width(_UNBOUNDED)).minimum <= console.width


def _turned(columns: Sequence[str], rows: Rows) -> Table:
    """Return the transposed table: a column for each row, headed by the row's first cell."""
    (corner, *heads), *lines = zip(columns, *rows, strict=True)
    return _table([corner, *heads], lines)


def _table(columns: Sequence[str], rows: Rows) -> Table:
    table = Table(header_style="bold", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, pad_edge=False)
    for index, column in enumerate(columns):
        cells = [row[index] for row in rows]
        numeric = index > 0 and all(_NUMBER.fullmatch(cell) and len(cell) <= _MAX_NUMBER_WIDTH for cell in cells)
        least = _least_width(column, cells, numeric=numeric)
        table.add_column(Text(column), justify="right" if numeric else "left", min_width=least)
    for row in rows:
        table.add_row(*map(Text, row))
    return table


def _least_width(column: str, cells: Sequence[str], *, numeric: bool) -> int:
    """Return the least width of a column: that of its longest number or word, and more for text."""
    words = _longest(" ".join((column, *cells)).split())
    return max(words, _longest(cells) if numeric else min(_MIN_TEXT_WIDTH, _longest((column, *cells))))


def _longest(texts: Sequence[str]) -> int:
    return max(map(cell_len, texts), default=0)
