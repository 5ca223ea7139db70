"""List the flights in a folder of records."""

import json
import shlex
from pathlib import Path
from typing import Any

import click

from cfplan.cli.output import print_json, print_table
from cfplan.numbers import shown
from cfplan.recording.fleet_record import FLEET_FILE, is_fleet_record
from cfplan.recording.record import FLIGHT_FILE, SUMMARY_FILE

_UNKNOWN = "–"


def flights_in(folder: Path) -> list[Path]:
    """Return the records and the flights of fleets directly in a folder, the latest last; none if it is a record."""
    if not folder.is_dir() or (folder / FLIGHT_FILE).exists():
        return []
    return sorted(file.parent for name in (FLIGHT_FILE, FLEET_FILE) for file in folder.glob(f"*/{name}"))


def print_flights(records: list[Path], *, as_json: bool) -> None:
    """Print a row for each flight, from its summary, and the command that replays the last one."""
    if as_json:
        print_json({"records": list(map(_document, records))})
        return
    count = "1 flight" if len(records) == 1 else f"{len(records)} flights"
    print_table(count, ["record", "on", "ended", "flown", "deviation"], list(map(_row, records)))
    click.echo(f"replay the last: cfplan replay {shlex.quote(str(records[-1]))}")


def _document(record: Path) -> dict[str, Any]:
    """Return the summary of a flight; of a fleet's flight, those of its vehicles."""
    if is_fleet_record(record):
        return {"record": str(record), "vehicles": [_document(each) for each in flights_in(record)]}
    return {"record": str(record), **_summary(record)}


def _row(record: Path) -> list[str]:
    if is_fleet_record(record):
        return _fleet_row(record)
    summary = _summary(record)
    return [
        record.name,
        str(summary.get("uri", _UNKNOWN)),
        _ended(summary),
        _number(summary.get("travel_time_flown"), 1, 2, "s"),
        _number(summary.get("max_deviation"), 100, 1, "cm"),
    ]


def _fleet_row(record: Path) -> list[str]:
    """Return the row of a fleet's flight: each reason once, the longest time and the largest deviation."""
    summaries = [_summary(each) for each in flights_in(record)]

    def largest(key: str) -> float | None:
        known = [value for each in summaries if isinstance(value := each.get(key), int | float)]
        return max(known, default=None)

    return [
        record.name,
        f"{len(summaries)} vehicles",
        "; ".join(dict.fromkeys(map(_ended, summaries))) or _UNKNOWN,
        _number(largest("travel_time_flown"), 1, 2, "s"),
        _number(largest("max_deviation"), 100, 1, "cm"),
    ]


def _ended(summary: dict[str, Any]) -> str:
    ended = summary.get("outcome")
    return str(ended.get("reason", _UNKNOWN)) if isinstance(ended, dict) else "no summary: the program ended in flight"


def _summary(record: Path) -> dict[str, Any]:
    try:
        summary = json.loads((record / SUMMARY_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return summary if isinstance(summary, dict) else {}


def _number(value: Any, scale: float, digits: int, unit: str) -> str:
    return f"{shown(scale * value, f'.{digits}f')} {unit}" if isinstance(value, int | float) else _UNKNOWN
