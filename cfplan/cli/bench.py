"""`cfplan bench` and `cfplan study`: measured comparisons, each one command and one JSON file."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cfplan.cli import options
from cfplan.cli.output import print_json, print_table
from cfplan.errors import InputError

if TYPE_CHECKING:
    from cfplan.flight.pilot.mission import Mission
    from cfplan.studies.result import StudyResult

_output = click.option("-o", "--output", type=click.Path(path_type=Path), help="Write the result here, as JSON.")
_yaw = click.option("--yaw", type=click.Choice(["fixed", "tangent", "free"]), default="free", show_default=True)
_boxes = click.option("--box", "boxes", multiple=True, help="4.5x8x2 or 10x10x10; may be given twice.  [default: both]")
_sets = click.option("--limits", "limit_sets", multiple=True, help="hardware or simulation.  [default: both]")
_nodes = click.option("--nodes", type=int, default=100, show_default=True, help="Grid intervals.")
_path = click.argument("path_file", metavar="PATH", type=click.Path(path_type=Path))
_paths = click.argument("path_files", metavar="PATH...", type=click.Path(path_type=Path), nargs=-1, required=True)

_earlier = click.option(
    "--add", "earlier_files", type=click.Path(path_type=Path), multiple=True,
    help="A result of other seeds, which the tables then count as well; may be given several times.",
)  # fmt: skip


def _count(default: int, text: str) -> Callable[..., Any]:
    return click.option("--paths", type=int, default=default, show_default=True, help=text)


def _seed(default: int, text: str = "Of the first path.") -> Callable[..., Any]:
    return click.option("--seed", "first_seed", type=int, default=default, show_default=True, help=text)


@click.command(
    short_help="Compare the planners on the same paths.",
    epilog="Example: cfplan bench --paths 20 --planner expert --planner toppquad",
)
@_count(100, "Random paths in each box with each set.")
@click.option("--planner", "planners", multiple=True, help="May be given several times.  [default: all]")
@_nodes
@_seed(0)
@_boxes
@_sets
@_yaw
@_output
@options.as_json
def bench(**given: Any) -> None:
    """Compare the planners on the same paths, in one run, on one thread."""
    _use_one_thread()
    from cfplan.studies.bench import bench as run

    _measure(run, "planning", given)


@click.group(short_help="Measurements for docs/results.")
def study() -> None:
    """Measure one thing, with tables for docs/results."""


@study.command(epilog="Example: cfplan study feasibility --paths 1000 -o results/feasibility.json")
@_count(1000, "Random paths in all.")
@click.option("--planner", default="expert", show_default=True)
@_nodes
@_boxes
@_sets
@_yaw
@_output
@options.as_json
def feasibility(**given: Any) -> None:
    """Count the plans that pass the dense certificate as they are, and what slowing costs the others."""
    _use_one_thread()
    from cfplan.studies.feasibility import dense_feasibility

    _measure(dense_feasibility, "planning", given)


@study.command(epilog="Example: cfplan study learned --paths 1000 -o results/learned.json")
@_count(1000, "Random paths in each box with each set.")
@_seed(20_000)
@_boxes
@_sets
@_output
@options.as_json
def learned(**given: Any) -> None:
    """Try the learned planner on unseen paths, against the expert: the network alone, repaired, in the dry run."""
    _use_one_thread()
    from cfplan.studies.learned import learned_study

    _measure(learned_study, "planning", given)


@study.command(epilog="Example: cfplan study proposals -o results/proposals.json")
@_count(60, "Random paths at each speed.")
@click.option("--box", default="4.5x8x2", show_default=True, help="4.5x8x2 or 10x10x10.")
@click.option("--limits", default="simulation", show_default=True, help="hardware or simulation; the speed is varied.")
@_seed(20_000)
@_output
@options.as_json
def proposals(**given: Any) -> None:
    """Refine what the network, the convex planner and the expert begin with to the same end: steps, time, failures."""
    _use_one_thread()
    from cfplan.studies.proposals import proposals as run

    _measure(run, "planning", given)


@study.command(name="unseen-limits", epilog="Example: cfplan study unseen-limits -o results/unseen-limits.json")
@_count(1000, "In each of four groups.")
@_output
@options.as_json
def unseen_limits(**given: Any) -> None:
    """Try the learned planner under limits and for vehicles that it has not learned from, against the expert."""
    _use_one_thread()
    from cfplan.studies.unseen_limits import unseen_limits as run

    _measure(run, "planning", given)


@study.command(epilog="Example: cfplan study ablation datasets/any -o results/ablation.json")
@click.argument("dataset", metavar="DATASET", type=click.Path(path_type=Path))
@click.option("--rows", type=int, default=10_000, show_default=True, help="Of the dataset, from which each learns.")
@click.option("--epochs", type=click.IntRange(1), default=6, show_default=True)
@_count(300, "Unseen, each under other limits.")
@_output
@options.as_json
def ablation(dataset: Path, **given: Any) -> None:
    """Train networks on DATASET for a short time, each without a part of what it sees of limits, and compare them."""
    _use_one_thread()
    from cfplan.studies.ablation import ablation as run

    _measure(partial(run, dataset), "training and planning", given)


@study.command(epilog="Example: cfplan study scaling -o results/scaling.json")
@click.option("--planner", default="expert", show_default=True)
@click.option("--repeats", type=int, default=5, show_default=True, help="Paths of each size.")
@_yaw
@_output
@options.as_json
def scaling(**given: Any) -> None:
    """Measure how planning time grows with the number of nodes, from 100 to 3,000."""
    _use_one_thread()
    from cfplan.studies.scaling import scaling as run

    _measure(run, "planning", given)


@study.command(name="long", epilog="Example: cfplan study long -o results/long.json")
@click.option(
    "--length", "lengths", type=click.FloatRange(10, 10_000), multiple=True,
    help="m; may be given several times, the first is compared with.  [default: 20 to 2000]",
)  # fmt: skip
@click.option("--paths", type=click.IntRange(1), default=3, show_default=True, help="Random paths of each length.")
@click.option("--limits", default="hardware", show_default=True, help="hardware or simulation.")
@_seed(20_000)
@_output
@options.as_json
def long_paths(**given: Any) -> None:
    """Plan paths of 1 to 100 times the usual length with the learned planner: time, memory, flights, joints.

    Beside it the expert, and TOPPQuad as far as it goes.
    """
    _use_one_thread()
    from cfplan.studies.long_paths import long_paths as run

    _measure(run, "planning", given)


@study.command(epilog="Example: cfplan study flights flights/*.yaml --repeats 5 --loss 0.05 -o results/flights.json")
@_paths
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
def flights(loss: float, pose_noise: float, vicon: bool, seed: int, **given: Any) -> None:
    """Fly every PATH on the virtual Crazyflie in real time, one flight after the other, each with other noise."""
    from cfplan.studies.flights import fly_each
    from cfplan.studies.real_time import Conditions

    def run(path_files: tuple[Path, ...], **rest: Any) -> "StudyResult":
        conditions = Conditions(loss, pose_noise, vicon, seed)
        return fly_each(path_files, _safety_file, conditions=conditions, **rest)

    _measure(run, "flying", given)


@study.command(epilog="Example: cfplan study lateness flights/figure8.yaml -o results/lateness.json")
@_path
@click.option(
    "--seconds", type=click.FloatRange(1), default=60.0, show_default=True,
    help="Of streaming at least; behind the end of PATH the vehicle hovers.",
)  # fmt: skip
@_output
@options.as_json
def lateness(**given: Any) -> None:
    """Measure how late setpoints are sent, with record, live view and Vicon, and how late a sleeper wakes.

    First by SCHED_FIFO, where the system permits it; then without, for which this command gives the permission up.
    """
    from cfplan.studies.lateness import lateness_study

    def run(path_file: Path, **rest: Any) -> "StudyResult":
        return lateness_study(path_file, _safety_file(path_file), **rest)

    _measure(run, "measuring", given)


@study.command(epilog="Example: cfplan study faults flights/line.yaml -o results/faults.json")
@_path
@click.option("--only", multiple=True, help="Faults whose name has this in it; may be given several times.")
@_output
@options.as_json
def faults(path_file: Path, only: tuple[str, ...], **given: Any) -> None:
    """Fly along PATH with one fault a flight, at full speed, and judge what the pilot does about it."""
    from cfplan.studies.fault_scenarios import SCENARIOS
    from cfplan.studies.faults import fault_table, prepare_held

    def run(**rest: Any) -> "StudyResult":
        wanted = [row for row in SCENARIOS if not only or any(text in row.name for text in only)]
        mission = _prepared_mission(path_file)
        held = prepare_held(path_file, mission.limits) if any(row.planner for row in wanted) else None
        return fault_table(mission, path_file.stem, scenarios=wanted, held=held, **rest)

    _measure(run, "flying", given)


@study.command(epilog="Example: cfplan study random-faults flights/*.yaml -o results/random-faults.json")
@_paths
@click.option("--flights", "count", type=click.IntRange(1), default=10_000, show_default=True)
@_seed(0, "Of the first flight.")
@click.option(
    "--random-paths", type=click.IntRange(0), default=0, show_default=True,
    help="Small paths of two or three waypoints, beside those given.",
)  # fmt: skip
@click.option("--minutes", type=click.FloatRange(0, min_open=True), help="Begin no flight after them.  [default: all]")
@_earlier
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True, help="Processes.")
@_output
@options.as_json
def random_faults(**given: Any) -> None:
    """Fly along each PATH in turn with one to three random faults, in two of five flights also a death, by seeds.

    What dies is the pilot or the radio. A flight of the tables is flown again by its seed, with the same paths.
    """
    _use_one_thread()
    from cfplan.studies.random_faults import prepare_missions, random_flights
    from cfplan.studies.result import read_result

    def run(
        path_files: tuple[Path, ...],
        count: int,
        first_seed: int,
        random_paths: int,
        earlier_files: tuple[Path, ...] = (),
        minutes: float | None = None,
        **rest: Any,
    ) -> "StudyResult":
        earlier = [read_result(file) for file in earlier_files]
        missions = prepare_missions(path_files, _safety_file, random_paths)
        seeds = range(first_seed, first_seed + count)
        return random_flights(missions, seeds=seeds, minutes=minutes or math.inf, earlier=earlier, **rest)

    _measure(run, "flying", given)


@study.command(epilog="Example: cfplan study steering --flights 40 --jobs 2 -o results/steering.json")
@click.option("--flights", "count", type=click.IntRange(1), default=40, show_default=True)
@click.option("--requests", type=click.IntRange(1), default=250, show_default=True, help="Of each flight.")
@click.option(
    "--seconds", type=click.FloatRange(1), default=90.0, show_default=True,
    help="Of each flight, in which they are asked for.",
)  # fmt: skip
@_seed(0, "Of the first flight.")
@click.option("--minutes", type=click.FloatRange(0, min_open=True), help="Begin no flight after them.  [default: all]")
@_earlier
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True, help="Processes.")
@_output
@options.as_json
def steering(**given: Any) -> None:
    """Steer the virtual Crazyflie by random requests, and judge every setpoint that was streamed.

    Requests extend, replace, stop, ask for what cannot be flown, or are garbage, at any moment and in bursts.
    """
    _use_one_thread()
    from cfplan.studies.result import read_result
    from cfplan.studies.steering import steering as run_steering

    def run(
        count: int, first_seed: int, earlier_files: tuple[Path, ...] = (), minutes: float | None = None, **rest: Any
    ) -> "StudyResult":
        earlier = [read_result(file) for file in earlier_files]
        seeds = range(first_seed, first_seed + count)
        return run_steering(_safety_file(Path()), seeds=seeds, minutes=minutes or math.inf, earlier=earlier, **rest)

    _measure(run, "flying", given)


@study.command(epilog="Example: cfplan study horizon --known 3 --known 5 -o results/horizon.json")
@_count(100, "Random paths.")
@click.option("--waypoints", type=click.IntRange(3), default=20, show_default=True, help="Of each path.")
@click.option(
    "--known", type=click.IntRange(1), multiple=True,
    help="Waypoints ahead that are known; may be given several times.  [default: 3]",
)  # fmt: skip
@_seed(0)
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True, help="Processes.")
@_output
@options.as_json
def horizon(**given: Any) -> None:
    """Plan along paths of which only the next waypoints are known, against knowing them all: time lost."""
    _use_one_thread()
    from cfplan.studies.horizon import horizon as run

    _measure(partial(run, _safety_file(Path())), "planning", given)


@study.command(epilog="Example: cfplan study latency -o results/latency.json")
@click.option("--requests", type=click.IntRange(1), default=100, show_default=True, help="One at a time.")
@click.option("--seconds", type=click.FloatRange(1.0), default=60.0, show_default=True, help="Of all other requests.")
@click.option("--rate", type=click.FloatRange(0.1, 1000.0), default=50.0, show_default=True, help="Of those, a second.")
@_seed(0, "Of the waypoints.")
@_output
@options.as_json
def latency(**given: Any) -> None:
    """Steer the virtual vehicle in real time: how soon requests change the motion, and how many a second may."""
    _use_one_thread()
    from cfplan.studies.latency import latency as run

    _measure(partial(run, _safety_file(Path())), "flying", given)


@study.command(epilog="Example: cfplan study link-loss flights/line.yaml flights/helix.yaml -o results/link-loss.json")
@_paths
@click.option(
    "--speed", "speeds", type=click.FloatRange(0, 1, min_open=True), multiple=True,
    help="Factor on the speed that the limits allow; may be given several times.  [default: 1, 0.6, 0.3]",
)  # fmt: skip
@_output
@options.as_json
def link_loss(path_files: tuple[Path, ...], **given: Any) -> None:
    """Simulate where the vehicle comes down if the pilot or the radio dies at the worst moment along each PATH."""
    from cfplan.studies.link_losses import link_losses

    _measure(partial(link_losses, path_files, _safety_file), "simulating", given)


@study.command(epilog="Example: cfplan study dry-runs flights/line.yaml flights/helix.yaml -o results/dry-runs.json")
@_paths
@_output
@options.as_json
def dry_runs(path_files: tuple[Path, ...], **given: Any) -> None:
    """Fly the bytes of each PATH in the dry run at motor lags of 0.07, 0.105 and 0.13 s: deviation from the plan."""
    _use_one_thread()
    from cfplan.studies.dry_runs import dry_runs as run

    _measure(partial(run, path_files, _safety_file), "simulating", given)


@study.command(epilog="Example: cfplan study physics flights/line.yaml flights/helix.yaml -o results/physics.json")
@_paths
@_output
@options.as_json
def physics(path_files: tuple[Path, ...], **given: Any) -> None:
    """Fly the bytes of each PATH by RotorPy and by drone-models, and compare with cfplan's own closed loop."""
    _use_one_thread()
    from cfplan.studies.physics import physics as run

    _measure(partial(run, path_files, _safety_file), "simulating", given)


@study.command(
    name="identification",
    epilog="Example: cfplan study identification flights/identify.yaml flights/figure8.yaml --vehicles 5",
)
@_path
@click.argument("next_file", metavar="NEXT", type=click.Path(path_type=Path))
@click.option("--vehicles", type=click.IntRange(1), default=30, show_default=True, help="Drawn by seeds.")
@_seed(0, "Of the first vehicle.")
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True, help="Processes.")
@_output
@options.as_json
def identification_study(path_file: Path, next_file: Path, **given: Any) -> None:
    """Identify drawn vehicles from one flight along PATH each, and fly NEXT with what was found."""
    from cfplan.studies.identification import identification

    _measure(partial(identification, path_file, next_file, _safety_file), "flying", given)


@study.command(epilog="Example: cfplan study giving-way flights/*.yaml -o results/giving-way.json")
@_paths
@click.option("--random", "paths", type=click.IntRange(0), default=200, show_default=True, help="Random paths besides.")
@_seed(0, "Of the first random path.")
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True, help="Processes.")
@_output
@options.as_json
def giving_way(path_files: tuple[Path, ...], **given: Any) -> None:
    """Simulate link loss at every setpoint along each PATH and random ones, before and after plans give way."""
    from cfplan.studies.giving_way import giving_way

    _measure(partial(giving_way, path_files, _safety_file(path_files[0])), "simulating", given)


@study.command(name="hard-paths", epilog="Example: cfplan study hard-paths --jobs 2 -o results/hard-paths.json")
@_count(1000, "Families take turns.")
@_seed(0)
@click.option(
    "--compare-every", type=click.IntRange(0), default=7, show_default=True,
    help="Of so many paths one is planned by the expert too, with all the time that it wants; 0: none.",
)  # fmt: skip
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True, help="Processes.")
@_output
@options.as_json
def hard_paths(**given: Any) -> None:
    """Plan adversarial paths under limits from a hundredth to ten times the usual: time, memory, what is refused."""
    _use_one_thread()
    from cfplan.studies.hard_paths import hard_paths as run

    _measure(partial(run, _safety_file(Path())), "planning", given)


_quick = click.option("--quick", is_flag=True, help="A few paths and epochs on data of its own: does it run?")
_data = click.option(
    "--data", type=click.Path(path_type=Path), default=Path("datasets/paper"), show_default=True,
    help="Dataset; its first 100 paths are for testing.",
)  # fmt: skip
_epochs = click.option("--epochs", type=click.IntRange(1), help="Of each training.  [default: 14]")
_networks = click.option(
    "--networks", type=click.Path(path_type=Path), default=Path("datasets/paper-networks"), show_default=True,
    help="Where networks are kept; those not there are trained.",
)  # fmt: skip


@study.command(epilog="Example: cfplan study architectures -o results/architectures.json")
@_count(100, "For training and for testing each.")
@click.option("--kind", "kinds", multiple=True, help="LSTM, Transformer, ETransformer or MLP.  [default: all]")
@_data
@_networks
@_epochs
@_quick
@_output
@options.as_json
def architectures(**given: Any) -> None:
    """Make the paper's Table 1: networks of four architectures, TOPPQuad, the expert and the network that ships.

    Training that was stopped goes on from its last epoch.
    """
    _use_one_thread()
    from cfplan.studies.paper.architectures import architectures as run

    _measure(run, "training and planning", given)


@study.command(epilog="Example: cfplan study inputs -o results/inputs.json")
@_count(100, "For training and for testing each.")
@_data
@_networks
@_epochs
@_quick
@_output
@options.as_json
def inputs(**given: Any) -> None:
    """Make the paper's table of inputs: an LSTM that sees position, velocity and acceleration of a path, or less."""
    _use_one_thread()
    from cfplan.studies.paper.inputs import inputs_study

    _measure(inputs_study, "training and planning", given)


@study.command(epilog="Example: cfplan study robustness -o results/robustness.json")
@_count(100, "For testing.")
@click.option("--draws", type=click.IntRange(1), default=10, show_default=True, help="Perturbations of each, each ε.")
@click.option("--model", "models", multiple=True, help="LSTM, LSTM-0.001, LSTM-0.01 or LSTM-0.1.  [default: all]")
@click.option(
    "--reference", type=click.Choice(["toppquad", "expert"]), default="toppquad", show_default=True,
    help="Whose travel times are compared with, on the path and on the perturbed one.",
)  # fmt: skip
@_data
@_networks
@_epochs
@_quick
@_output
@options.as_json
def robustness(**given: Any) -> None:
    """Make the paper's Table 2: networks and the planner that ships, asked about perturbed paths."""
    _use_one_thread()
    from cfplan.studies.paper.robustness import robustness as run

    _measure(run, "training and planning", given)


@study.command(epilog="Example: cfplan study baselines -o results/baselines.json")
@_count(50, "Random.")
@click.option(
    "--corridors", type=click.IntRange(2), default=2000, show_default=True, help="That the time allocation learns from."
)
@_seed(60_000)
@_data
@_networks
@_epochs
@_quick
@_output
@options.as_json
def baselines(**given: Any) -> None:
    """Make the paper's Table 3: TOPPQuad, networks and the planner that ships beside planners of other kinds."""
    _use_one_thread()
    from cfplan.studies.paper.baselines import baselines as run

    _measure(run, "training and planning", given)


@study.command(name="yaw-consistency", epilog="Example: cfplan study yaw-consistency -o results/yaw-consistency.json")
@click.option("--pairs", type=click.IntRange(1), default=100, show_default=True, help="Of random paths.")
@_seed(50_000)
@_output
@options.as_json
def yaw_consistency(**given: Any) -> None:
    """Make the paper's figure of yaw consistency: TOPPQuad on pairs of paths whose first waypoint is 0.1 m apart."""
    _use_one_thread()
    from cfplan.studies.paper.yaw_consistency import yaw_consistency as run

    _measure(run, "planning", given)


@study.command(epilog="Example: cfplan study paper results")
@click.argument("folder", metavar="[DIR]", type=click.Path(path_type=Path), default=Path("results"))
@_quick
def paper(folder: Path, quick: bool) -> None:
    """Make all tables of the paper: architectures, inputs, robustness, yaw, baselines; a result each in DIR.

    What was made by the same commit is kept, so that a run that was stopped goes on.
    """
    _use_one_thread()
    from rich.console import Console
    from rich.progress import Progress

    from cfplan.studies.paper.all_tables import paper_tables

    with Progress(console=Console(stderr=True)) as bar:

        def begin(name: str) -> Callable[[int, int], None]:
            task = bar.add_task(name, total=None)
            return lambda done, total: bar.update(task, completed=done, total=total)

        made = paper_tables(folder, quick=quick, begin=begin)
    for each in made:
        for table in each.result.tables:
            print_table(table.title, *table.cells())
    for each in made:
        how = "kept, of this commit" if each.kept else f"{each.seconds:.0f} s of the processor"
        click.echo(f"{each.file}: {how}")


@study.command(short_help="Write the tables of docs/ from results/.")
@click.argument("folder", metavar="[REPOSITORY]", type=click.Path(path_type=Path), default=Path())
def docs(folder: Path) -> None:
    """Write the tables of the pages in docs/ anew from the JSON in results/."""
    from cfplan.studies.docs_tables import write_tables

    for page in write_tables(folder):
        click.echo(page)


def _safety_file(path_file: Path) -> Path:
    return options.find_safety_file(None, path_file)


def _prepared_mission(path_file: Path) -> "Mission":
    from cfplan.preparation.prepare_flight import prepare_mission
    from cfplan.safety.limits_file import load_limits

    return prepare_mission(path_file, load_limits(_safety_file(path_file)))


def _use_one_thread() -> None:
    from cfplan.studies.machine import one_thread

    one_thread()


def _measure(run: Callable[..., "StudyResult"], what: str, given: dict[str, Any]) -> None:
    """Run a study with the options that were given, show its progress, then write and print its result."""
    from cfplan.studies.provenance import provenance

    output, as_json = given.pop("output"), given.pop("as_json")
    if output is not None and not output.parent.is_dir():  # before an hour is spent measuring
        raise InputError("no such folder", where=str(output.parent), hint="make it first")
    provenance()  # of the beginning
    chosen = {
        name: value for name, value in given.items() if value not in ((), None)
    }  # the rest is the study's own default
    if "yaw" in chosen:
        from cfplan.geometry.yaw import YawMode

        chosen["yaw"] = YawMode(chosen["yaw"])
    with _progress(what, as_json) as progress:
        result = run(**chosen, progress=progress)
    if output is not None:
        result.write(output)
    if as_json:
        print_json(result.to_json())
        return
    for table in result.tables:
        print_table(table.title, *table.cells())


@contextmanager
def _progress(what: str, as_json: bool) -> Iterator[Callable[[int, int], None]]:
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True, quiet=as_json)) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
