"""`cfplan bench`: compare planners on the user's paths."""

from pathlib import Path
from typing import Any

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json, print_table
from cfplan.errors import CfplanError
from cfplan.numbers import shown

TITLES = ["path", "planner", "flight", "against the fastest", "planning", "worst usage", "refused"]


@click.command(
    short_help="Compare planners on your paths.",
    epilog="Example: cfplan bench flights/slalom.yaml --planner expert --planner toppquad",
)
@click.argument("path_files", metavar="PATH...", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option(
    "--safety", "safety_file", type=click.Path(path_type=Path), help="Limits.  [default: the nearest safety.yaml]"
)
@click.option("--planner", "planners", multiple=True, help="Planner to compare; repeatable.  [default: all]")
@options.as_json
def bench(path_files: tuple[Path, ...], safety_file: Path | None, planners: tuple[str, ...], as_json: bool) -> None:
    """Plan each PATH with each planner, and compare certified flights and planning times.

    Each planner plans a path twice; only the second run is timed, as the first one loads machine code.
    """
    steps = Steps(as_json=as_json)
    limits = options.read_limits(safety_file, path_files[0], steps)
    with steps.waiting("loading planners"):
        from cfplan.geometry.path_file import load_path_file
        from cfplan.planning.path.choice import chosen_path
        from cfplan.planning.planners import PLANNERS, find_planner

    for name in planners:
        find_planner(name)
    paths = [load_path_file(file) for file in path_files]
    rows = []
    for path in paths:
        with steps.step(path.name) as results:
            path, _ = chosen_path(path, limits)
            own = [_row(path, name, limits) for name in planners or PLANNERS]
            fastest = min((row["duration"] for row in own if row["duration"]), default=None)
            results.append("refused by all" if fastest is None else f"{fastest:.3f} s at best")
        rows += [row | {"against_fastest": row["duration"] and row["duration"] / fastest - 1.0} for row in own]
    if as_json:
        print_json({"plans": rows})
    else:
        print_table("Certified flights by planner", TITLES, [_cells(row) for row in rows])


def _row(path_file: Any, planner: str, limits: Any) -> dict[str, Any]:
    """Plan one path with one planner and return the row; duration, s, is None if the path was refused."""
    from cfplan.planning.plan import plan

    row: dict[str, Any] = {"path": path_file.name, "planner": planner, "duration": None, "refused": ""}
    try:
        for _ in range(2):
            made = plan(
                path_file.path, limits.airframe, limits, planner=planner, yaw=path_file.yaw,
                yaw_angle=path_file.yaw_angle, speed_factor=path_file.speed,
            )  # fmt: skip
    except CfplanError as error:
        return row | {"seconds": None, "worst_usage": None, "refused": str(error)}
    return row | {
        "duration": made.trajectory.duration,
        "seconds": made.seconds,
        "worst_usage": made.certificate.worst.share,
    }


def _cells(row: dict[str, Any]) -> list[str]:
    if row["duration"] is None:
        return [row["path"], row["planner"], "", "", "", "", row["refused"]]
    return [
        row["path"], row["planner"], f"{row['duration']:.3f} s", f"{shown(100 * row['against_fastest'], '+.2f')} %",
        f"{1e3 * row['seconds']:.1f} ms", f"{shown(100 * row['worst_usage'], '.1f')} %", "",
    ]  # fmt: skip
