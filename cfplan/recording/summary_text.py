"""A flight's numbers as a short text in Markdown."""

import math
from datetime import UTC, datetime

from cfplan.recording.record import Record
from cfplan.recording.summary import summarise


def summary_text(record: Record) -> str:
    """Heading, a table of the numbers, and what flew; a dash where the record cannot tell."""
    summary, header = summarise(record), record.header
    begun = datetime.fromtimestamp(header.wall_time_at_zero + record.start, UTC)
    rows = [
        ("travel time, planned", _number(summary.travel_time_planned, "s", 2)),
        ("travel time, flown", _number(summary.travel_time_flown, "s", 2)),
        ("deviation in time, max", _number(summary.max_deviation * 100, "cm", 1)),
        ("deviation in time, rms", _number(summary.rms_deviation * 100, "cm", 1)),
        ("deviation from the path, max", _number(summary.max_deviation_to_path * 100, "cm", 1)),
        ("peak speed", _number(summary.peak_speed, "m/s", 2)),
        ("lateness, p99", _number(summary.lateness_p99 * 1e3, "ms", 2)),
        ("lateness, worst", _number(summary.lateness_max * 1e3, "ms", 2)),
        ("pose dropouts", str(summary.pose_dropouts)),
        ("longest pose gap", _number(summary.longest_pose_gap * 1e3, "ms", 0)),
        ("battery", f"{_number(summary.battery_start, 'V', 2)} → {_number(summary.battery_end, 'V', 2)}"),
    ]
    cut = ["**The record ends early: what follows its last whole chunk is lost.**", ""] if record.truncated else []
    lines = [
        f"## {header.name}",
        "",
        *cut,
        f"{begun:%Y-%m-%d %H:%M:%S} UTC · {header.vehicle.name} · {header.uri} · {header.planner}",
        "",
        "| | |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in rows),
    ]
    return "\n".join(lines)


def _number(value: float, unit: str, digits: int) -> str:
    return f"{value:.{digits}f} {unit}" if math.isfinite(value) else "–"
