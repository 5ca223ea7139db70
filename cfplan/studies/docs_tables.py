"""Write the tables and figures of README and docs/ from the JSON in results/, between markers that name them.

<!-- table: results/bench.json#time-4.5x8x2-hardware -->     its title and its cells
<!-- columns: results/bench.json#time-4.5x8x2-hardware -->   what its columns mean
<!-- measured: results/bench.json -->                        command, date, commit and machine
<!-- figure: results/bench.json#TABLE/ROW/COLUMN -->        one cell, within a line; ROW is what its first column shows,
                                                             or its first columns, joined by ` / `, until it is one row
<!-- end -->                                                 ends any of them
"""

import re
from itertools import accumulate
from pathlib import Path

from cfplan.errors import InputError
from cfplan.studies.provenance import Provenance
from cfplan.studies.result import Table, read_result

_BLOCK = re.compile(
    r"(?P<begin><!-- (?P<kind>table|columns|measured): (?P<file>[^#\s]+)(?:#(?P<name>\S+))? -->\n).*?"
    r"(?P<end><!-- end -->)",
    re.DOTALL,
)
_FIGURE = re.compile(
    r"(?P<begin><!-- figure: (?P<file>[^#\s]+)#(?P<table>[^/]+)/(?P<row>.+?)/(?P<column>[^/]+?) -->)"
    r".*?(?P<end><!-- end -->)"
)


def with_tables(page: str, folder: Path) -> str:
    """Return the page's text with every marked block made anew; files are found from `folder`. Raises InputError."""

    def block(match: re.Match[str]) -> str:
        result = read_result(folder / match["file"])
        if match["kind"] == "measured":
            text = _measured(result.provenance, interrupted=result.interrupted)
        else:
            write = _cells if match["kind"] == "table" else _meanings
            text = write(result.table(match["name"] or ""))
        return f"{match['begin']}\n{text}\n\n{match['end']}"

    def figure(match: re.Match[str]) -> str:
        table = read_result(folder / match["file"]).table(match["table"])
        return f"{match['begin']}{_cell(table, match['row'], match['column'])}{match['end']}"

    return _FIGURE.sub(figure, _BLOCK.sub(block, page))


def write_tables(folder: Path) -> list[Path]:
    """Make the tables of README and of every page under docs/ of `folder` anew; return the files that changed.

    Raises InputError.
    """
    pages = pages_of(folder)
    if not (folder / "docs").is_dir():
        raise InputError("no pages", where=str(folder / "docs"), hint="run this in the repository's root")
    changed = []
    for page in pages:
        old = page.read_text(encoding="utf-8")
        new = with_tables(old, folder)
        if new != old:
            page.write_text(new, encoding="utf-8")
            changed.append(page)
    return changed


def pages_of(folder: Path) -> list[Path]:
    """Return the pages that may have tables."""
    return [*folder.glob("README.md"), *sorted((folder / "docs").rglob("*.md"))]


def _cell(table: Table, name: str, key: str) -> str:
    """Return one cell as it is shown. Raises InputError where there is none, or where the name is of several rows."""
    shown = [column for column in table.columns if column.title]
    rows = [row for row in table.rows if name in accumulate((column.text(row) for column in shown), "{} / {}".format)]
    columns = [column for column in table.columns if column.key == key]
    if not rows or not columns:
        raise InputError(f"the table {table.name!r} has no cell {name}/{key}", hint="see the table's JSON")
    if len(rows) > 1:
        raise InputError(
            f"the table {table.name!r} has {len(rows)} rows {name}",
            hint="name the row by more columns, joined by ' / '",
        )
    return columns[0].text(rows[0])


def _cells(table: Table) -> str:
    titles, cells = table.cells()
    return f"**{table.title}**\n\n{_grid(titles, cells)}"


def _grid(titles: list[str], cells: list[list[str]]) -> str:
    return "\n".join([_line(titles), "|---" * len(titles) + "|", *map(_line, cells)])


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _meanings(table: Table) -> str:
    explained = [column for column in table.columns if column.title and column.meaning]
    return "\n".join(f"- *{column.title}*: {column.meaning}" for column in explained)


def _measured(made: Provenance, *, interrupted: bool) -> str:
    commit = f"commit {made.commit[:12]}{' with changes' if made.modified else ''}"
    machine = f"{made.machine.processor}, {made.machine.cores} cores, Python {made.machine.python}"
    until_then = " It was interrupted: these are the figures until then." if interrupted else ""
    return f"    {made.command}\n\nMeasured on {made.date[:10]} at {commit}; {machine}.{until_then}"
