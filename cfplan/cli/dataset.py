"""`cfplan dataset`: make and inspect datasets of labelled paths."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cfplan.cli import options
from cfplan.cli.output import print_json, print_table
from cfplan.errors import InputError

if TYPE_CHECKING:
    from rich.progress import Progress

    from cfplan.learning.dataset_spec import DatasetSpec


@click.group(short_help="Make and inspect labelled paths for training.")
def dataset() -> None:
    """Make and inspect datasets of paths labelled by the expert or TOPPQuad."""


def _boxes(_: click.Context, __: click.Parameter, texts: tuple[str, ...]) -> tuple[tuple[float, ...], ...]:
    return tuple(_box(text) for text in texts)


def _box(text: str) -> tuple[float, ...]:
    try:
        sides = tuple(float(side) for side in text.split("x"))
    except ValueError:
        sides = ()
    if len(sides) != 3:
        raise click.BadParameter(f"{text!r} is not a box: write length x width x height in metres, as 4.5x8x2")
    return sides


def _range(_: click.Context, __: click.Parameter, text: str) -> tuple[int, ...]:
    try:
        bounds = tuple(int(bound) for bound in text.split("-"))
    except ValueError:
        bounds = ()
    if len(bounds) != 2:
        raise click.BadParameter(f"{text!r} is not a range: write the smallest and the largest number, as 3-6")
    return bounds


@dataset.command(epilog="Example: cfplan dataset make datasets/any --count 50000 --workers 2")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--count", type=int, required=True, help="Number of clean paths.")
@click.option(
    "--limits",
    default="drawn",
    show_default=True,
    help="Limits and vehicle: drawn (for each path), hardware (2 m/s), simulation or paper (5 m/s).",
)
@click.option(
    "--safety", type=click.Path(path_type=Path), help="Take vehicle and limits from this safety.yaml instead."
)
@click.option("--seed", type=click.IntRange(0, 2**63 - 1), default=0, show_default=True)
@click.option(
    "--box",
    "boxes",
    callback=_boxes,
    multiple=True,
    help="Draw waypoints in a box of this size, m, e.g. 4.5x8x2, instead of all path families; repeatable.",
)
@click.option(
    "--waypoints", callback=_range, default="3-6", show_default=True, help="Range of the number of waypoints."
)
@click.option(
    "--shape",
    type=click.Choice(["min-snap", "fastest", "any"]),
    default="min-snap",
    show_default=True,
    help="Path through the waypoints: minimum snap, the fastest in a drawn room, or any of the two.",
)
@click.option("--nodes", type=int, default=100, show_default=True, help="Grid intervals.")
@click.option("--yaw", type=click.Choice(["any", "fixed", "tangent", "free"]), default="any", show_default=True)
@click.option("--epsilon", type=float, default=0.0, help="Largest displacement of a copy's nodes, m.")
@click.option("--copies", type=int, default=0, help="Number of perturbed copies of each path.")
@click.option(
    "--relabel",
    type=click.Choice(["solve", "keep"]),
    default="solve",
    show_default=True,
    help="Label of a copy: solve anew, or keep that of the clean path.",
)
@click.option(
    "--planner",
    type=click.Choice(["expert", "toppquad"]),
    default="expert",
    show_default=True,
    help="Planner that computes the labels.",
)
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="Number of processes.")
@click.option("--scheduler", help="Address of a Dask cluster to label on instead, tcp://host:port.")
@options.as_json
def make(folder: Path, workers: int, scheduler: str | None, as_json: bool, **what: Any) -> None:
    """Make the dataset DIR, or complete it.

    The same options give the same rows with any number of workers; a failed solve is a row with its reason.
    """
    from cfplan.learning.dataset import make_dataset
    from cfplan.planning.path.search import fastest_by_search

    spec = _spec(what)
    with _progress(as_json) as progress:
        task = progress.add_task("labelling", total=spec.rows)
        make_dataset(
            folder,
            spec,
            choose=fastest_by_search,
            workers=workers,
            scheduler=scheduler,
            on_rows=lambda rows: progress.advance(task, rows),
        )
    if as_json:
        print_json({"folder": str(folder), "rows": spec.rows})
    else:
        click.echo(f"{spec.rows} rows in {folder}; look at them with: cfplan dataset info {folder}")


def _spec(what: dict[str, Any]) -> "DatasetSpec":
    """Return the dataset's spec from the options."""
    from cfplan.geometry.path_families import USUAL
    from cfplan.geometry.path_file import PathShape
    from cfplan.geometry.yaw import YawMode
    from cfplan.learning.dataset_spec import DRAWN, GIVEN, DatasetSpec, Labeller, Relabel
    from cfplan.safety.limit_sets import DATA_SETS
    from cfplan.safety.limits_file import load_limits

    file, limits, yaw, shape = what.pop("safety"), what["limits"], what["yaw"], what["shape"]
    if limits not in (DRAWN, *DATA_SETS):
        known = ", ".join((DRAWN, *DATA_SETS))
        raise InputError(f"no limit set {limits!r}", where="--limits", hint=f"one of {known}; or --safety FILE")
    if file is not None and limits != DRAWN:
        raise InputError("limits are given twice", where="--safety", hint="leave --limits out")
    given = {}
    if file is not None:
        read = load_limits(file)
        given = {"limits": GIVEN, "airframe": read.airframe, "plan": read.plan}
    return DatasetSpec(
        **what | given | {
            "families": () if what["boxes"] else USUAL, "yaw": None if yaw == "any" else YawMode(yaw),
            "shape": None if shape == "any" else PathShape(shape),
            "relabel": Relabel(what["relabel"]), "planner": Labeller(what["planner"]),
        },
    )  # fmt: skip


def _progress(as_json: bool) -> "Progress":
    """Return a progress bar with rows per second and the time left."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )

    class Rate(ProgressColumn):
        def render(self, task: Task) -> str:
            return f"{task.speed:.0f} rows/s" if task.speed else "– rows/s"

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), Rate(), TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True, quiet=as_json))


@dataset.command(
    short_help="Show counts, failures and distributions.", epilog="Example: cfplan dataset info datasets/hardware"
)
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@options.as_json
def info(folder: Path, as_json: bool) -> None:
    """Show counts, failures, and distributions of length, time, speed and active limits of the dataset DIR."""
    from cfplan.learning.dataset import DISTRIBUTIONS, PERCENTILES, describe

    found = describe(folder)
    if as_json:
        print_json(found)
        return
    spec = found["spec"]
    click.echo(
        f"{folder}: {found['rows']} of {found['rows_wanted']} rows, limits {spec['limits']}, seed {spec['seed']}"
    )
    click.echo(f"solved {found['solved']}, failed {found['failed'] or 0}")
    click.echo(
        f"certified as they are {found['certified_as_they_are']}, slowed {found['certified_when_slowed']}, "
        f"never {found['never_certified']}"
    )
    rows = []
    for name, unit in DISTRIBUTIONS.items():
        values = found["percentiles"][name]
        rows.append([f"{name.replace('_', ' ')} {unit}".strip(), *(_short(values[str(p)]) for p in PERCENTILES)])
    print_table("Distributions", ["", *(f"p{p}" for p in PERCENTILES)], rows)
    active = [[name, f"{100 * fraction:.1f} %"] for name, fraction in found["active_limits"].items()]
    print_table("Limits that are active somewhere on the path", ["limit", "of solved paths"], active)


def _short(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"
