"""`cfplan bench` and `cfplan study`: measured comparisons, each one command and one JSON file."""

import json
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from cfplan.cli import options
from cfplan.cli.output import finite, print_json, print_table
from cfplan.errors import InputError

_output = click.option("-o", "--output", type=click.Path(path_type=Path), help="Write the result here, as JSON.")
_yaw = click.option("--yaw", type=click.Choice(["fixed", "tangent", "free"]), default="free", show_default=True)
_boxes = click.option("--box", "boxes", multiple=True, help="4.5x8x2 or 10x10x10; may be given twice.  [default: both]")
_sets = click.option("--limits", "limit_sets", multiple=True, help="hardware or simulation.  [default: both]")


@click.command(
    short_help="Compare the planners on the same paths.",
    epilog="Example: cfplan bench --paths 20 --planner expert --planner toppquad",
)
@click.option("--paths", type=int, default=100, show_default=True, help="Random paths in each box with each set.")
@click.option("--planner", "planners", multiple=True, help="May be given several times.  [default: all there are]")
@click.option("--nodes", type=int, default=100, show_default=True, help="Grid intervals.")
@click.option("--seed", "first_seed", type=int, default=0, show_default=True, help="Of the first path.")
@_boxes
@_sets
@_yaw
@_output
@options.as_json
def bench(yaw: str, output: Path | None, as_json: bool, **what: Any) -> None:
    """Compare the planners on the same paths, in one run, on one thread."""
    from cfplan.studies.machine import one_thread

    one_thread()
    from cfplan.geometry.yaw import YawMode
    from cfplan.studies.bench import bench as run

    _require_free(output)
    with _progress("planning", as_json) as progress:
        result = run(**_given(what), yaw=YawMode(yaw), command=_command(), progress=progress)
    _publish(result, output, as_json)


@click.group(short_help="Measurements for docs/studies.")
def study() -> None:
    """Measure one thing about the planners, with tables for docs/studies."""


@study.command(epilog="Example: cfplan study feasibility --paths 1000 -o docs/studies/feasibility.json")
@click.option("--paths", type=int, default=1000, show_default=True, help="Random paths in all.")
@click.option("--planner", default="expert", show_default=True)
@click.option("--nodes", type=int, default=100, show_default=True, help="Grid intervals.")
@_boxes
@_sets
@_yaw
@_output
@options.as_json
def feasibility(yaw: str, output: Path | None, as_json: bool, **what: Any) -> None:
    """How many plans pass the dense certificate as they are, and what slowing costs the others."""
    from cfplan.studies.machine import one_thread

    one_thread()
    from cfplan.geometry.yaw import YawMode
    from cfplan.studies.feasibility import dense_feasibility

    _require_free(output)
    with _progress("planning", as_json) as progress:
        result = dense_feasibility(**_given(what), yaw=YawMode(yaw), command=_command(), progress=progress)
    _publish(result, output, as_json)


@study.command(epilog="Example: cfplan study learned --paths 1000 -o docs/studies/learned.json")
@click.option("--paths", type=int, default=1000, show_default=True, help="Random paths in each box with each set.")
@click.option("--seed", "first_seed", type=int, default=20_000, show_default=True, help="Of the first path.")
@_boxes
@_sets
@_output
@options.as_json
def learned(output: Path | None, as_json: bool, **what: Any) -> None:
    """The learned planner on unseen paths, against the expert: the network alone, repaired, and in the dry run."""
    from cfplan.studies.machine import one_thread

    one_thread()
    from cfplan.studies.learned import learned_study

    _require_free(output)
    with _progress("planning", as_json) as progress:
        result = learned_study(**_given(what), command=_command(), progress=progress)
    _publish(result, output, as_json)


@study.command(epilog="Example: cfplan study scaling -o docs/studies/scaling.json")
@click.option("--planner", default="expert", show_default=True)
@click.option("--repeats", type=int, default=5, show_default=True, help="Paths of each size.")
@_yaw
@_output
@options.as_json
def scaling(yaw: str, output: Path | None, as_json: bool, **what: Any) -> None:
    """How planning time grows with the number of nodes, from 100 to 3,000."""
    from cfplan.studies.machine import one_thread

    one_thread()
    from cfplan.geometry.yaw import YawMode
    from cfplan.studies.scaling import scaling as run

    _require_free(output)
    with _progress("planning", as_json) as progress:
        result = run(**_given(what), yaw=YawMode(yaw), command=_command(), progress=progress)
    _publish(result, output, as_json)


@study.command(name="long", epilog="Example: cfplan study long -o docs/studies/long.json")
@click.option(
    "--length", "lengths", type=click.FloatRange(10, 10_000), multiple=True,
    help="m; may be given several times, the first is compared with.  [default: 20, 50, 100, 200, 500, 1000]",
)  # fmt: skip
@click.option("--paths", type=click.IntRange(1), default=3, show_default=True, help="Random paths of each length.")
@click.option("--limits", default="hardware", show_default=True, help="hardware or simulation.")
@click.option("--seed", "first_seed", type=int, default=20_000, show_default=True, help="Of the first path.")
@_output
@options.as_json
def long_paths(output: Path | None, as_json: bool, **what: Any) -> None:
    """The learned planner on paths of up to a kilometre: time, memory, and flight time against the expert's."""
    from cfplan.studies.machine import one_thread

    one_thread()
    from cfplan.studies.long_paths import long_paths as run

    _require_free(output)
    with _progress("planning", as_json) as progress:
        result = run(**_given(what), command=_command(), progress=progress)
    _publish(result, output, as_json)


@study.command(
    epilog="Example: cfplan study flights flights/*.yaml --repeats 5 --loss 0.05 -o docs/studies/flights.json"
)
@click.argument("path_files", metavar="PATH...", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option("--repeats", type=click.IntRange(1), default=1, show_default=True, help="Flights of each path.")
@click.option(
    "--loss", type=click.FloatRange(0, 1, max_open=True), default=0.0, show_default=True,
    help="Share of the radio's packets that are lost.",
)  # fmt: skip
@click.option("--pose-noise", type=click.FloatRange(0), default=0.001, show_default=True, help="Of each axis, m.")
@click.option("--vicon", is_flag=True, help="Poses by Vicon's protocol, as with --mocap vicon://lab/cf1.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of each path's first flight.")
@_output
@options.as_json
def flights(
    path_files: tuple[Path, ...],
    repeats: int,
    loss: float,
    pose_noise: float,
    vicon: bool,
    seed: int,
    output: Path | None,
    as_json: bool,
) -> None:
    """Fly every PATH on the virtual Crazyflie in real time, one flight after the other, each with other noise."""
    from cfplan.studies.flights import fly_each
    from cfplan.studies.real_time import Conditions

    _require_free(output)
    with _progress("flying", as_json) as progress:
        result = fly_each(
            path_files,
            lambda path_file: options.find_safety_file(None, path_file),
            repeats=repeats,
            conditions=Conditions(loss, pose_noise, vicon, seed),
            command=_command(),
            progress=progress,
        )
    _publish(result, output, as_json)


@study.command(epilog="Example: cfplan study lateness flights/figure8.yaml -o docs/studies/lateness.json")
@click.argument("path_file", metavar="PATH", type=click.Path(path_type=Path))
@click.option(
    "--seconds", type=click.FloatRange(1), default=60.0, show_default=True,
    help="Of streaming at least; behind the end of PATH the vehicle hovers.",
)  # fmt: skip
@_output
@options.as_json
def lateness(path_file: Path, seconds: float, output: Path | None, as_json: bool) -> None:
    """How late setpoints are sent, with record, live view and Vicon; beside it, how late this computer wakes a sleeper.

    First by SCHED_FIFO, where the system permits it; then without, for which this command gives the permission up.
    """
    from cfplan.studies.lateness import lateness_study

    _require_free(output)
    with _progress("measuring", as_json) as progress:
        safety_file = options.find_safety_file(None, path_file)
        result = lateness_study(path_file, safety_file, seconds, command=_command(), progress=progress)
    _publish(result, output, as_json)


@study.command(epilog="Example: cfplan study faults flights/line.yaml -o docs/studies/faults.json")
@click.argument("path_file", metavar="PATH", type=click.Path(path_type=Path))
@click.option("--only", multiple=True, help="Rows whose name has this in it; may be given several times.")
@_output
@options.as_json
def faults(path_file: Path, only: tuple[str, ...], output: Path | None, as_json: bool) -> None:
    """Let something go wrong at full speed along PATH, one fault a flight, and see what the pilot makes of it."""
    from cfplan.studies.fault_scenarios import SCENARIOS
    from cfplan.studies.faults import fault_table
    from cfplan.studies.missions import plan_mission

    _require_free(output)
    wanted = [row for row in SCENARIOS if not only or any(text in row.name for text in only)]
    with _progress("flying", as_json) as progress:
        mission = plan_mission(path_file, options.find_safety_file(None, path_file))
        result = fault_table(mission, path_file.stem, scenarios=wanted, command=_command(), progress=progress)
    _publish(result, output, as_json)


@study.command(epilog="Example: cfplan study random-faults flights/*.yaml -o docs/studies/random-faults.json")
@click.argument("path_files", metavar="PATH...", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option("--flights", "count", type=click.IntRange(1), default=200, show_default=True)
@click.option("--seed", "first_seed", type=int, default=0, show_default=True, help="Of the first flight.")
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True, help="Processes.")
@_output
@options.as_json
def random_faults(
    path_files: tuple[Path, ...], count: int, first_seed: int, jobs: int, output: Path | None, as_json: bool
) -> None:
    """Faults by chance along each PATH in turn: kind, moment, length and size drawn by seeds."""
    from cfplan.studies.missions import plan_mission
    from cfplan.studies.random_faults import random_flights

    _require_free(output)
    with _progress("flying", as_json) as progress:
        missions = {file.stem: plan_mission(file, options.find_safety_file(None, file)) for file in path_files}
        seeds = range(first_seed, first_seed + count)
        result = random_flights(missions, seeds=seeds, jobs=jobs, command=_command(), progress=progress)
    _publish(result, output, as_json)


def _given(what: dict[str, Any]) -> dict[str, Any]:
    """What was not given is left to the study's own default."""
    return {name: value for name, value in what.items() if value != ()}


def _command() -> str:
    return shlex.join(["cfplan", *sys.argv[1:]])


@contextmanager
def _progress(what: str, as_json: bool) -> Iterator[Callable[[int, int], None]]:
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True, quiet=as_json)) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _require_free(output: Path | None) -> None:
    """Before an hour is spent measuring."""
    if output is not None and not output.parent.is_dir():
        raise InputError("no such folder", where=str(output.parent), hint="make it first")


def _publish(result: Any, output: Path | None, as_json: bool) -> None:
    document = result.to_dict()
    if output is not None:
        output.write_text(json.dumps(finite(document), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    if as_json:
        print_json(document)
    else:
        for title, columns, rows in result.tables():
            print_table(title, columns, rows)
