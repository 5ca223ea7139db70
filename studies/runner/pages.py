"""Show results in README and docs/, between markers that name them.

<!-- table: results/bench.json#time-4.5x8x2-hardware -->     its title and its cells
<!-- columns: results/bench.json#time-4.5x8x2-hardware -->   the meanings of its columns
<!-- measured: results/bench.json -->                        command, date, commit and machine
<!-- figure: results/bench.json#TABLE/ROW/COLUMN -->        one cell, within a line; ROW is the text of its first cell,
                                                             or of as many cells as identify it, joined by ` / `
<!-- end -->                                                 ends any of them

The site's hook renders all of them. In the files only figures are filled in, so that sentences can also be read on the
forge. Figures of a result that was measured with sources other than the present ones are marked with †.
"""

import re
from collections.abc import Iterable
from itertools import accumulate
from pathlib import Path

from cfplan.errors import InputError
from studies.runner.provenance import Provenance
from studies.runner.result import Table, read_result

OUT_OF_DATE = "†"  # follows a figure that was measured with other sources
_BLOCK = re.compile(
    r"(?P<begin><!-- (?P<kind>table|columns|measured): (?P<file>[^#\s]+)(?:#(?P<name>\S+))? -->\n).*?"
    r"(?P<end><!-- end -->)",
    re.DOTALL,
)
_FIGURE = re.compile(
    r"(?P<begin><!-- figure: (?P<file>[^#\s]+)#(?P<table>[^/]+)/(?P<row>.+?)/(?P<column>[^/]+?) -->)"
    r".*?(?P<end><!-- end -->)"
)


def with_results(page: str, folder: Path) -> str:
    """Return a page's text with all blocks and figures rendered; files are relative to `folder`. Raises InputError."""

    def block(match: re.Match[str]) -> str:
        result = read_result(folder / match["file"])
        if match["kind"] == "measured":
            text = _measured(result.provenance, interrupted=result.interrupted)
        else:
            write = _cells if match["kind"] == "table" else _meanings
            text = write(result.table(match["name"] or ""))
        return f"{match['begin']}\n{text}\n\n{match['end']}"

    return with_figures(_BLOCK.sub(block, page), folder)


def with_figures(page: str, folder: Path) -> str:
    """Return a page's text with the figures in its sentences updated. Raises InputError."""

    def figure(match: re.Match[str]) -> str:
        result = read_result(folder / match["file"])
        text = _cell(result.table(match["table"]), match["row"], match["column"])
        return f"{match['begin']}{text}{'' if _fresh(result.provenance) else OUT_OF_DATE}{match['end']}"

    return _FIGURE.sub(figure, page)


def write_figures(folder: Path) -> list[Path]:
    """Update the figures in README and every page under docs/ of `folder`; return the changed files.

    Raises InputError.
    """
    if not (folder / "docs").is_dir():
        raise InputError("no pages", where=str(folder / "docs"), hint="run this in the repository's root")
    changed = []
    for page in pages_of(folder):
        old = page.read_text(encoding="utf-8")
        new = with_figures(old, folder)
        if new != old:
            page.write_text(new, encoding="utf-8")
            changed.append(page)
    return changed


def stale_results(folder: Path, pages: Iterable[Path] | None = None) -> list[str]:
    """Return the results shown on these pages, by default on all, that were measured with other sources."""
    texts = [page.read_text(encoding="utf-8") for page in (pages_of(folder) if pages is None else pages)]
    names = sorted({match["file"] for text in texts for find in (_BLOCK, _FIGURE) for match in find.finditer(text)})
    return [name for name in names if not _fresh(read_result(folder / name).provenance)]


def pages_of(folder: Path) -> list[Path]:
    """Return the pages that may show results."""
    return [*folder.glob("README.md"), *sorted((folder / "docs").rglob("*.md"))]


def _fresh(made: Provenance | None) -> bool:
    return made is not None and made.fresh


def _cell(table: Table, name: str, key: str) -> str:
    """Return one cell as shown. Raises InputError if there is none, or if several rows have the name."""
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


def _measured(made: Provenance | None, *, interrupted: bool) -> str:
    assert made is not None
    commit = f"commit {made.commit[:12]}{' with changes' if made.modified else ''}"
    machine = f"{made.machine.processor}, {made.machine.cores} cores, Python {made.machine.python}"
    age = "" if made.fresh else f" The sources have changed since ({OUT_OF_DATE})."
    until_then = " It was interrupted: these are the figures until then." if interrupted else ""
    return f"    {made.command}\n\nMeasured on {made.date[:10]} at {commit}; {machine}.{age}{until_then}"
