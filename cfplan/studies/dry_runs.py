"""Fly the bytes of path files in the dry run at several motor lags: how far the vehicle deviates from each plan.

Plans and bytes are those for the vehicle of safety.yaml, whatever lag the simulated one has.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from cfplan.preparation.plan_flight import plan_flight
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.dry_run import dry_run
from cfplan.studies.giving_way import LAGS
from cfplan.studies.result import Column, StudyResult, Table, collect


def _key(lag: float) -> str:
    return f"deviation_{1000 * lag:g}_ms"


COLUMNS = (
    Column("path", "path"),
    Column("planner", "planner"),
    Column("duration", "planned", "s", ".2f"),
    Column("time_lost", "time lost", "%", ".2f", meaning="by giving way to link loss and gaps"),
    *(Column(_key(lag), f"at {lag:g} s", "cm", ".2f", meaning="largest deviation at that motor lag") for lag in LAGS),
    Column("saturation", "at a motor's limit", "%", ".2f", meaning=f"share of the time, at {LAGS[-1]:g} s"),
)


def dry_runs(
    path_files: Sequence[Path],
    find_safety_file: Callable[[Path], Path],
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Plan each path, and fly its bytes at each of LAGS. An interrupt keeps what is done by then.

    Raises what planning and encoding raise.
    """

    def measure() -> Iterator[dict[str, Any]]:
        for done, file in enumerate(path_files):
            progress(done, len(path_files))
            yield _row(file, find_safety_file(file))

    rows, interrupted = collect(measure())
    table = Table("dry-runs", "Dry run: largest deviation by motor lag", COLUMNS, tuple(rows))
    settings = {"paths": [file.stem for file in path_files], "lags": LAGS}
    return StudyResult("dry-runs", settings, (table,), interrupted=interrupted)


def _row(path_file: Path, safety_file: Path) -> dict[str, Any]:
    limits = load_limits(safety_file)
    planned = plan_flight(path_file, limits)
    encoded, trajectory = encode_flight(planned), planned.plan.trajectory
    airframes = [replace(limits.airframe, motor_time_constant=lag) for lag in LAGS]
    flown = [dry_run(encoded, trajectory, airframe, limits.flight) for airframe in airframes]
    return {
        "path": path_file.stem,
        "planner": planned.plan.planner,
        "duration": planned.duration,
        "time_lost": planned.plan.time_lost,
        **{_key(lag): run.deviation for lag, run in zip(LAGS, flown, strict=True)},
        "saturation": flown[-1].saturation,
    }
