"""Write the tables of the pages in docs/ from the JSON in results/, between markers that name them.

<!-- table: results/bench.json#time-4.5x8x2-hardware -->     its title and its cells
<!-- columns: results/bench.json#time-4.5x8x2-hardware -->   what its columns mean
<!-- measured: results/bench.json -->                        command, date, commit and machine
<!-- end -->                                                 ends any of them
"""

import re
from pathlib import Path

from cfplan.errors import InputError
from cfplan.studies.provenance import Provenance
from cfplan.studies.result import Table, read_result

_BLOCK = re.compile(
    r"(?P<begin><!-- (?P<kind>table|columns|measured): (?P<file>[^#\s]+)(?:#(?P<name>\S+))? -->\n).*?"
    r"(?P<end><!-- end -->)",
    re.DOTALL,
)


def with_tables(page: str, folder: Path) -> str:
    """Return the page's text with every marked block made anew; files are found from `folder`. Raises InputError."""

    def block(match: re.Match[str]) -> str:
        result = read_result(folder / match["file"])
        if match["kind"] == "measured":
            text = _measured(result.provenance)
        else:
            write = _cells if match["kind"] == "table" else _meanings
            text = write(result.table(match["name"] or ""))
        return f"{match['begin']}\n{text}\n\n{match['end']}"

    return _BLOCK.sub(block, page)


def write_tables(folder: Path) -> list[Path]:
    """Make the tables of every page under docs/ of `folder` anew; return the pages that changed. Raises InputError."""
    pages = sorted((folder / "docs").rglob("*.md"))
    if not pages:
        raise InputError("no pages", where=str(folder / "docs"), hint="run this in the repository's root")
    changed = []
    for page in pages:
        old = page.read_text(encoding="utf-8")
        new = with_tables(old, folder)
        if new != old:
            page.write_text(new, encoding="utf-8")
            changed.append(page)
    return changed


def _cells(table: Table) -> str:
    titles, cells = table.cells()
    return "\n".join([f"**{table.title}**", "", _line(titles), "|---" * len(titles) + "|", *map(_line, cells)])


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _meanings(table: Table) -> str:
    explained = [column for column in table.columns if column.title and column.meaning]
    return "\n".join(f"- *{column.title}*: {column.meaning}" for column in explained)


def _measured(made: Provenance) -> str:
    commit = f"commit {made.commit[:12]}{' with changes' if made.modified else ''}"
    machine = f"{made.machine.processor}, {made.machine.cores} cores, Python {made.machine.python}"
    return f"    {made.command}\n\nMeasured on {made.date[:10]} at {commit}; {machine}."
