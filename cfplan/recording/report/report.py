"""Gather the data of a flight's report: its numbers, certificate, events and provenance."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cfplan.errors import CfplanError
from cfplan.planning.plan_file import load_plan
from cfplan.recording.reader import read_record
from cfplan.recording.record import PLAN_FILE, Record
from cfplan.recording.summary import UNKNOWN, FlightSummary, begun, shares, summarise, summary_rows
from cfplan.safety.certificate import Certificate


@dataclass(frozen=True, slots=True, eq=False)
class ReportedFlight:
    """One record with everything derived from it."""

    name: str  # of its folder, or of a fleet's vehicle
    record: Record
    summary: FlightSummary
    shares: Mapping[str, float]  # usage of the plan's limit by each peak; NaN without such a limit
    certificate: Certificate | None  # of its plan; None if the record has no readable plan
    provenance: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]  # missing data, one sentence each


def read_flight(place: Path) -> ReportedFlight:
    """Read a record, with the plan beside it. Raises InputError if it is not a record."""
    record = read_record(place)
    return reported(record, record.folder.resolve().name)


def reported(record: Record, name: str) -> ReportedFlight:
    """Return a record with everything derived from it and from the plan beside it."""
    summary = summarise(record)
    notes = ["The record ends early: data after its last complete chunk is lost."] if record.truncated else []
    certificate, plan_rows = None, []
    plan_file = record.folder / PLAN_FILE
    if plan_file.is_file():
        try:
            plan = load_plan(plan_file)
            certificate = plan.certificate
            plan_rows = [
                ("planner", plan.planner),
                ("grid", f"{plan.nodes} intervals"),
                ("planning", f"{plan.seconds:.2f} s"),
                ("fraction of the planner's speed", f"{plan.repair_speed_factor:.4g}"),
                ("fraction of the requested speed", f"{plan.speed_factor:.4g}"),
                *(("note", note) for note in plan.notes),
            ]
        except CfplanError as error:
            notes.append(f"Its plan cannot be read: {error.what}.")
    else:
        notes.append("No plan lies beside it, so there is no certificate.")
    return ReportedFlight(
        name=name,
        record=record,
        summary=summary,
        shares=shares(summary, record.header.plan_limits),
        certificate=certificate,
        provenance=(*_provenance(record), *plan_rows),
        notes=tuple(notes),
    )


def _provenance(record: Record) -> list[tuple[str, str]]:
    header = record.header
    return [
        ("begun", begun(record)),
        ("path", header.name),
        ("vehicle", header.vehicle.name),
        ("reached by", header.uri),
        ("cfplan", header.version),
        *((key, value) for key, value in header.provenance.items() if key != "planner"),
    ]


def outcome(flight: ReportedFlight) -> str:
    """Return how the flight ended, in the pilot's words."""
    ended = flight.record.summary.get("outcome")
    return str(ended.get("reason") or UNKNOWN) if isinstance(ended, Mapping) else UNKNOWN


def head(flight: ReportedFlight) -> list[tuple[str, str]]:
    """Return vehicle, room, time, link and planner, for the head of the page."""
    header = flight.record.header
    low, high = header.fence
    sides = " × ".join(f"{b - a:g}" for a, b in zip(low, high, strict=True))
    obstacles = ", ".join(each.name or f"number {number}" for number, each in enumerate(header.obstacles, start=1))
    return [
        ("begun", begun(flight.record)),
        ("path", header.name),
        ("vehicle", header.vehicle.name),
        ("reached by", header.uri),
        ("planned by", header.planner or UNKNOWN),
        ("room", f"{sides} m"),
        *([("obstacles", obstacles)] if obstacles else []),
        ("cfplan", header.version),
    ]


def rows(flight: ReportedFlight) -> list[tuple[str, str]]:
    """Return the summary table: the name of each number, and its value as text."""
    return [
        *summary_rows(flight.summary, flight.record.header.plan_limits),
        ("certificate", _verdict(flight.certificate)),
        ("ended", outcome(flight)),
    ]


def _verdict(certificate: Certificate | None) -> str:
    if certificate is None:
        return UNKNOWN
    worst = certificate.worst
    return f"{'passed' if certificate.passed else 'FAILED'}, {worst.name} {100 * worst.share:.1f} %"


def flight_to_dict(flight: ReportedFlight) -> dict[str, Any]:
    """Return the report for JSON, with all numbers in SI units."""
    record = flight.record
    events = zip(record.events.time - record.start, record.events.level, record.events.text, strict=True)
    return {
        "name": flight.name,
        "folder": str(record.folder),
        "path": record.header.name,
        **flight.summary.to_json(),
        "shares": {name: share if math.isfinite(share) else None for name, share in flight.shares.items()},
        "outcome": record.summary.get("outcome"),
        "certificate": None if flight.certificate is None else flight.certificate.to_dict(),
        "events": [{"time": float(time), "level": str(level), "text": str(text)} for time, level, text in events],
        "provenance": [{"what": what, "value": value} for what, value in flight.provenance],
        "notes": list(flight.notes),
    }
