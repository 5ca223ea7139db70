"""Fly the setpoints of each PATH in the dry run at several motor lags: largest deviation from the plan.

Plans and setpoints are made for the vehicle of safety.yaml; the simulated vehicles are drawn about each lag.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cfplan.preparation.plan_flight import plan_flight
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.simulation.dry_run import dry_run
from studies.runner.limits import limits_for
from studies.runner.options import argument
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

LAGS = (0.07, 0.105, 0.13)  # s, time constants of the motors


@dataclass(frozen=True, slots=True)
class Settings:
    """The paths to fly."""

    path_files: tuple[Path, ...] = argument()


def _key(lag: float, percentile: str) -> str:
    return f"deviation_{percentile}_{1000 * lag:g}_ms"


COLUMNS = (
    Column("path", "path"),
    Column("planner", "planner"),
    Column("duration", "planned", "s", ".2f"),
    Column("time_lost", "time lost", "%", ".2f", meaning="by giving way to link loss and gaps"),
    *(
        Column(
            _key(lag, "median"),
            f"median at {lag:g} s",
            "cm",
            ".2f",
            meaning="of the largest deviation of vehicles drawn about that motor lag",
        )
        for lag in LAGS
    ),
    *(Column(_key(lag, "95"), f"95 % at {lag:g} s", "cm", ".2f", meaning="95th percentile likewise") for lag in LAGS),
    Column(
        "saturation",
        "at a motor's limit",
        "%",
        ".2f",
        meaning=f"fraction of the time, of the vehicle as its airframe says, at {LAGS[-1]:g} s",
    ),
)


def work(settings: Settings, run: Run) -> Work:
    """Return one case per path."""
    return Work({str(file): file for file in settings.path_files}, measure)


def measure(path_file: Path) -> dict[str, Any]:
    """Plan a path and fly its setpoints at each of LAGS. Raises what planning and encoding raise."""
    limits = limits_for(path_file)
    planned = plan_flight(path_file, limits)
    encoded, trajectory = encode_flight(planned), planned.plan.trajectory
    airframes = [replace(limits.airframe, motor_time_constant=lag) for lag in LAGS]
    flown = [dry_run(encoded, trajectory, replace(limits, airframe=airframe)) for airframe in airframes]
    return {
        "path": path_file.stem,
        "planner": planned.plan.planner,
        "duration": planned.duration,
        "time_lost": planned.plan.time_lost,
        **{_key(lag, "median"): run.deviation_median for lag, run in zip(LAGS, flown, strict=True)},
        **{_key(lag, "95"): run.deviation for lag, run in zip(LAGS, flown, strict=True)},
        "saturation": flown[-1].saturation,
    }


def tables(settings: Settings, rows: list[dict[str, Any]]) -> Iterator[Table]:
    """Yield a table with one row per path."""
    yield table("dry-runs", "Dry run: largest deviation by motor lag", COLUMNS, rows)


STUDY = Study(Settings, work, tables, "flights/line.yaml flights/helix.yaml -o results/dry-runs.json")
