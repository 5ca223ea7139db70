"""List the flights in a folder of records."""

import json
import shlex
from pathlib import Path
from typing import Any

import click

from cfplan.cli.output import print_json, print_table
from cfplan.numbers import shown
from cfplan.recording.record import FLIGHT_FILE, SUMMARY_FILE

_UNKNOWN = "–"


def flights_in(folder: Path) -> list[Path]:
    """Return the records directly in a folder, the latest last; none if it is not a folder or is a record itself."""
    if not folder.is_dir() or (folder / FLIGHT_FILE).exists():
        return []
    return sorted(file.parent for file in folder.glob(f"*/{FLIGHT_FILE}"))


def print_flights(records: list[Path], *, as_json: bool) -> None:
    """Print a row for each flight, from its summary, and the command that replays the last one."""
    if as_json:
        print_json({"records": [{"record": str(record), **_summary(record)} for record in records]})
        return
    count = "1 flight" if len(records) == 1 else f"{len(records)} flights"
    print_table(count, ["record", "on", "ended", "flown", "deviation"], list(map(_row, records)))
    click.echo(f"replay the last: cfplan replay {shlex.quote(str(records[-1]))}")


def _row(record: Path) -> list[str]:
    summary = _summary(record)
    ended = summary.get("outcome")
    return [
        record.name,
        str(summary.get("uri", _UNKNOWN)),
        str(ended.get("reason", _UNKNOWN)) if isinstance(ended, dict) else "no summary: the program ended in flight",
        _number(summary.get("travel_time_flown"), 1, 2, "s"),
        _number(summary.get("max_deviation"), 100, 1, "cm"),
    ]


def _summary(record: Path) -> dict[str, Any]:
    try:
        summary = json.loads((record / SUMMARY_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return summary if isinstance(summary, dict) else {}


def _number(value: Any, scale: float, digits: int, unit: str) -> str:
    return f"{shown(scale * value, f'.{digits}f')} {unit}" if isinstance(value, int | float) else _UNKNOWN
