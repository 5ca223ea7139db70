"""What is in a dataset: counts, failures, and how lengths, times, speeds and active limits are distributed."""

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cfplan.learning.dataset import read_dataset, read_timing
from cfplan.planners.solution import Status

PERCENTILES = (0, 10, 50, 90, 99, 100)
DISTRIBUTIONS = {
    "length": "m",
    "travel_time": "s",
    "peak_speed": "m/s",
    "mean_speed": "m/s",
    "iterations": "",
    "solve_seconds": "s",
}


def describe(folder: Path) -> dict[str, Any]:
    """A summary as plain data. Raises InputError where the folder is no dataset."""
    spec, rows = read_dataset(folder)
    timing = read_timing(folder)
    solved = rows.filter(pa.compute.equal(rows["status"], Status.SOLVED.name))
    share = _numbers(solved, "certified_share")
    values = {name: _numbers(solved, name) for name in ("length", "travel_time", "peak_speed", "iterations")}
    values["mean_speed"] = values["length"] / values["travel_time"]
    values["solve_seconds"] = _numbers(timing, "solve_seconds")
    active = Counter(name for names in solved["active_limits"].to_pylist() for name in names)
    return {
        "folder": str(folder),
        "spec": asdict(spec),
        "rows": rows.num_rows,
        "rows_wanted": spec.rows,
        "solved": solved.num_rows,
        "failed": dict(Counter(status for status in rows["status"].to_pylist() if status != Status.SOLVED.name)),
        "certified_as_they_are": int(np.sum(share >= 1.0)),
        "certified_when_slowed": int(np.sum((share > 0.0) & (share < 1.0))),
        "never_certified": int(np.sum(share <= 0.0)),
        "percentiles": {name: _percentiles(values[name]) for name in DISTRIBUTIONS},
        "active_limits": {name: count / max(1, solved.num_rows) for name, count in active.most_common()},
    }


def _numbers(table: pa.Table, name: str) -> np.ndarray:
    return table[name].to_numpy().astype(float)


def _percentiles(values: np.ndarray) -> dict[str, float | None]:
    known = values[np.isfinite(values)]
    if not len(known):
        return {str(percentile): None for percentile in PERCENTILES}
    found = np.percentile(known, PERCENTILES)
    return {str(percentile): float(value) for percentile, value in zip(PERCENTILES, found, strict=True)}
