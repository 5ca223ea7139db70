"""Write the tables and figures of README and docs/ from the JSON in results/, between markers that name them.

<!-- table: results/bench.json#time-4.5x8x2-hardware -->     its title and its cells
<!-- columns: results/bench.json#time-4.5x8x2-hardware -->   what its columns mean
<!-- measured: results/bench.json -->                        command, date, commit and machine
<!-- figure: results/bench.json#TABLE/ROW/COLUMN -->        one cell, within a line; ROW is what its first column shows,
                                                             or its first columns, joined by ` / `, until it is one row
<!-- preflight: parameters -->                               what preflight requires on board; also signs, unknowable,
                                                             time-outs
<!-- errors: geometry/path_file.py geometry/path.py -->   what these modules can say is wrong
<!-- time-outs: poses -->                                    what happens after which time; the figure beside them, too
<!-- end -->                                                 ends any of them
"""

import re
from itertools import accumulate
from pathlib import Path

from cfplan.errors import InputError
from cfplan.flight.firmware import TIMEOUTS, version_text
from cfplan.flight.pilot.vehicle_rules import COMMANDER_SIGNS, PARAMETER_RULES, UNKNOWABLE
from cfplan.studies.error_tables import error_table, read_meanings
from cfplan.studies.provenance import Provenance
from cfplan.studies.result import Table, read_result
from cfplan.studies.time_outs import time_out_table, write_figure

_BLOCK = re.compile(
    r"(?P<begin><!-- (?P<kind>table|columns|measured): (?P<file>[^#\s]+)(?:#(?P<name>\S+))? -->\n).*?"
    r"(?P<end><!-- end -->)",
    re.DOTALL,
)
_FIGURE = re.compile(
    r"(?P<begin><!-- figure: (?P<file>[^#\s]+)#(?P<table>[^/]+)/(?P<row>.+?)/(?P<column>[^/]+?) -->)"
    r".*?(?P<end><!-- end -->)"
)
_RULES = re.compile(
    r"(?P<begin><!-- preflight: (?P<name>\S+) -->\n).*?(?P<end><!-- end -->)",
    re.DOTALL,
)
_ERRORS = re.compile(r"(?P<begin><!-- errors: (?P<modules>[^>]+) -->\n).*?(?P<end><!-- end -->)", re.DOTALL)
_TIME_OUTS = re.compile(r"(?P<begin><!-- time-outs: (?P<name>\S+) -->\n).*?(?P<end><!-- end -->)", re.DOTALL)


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

    def rules(match: re.Match[str]) -> str:
        if match["name"] not in RULES:
            raise InputError(f"no such table: preflight: {match['name']}", hint=f"one of {', '.join(RULES)}")
        titles, cells = RULES[match["name"]]()
        return f"{match['begin']}\n{_grid(titles, cells)}\n\n{match['end']}"

    def figure(match: re.Match[str]) -> str:
        table = read_result(folder / match["file"]).table(match["table"])
        return f"{match['begin']}{_cell(table, match['row'], match['column'])}{match['end']}"

    def errors(match: re.Match[str]) -> str:
        titles, cells = error_table(match["modules"].split(), read_meanings(folder))
        return f"{match['begin']}\n{_grid(titles, cells)}\n\n{match['end']}"

    def time_outs(match: re.Match[str]) -> str:
        titles, cells = time_out_table(match["name"], folder)
        return f"{match['begin']}\n{_grid(titles, cells)}\n\n{match['end']}"

    page = _TIME_OUTS.sub(time_outs, _ERRORS.sub(errors, page))
    return _RULES.sub(rules, _FIGURE.sub(figure, _BLOCK.sub(block, page)))


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
    figure = write_figure(folder)
    return [*changed, figure] if figure else changed


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


def _parameters() -> tuple[list[str], list[list[str]]]:
    titles = ["parameter", "must be", "what cfplan does", "why", "since firmware"]
    return titles, [
        [
            f"`{rule.name}`", rule.wanted, str(rule.action), rule.reason,
            (version_text(rule.since) or "any") + (f"; without it: {rule.missing}" if rule.missing else ""),
        ]
        for rule in PARAMETER_RULES
    ]  # fmt: skip


def _signs() -> tuple[list[str], list[list[str]]]:
    return ["sign", "how it is known"], [[sign.name, sign.reason] for sign in COMMANDER_SIGNS]


def _unknowable() -> tuple[list[str], list[list[str]]]:
    return ["what no vehicle tells", "why"], [list(row) for row in UNKNOWABLE]


def _timeouts() -> tuple[list[str], list[list[str]]]:
    titles = ["since firmware", "levels out after", "motors off after", "watchdog", "looked at every"]
    return titles, [
        [version_text(since), *(f"{seconds:g} s" for seconds in (each.level_out, each.motors_off, each.keep_alive,
                                                                  each.period))]
        for since, each in TIMEOUTS
    ]  # fmt: skip


RULES = {"parameters": _parameters, "signs": _signs, "unknowable": _unknowable, "time-outs": _timeouts}
