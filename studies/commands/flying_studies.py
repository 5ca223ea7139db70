"""The studies of `cfplan study` that fly, on the virtual Crazyflie or in the dry run's model."""

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from studies.commands.measured import JOBS, MINUTES, PATH, PATHS, Study, measured, safety_file_of, seed

if TYPE_CHECKING:
    from studies.runner.result import StudyResult


@measured(
    "flying", "cfplan study flights flights/*.yaml --repeats 5 --loss 0.05 -o results/flights.json",
    PATHS,
    click.option("--repeats", type=click.IntRange(1), default=1, show_default=True, help="Flights of each path."),
    click.option(
        "--loss", type=click.FloatRange(0, 1, max_open=True), default=0.0, show_default=True,
        help="Share of the radio's packets that are lost.",
    ),
    click.option("--pose-noise", type=click.FloatRange(0), default=0.001, show_default=True, help="Of each axis, m."),
    click.option("--vicon", is_flag=True, help="Poses by Vicon's protocol, as with --mocap vicon://lab/cf1."),
    click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of each path's first flight."),
    one_thread=False,
)  # fmt: skip
def flights() -> Study:
    """Fly every PATH on the virtual Crazyflie in real time, one flight after the other, each with other noise."""
    from studies.flights import fly_each
    from studies.real_time import Conditions

    def run(
        path_files: tuple[Path, ...], loss: float, pose_noise: float, vicon: bool, seed: int, **rest: Any
    ) -> "StudyResult":
        conditions = Conditions(loss, pose_noise, vicon, seed)
        return fly_each(path_files, safety_file_of, conditions=conditions, **rest)

    return run


@measured(
    "measuring", "cfplan study lateness flights/figure8.yaml -o results/lateness.json",
    PATH,
    click.option(
        "--seconds", type=click.FloatRange(1), default=60.0, show_default=True,
        help="Of streaming at least; behind the end of PATH the vehicle hovers.",
    ),
    one_thread=False,
)  # fmt: skip
def lateness() -> Study:
    """Measure how late setpoints are sent, with record, live view and Vicon, and how late a sleeper wakes.

    First by SCHED_FIFO, where the system permits it; then without, for which this command gives the permission up.
    """
    from studies.lateness import lateness_study

    def run(path_file: Path, **rest: Any) -> "StudyResult":
        return lateness_study(path_file, safety_file_of(path_file), **rest)

    return run


@measured(
    "flying", "cfplan study faults flights/line.yaml -o results/faults.json",
    PATH,
    click.option("--only", multiple=True, help="Faults whose name has this in it; may be given several times."),
    one_thread=False,
)  # fmt: skip
def faults() -> Study:
    """Fly along PATH with one fault a flight, at full speed, and judge what the pilot does about it."""
    from cfplan.preparation.prepare_flight import prepare_mission
    from cfplan.safety.limits_file import load_limits
    from studies.fault_scenarios import SCENARIOS
    from studies.faults import fault_table, prepare_held

    def run(path_file: Path, only: tuple[str, ...] = (), **rest: Any) -> "StudyResult":
        wanted = [row for row in SCENARIOS if not only or any(text in row.name for text in only)]
        mission = prepare_mission(path_file, load_limits(safety_file_of(path_file)))
        held = prepare_held(path_file, mission.limits) if any(row.planner for row in wanted) else None
        return fault_table(mission, path_file.stem, scenarios=wanted, held=held, **rest)

    return run


@measured(
    "flying", "cfplan study random-faults flights/*.yaml -o results/random-faults.json",
    PATHS,
    click.option("--flights", "count", type=click.IntRange(1), default=10_000, show_default=True),
    seed(0, "Of the first flight."),
    click.option(
        "--random-paths", type=click.IntRange(0), default=0, show_default=True,
        help="Small paths of two or three waypoints, beside those given.",
    ),
    MINUTES, JOBS,
)  # fmt: skip
def random_faults() -> Study:
    """Fly along each PATH in turn with one to three random faults, in two of five flights also a death, by seeds.

    What dies is the pilot or the radio. A flight of the tables is flown again by its seed, with the same paths.
    """
    from studies.random_faults import prepare_missions, random_flights

    def run(path_files: tuple[Path, ...], random_paths: int, **rest: Any) -> "StudyResult":
        missions = prepare_missions(path_files, safety_file_of, random_paths)
        return random_flights(missions, **_by_seeds(**rest))

    return run


@measured(
    "flying", "cfplan study steering --flights 40 --jobs 2 -o results/steering.json",
    click.option("--flights", "count", type=click.IntRange(1), default=40, show_default=True),
    click.option("--requests", type=click.IntRange(1), default=250, show_default=True, help="Of each flight."),
    click.option(
        "--seconds", type=click.FloatRange(1), default=90.0, show_default=True,
        help="Of each flight, in which they are asked for.",
    ),
    seed(0, "Of the first flight."), MINUTES, JOBS,
)  # fmt: skip
def steering() -> Study:
    """Steer the virtual Crazyflie by random requests, and judge every setpoint that was streamed.

    Requests extend, replace, stop, ask for what cannot be flown, or are garbage, at any moment and in bursts.
    """
    from studies.steering import steering as run_steering

    def run(**given: Any) -> "StudyResult":
        return run_steering(safety_file_of(Path()), **_by_seeds(**given))

    return run


def _by_seeds(count: int, first_seed: int, minutes: float = math.inf, **rest: Any) -> dict[str, Any]:
    """Return the arguments of a study whose flights are drawn by seeds."""
    return {"seeds": range(first_seed, first_seed + count), "minutes": minutes, **rest}


@measured(
    "flying", "cfplan study latency -o results/latency.json",
    click.option("--requests", type=click.IntRange(1), default=100, show_default=True, help="One at a time."),
    click.option(
        "--seconds", type=click.FloatRange(1.0), default=60.0, show_default=True, help="Of all other requests."
    ),
    click.option(
        "--rate", type=click.FloatRange(0.1, 1000.0), default=100.0, show_default=True, help="Of those, a second."
    ),
    seed(0, "Of the waypoints."),
)  # fmt: skip
def latency() -> Study:
    """Steer the virtual vehicle in real time: how soon requests change the motion, and how many a second may."""
    from studies.latency import latency as run

    return partial(run, safety_file_of(Path()))


COMMANDS = (flights, lateness, faults, random_faults, steering, latency)
