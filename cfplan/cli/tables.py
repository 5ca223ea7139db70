"""Tables that fit the terminal: text wraps, numbers never do, and what is still too wide is printed across."""

import re
from collections.abc import Iterator, Sequence

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

_GAP = 2  # characters between two columns
_LEAST_TEXT = 12  # characters, to which a column of text is wrapped at most
_LONGEST_NUMBER = 24  # characters, with its unit; what is longer is a sentence that begins with a number
_TIE = "\N{NO-BREAK SPACE}"  # keeps a number and its unit on one line while the table is laid out
_NUMBER = re.compile(r"[-+–(≤≥<>]?\s*\d.*|[-–]?")

Rows = Sequence[Sequence[str]]


def print_fitting(console: Console, title: str, columns: Sequence[str], rows: Rows) -> None:
    """Print a table no wider than the console; where even wrapping cannot do that, with a column for each row."""
    with console.capture() as drawn:
        console.print(Text(title, "italic"))
        for heads, cells in _fitting(list(columns), [list(row) for row in rows], console.width):
            console.print(_table(heads, cells))
    console.file.writelines(f"{line.rstrip()}\n" for line in drawn.get().replace(_TIE, " ").splitlines())


def _fitting(columns: list[str], rows: list[list[str]], width: int) -> Iterator[tuple[list[str], list[list[str]]]]:
    """Yield the table itself if it fits, else parts of it turned over, each with as many of the rows as fit."""
    if not rows or len(columns) < 3 or _least_width(columns, rows) <= width:
        yield columns, rows
        return
    begin = 0
    while begin < len(rows):
        end = len(rows)
        while end > begin + 1 and _least_width(*_turned(columns, rows[begin:end])) > width:
            end -= 1
        yield _turned(columns, rows[begin:end])
        begin = end


def _turned(columns: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
    """Return the table with a column for each row, under the row's first cell."""
    heads = [columns[0], *(row[0] for row in rows)]
    return heads, [[name, *(row[index] for row in rows)] for index, name in enumerate(columns) if index > 0]


def _least_width(columns: list[str], rows: list[list[str]]) -> int:
    """Return how narrow the table may be drawn, in characters."""
    return sum(_least_widths(columns, rows)) + _GAP * (len(columns) - 1)


def _least_widths(columns: Sequence[str], rows: Rows) -> list[int]:
    """Return how narrow each column may be: its longest number or word, and a little more of text."""
    least = []
    for index, head in enumerate(columns):
        cells = [row[index] for row in rows]
        width = max(map(_longest_word, (head, *cells)))
        if index > 0 and _is_numeric(cells):
            least.append(max(width, _longest(cells)))
        else:
            least.append(max(width, min(_LEAST_TEXT, _longest((head, *cells)))))
    return least


def _longest(texts: Sequence[str]) -> int:
    return max((cell_len(text) for text in texts), default=0)


def _longest_word(text: str) -> int:
    return _longest(text.split())


def _is_numeric(cells: Sequence[str]) -> bool:
    return all(_NUMBER.fullmatch(cell) and len(cell) <= _LONGEST_NUMBER for cell in cells)


def _table(columns: Sequence[str], rows: Rows) -> Table:
    table = Table(header_style="bold", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, pad_edge=False)
    for index, (column, least) in enumerate(zip(columns, _least_widths(columns, rows), strict=True)):
        numeric = index > 0 and _is_numeric([row[index] for row in rows])
        table.add_column(column, justify="right" if numeric else "left", min_width=least)
    for row in rows:
        table.add_row(*(Text(cell.replace(" ", _TIE) if _is_numeric([cell]) else cell) for cell in row))
    return table
