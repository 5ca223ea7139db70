"""Make the paper's hardware tables in the stepped lab: TOPPQuad, networks and the shipped planner.

There are eight paths in a motion capture room, the first a straight line, and a long one, with several flights of each
that differ in the noise of sensors, cameras and radio. The paper states two sets of limits, and both are used. Flights
are as planned, which cfplan otherwise refuses, and certified, as cfplan flies them. Room, vehicle and all other limits
are those that `cfplan init` writes. Missing datasets and networks are made, in one folder per set of
limits; interrupted work resumes. Poses are kept for the first set, for the figures.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count as numbers
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np

from cfplan.errors import CfplanError, ExitCode
from cfplan.flight.pilot.mission import Mission, mission_of
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.setpoints.encoding import EncodedFlight, encode_trajectory
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.telemetry import Phase, PhaseEntered, PoseReceived, Telemetry
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import random_waypoints
from cfplan.geometry.yaw import YawMode
from cfplan.learning.dataset import make_dataset
from cfplan.learning.dataset_spec import GIVEN, DatasetSpec
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan import plan
from cfplan.planning.plan_result import Plan
from cfplan.planning.planners import AUTO, default_nodes
from cfplan.planning.repair import repair
from cfplan.preparation.plan_flight import PlannedFlight, give_way
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.safety.limit_sets import BOXES
from cfplan.safety.limits import Ladder, Limits
from cfplan.safety.limits_file import DEFAULTS, load_limits
from cfplan.safety.space import check_space
from cfplan.simulation.geometric_flight import LOST
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.vehicle.trajectory import Trajectory
from studies.giving_way import random_paths
from studies.paper.printed import HARDWARE, paper_column
from studies.paper.sequences import read_sequences
from studies.paper.trained import (
    EPOCHS,
    NODES,
    QUICK,
    QUICK_EPOCHS,
    QUICK_PATHS,
    TRAINING_COLUMNS,
    WAYPOINTS,
    TrainedNetwork,
    identities,
    trained_networks,
)
from studies.paper.training import SequenceOptions
from studies.paper.trials import TOPPQUAD, failed, flown, network_plan, profile_of
from studies.runner.options import option
from studies.runner.reductions import among, count, largest, mean
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work
from studies.stepped_flight import FOR_GOOD, Scenario, fly_stepped

DATA = FilePath("datasets/paper-hardware")  # one folder per set of limits, with its dataset and networks
NOISES = (0.001, 0.01, 0.1)  # m, noise injected in training the LSTMs that the paper flew
SHIPPED = "the shipped planner"
TOPPQUAD_FLIGHTS, LEARNED_FLIGHTS = 4, 5  # of each path
LOSS = 0.05  # of radio packets
LINE, LONG = "1", "long"
THE_LINE = np.array([[-1.4, -2.8, 0.8], [1.4, 2.8, 1.2]])  # m
LONG_WAYPOINTS, LONG_WALL_DISTANCE = 16, 0.35  # number of waypoints, and m that they keep from the margin
LIMITS = {"appendix": (5.0, 8.0), "text": (10.0, 10.0)}  # m/s² and rad/s, by where the paper states them
RAW, CERTIFIED = "as planned", "certified"
TRACKED = next(iter(LIMITS))  # the limits whose flights are drawn
TRACK_SPACING = 0.1  # s between two kept poses


@dataclass(frozen=True, slots=True)
class Settings:
    """The paths to fly, and the training of the networks."""

    paths: int = option(8, "Paths in the room, the first a straight line; the long one is flown besides.", least=1)
    learned_from: int = option(9000, "Paths that networks learn from, for each set of limits.", least=10)
    data: FilePath = option(DATA, "Folder of datasets and networks; missing ones are made.")
    limits: tuple[str, ...] = option(tuple(LIMITS), "Set of limits that the paper states.", choices=tuple(LIMITS))
    epochs: int | None = option(None, EPOCHS, least=1)
    quick: bool = option(False, QUICK)


@dataclass(frozen=True, slots=True)
class HardwareFlight:
    """One flight. NaN where there was nothing to measure."""

    limits: str
    way: str  # RAW or CERTIFIED
    planner: str
    path: str
    trial: int
    reason: str = ""  # why there is no flight, or why it did not land at the end of its path
    travel_time: float = np.nan  # s, planned
    deviation: float = np.nan  # m, largest distance of the poses from the setpoint of the same time
    settled: float = np.nan  # s after the end of the motion; inf if it did not settle
    points: list[list[int]] = field(default_factory=list)  # mm, poses along the path, if the figure shows them
    training: Mapping[str, Any] | None = None  # of the network that planned


class _Poses:
    """Keeps a pose every TRACK_SPACING while the path is flown."""

    def __init__(self) -> None:
        self.points: list[list[int]] = []
        self._flying, self._next = False, -np.inf

    def hear(self, message: Telemetry) -> None:
        match message:
            case PhaseEntered(phase=phase):
                self._flying = phase is Phase.STREAM
            case PoseReceived(time=time, position=position) if self._flying and time >= self._next:
                self.points.append([round(1000.0 * float(value)) for value in position])
                self._next = time + TRACK_SPACING


def work(settings: Settings, run: Run) -> Work:
    """Return one case per plan, which is flown several times; datasets and networks are made if necessary.

    Raises InputError if the folder holds other data or networks.
    """
    usual = load_limits(DEFAULTS)
    paths = hardware_paths(usual, settings.paths) | ({} if settings.quick else {LONG: long_path(usual)})
    networks = {name: _networks(settings, run, name) for name in settings.limits[: 1 if settings.quick else None]}
    identity = {name: identities(own.values()) for name, own in networks.items()}
    most = 1 if settings.quick else LEARNED_FLIGHTS
    return Work(plans_of(networks, paths), partial(measure, networks, paths, most), HardwareFlight, identity)


def _networks(settings: Settings, run: Run, name: str) -> dict[str, TrainedNetwork]:
    """Return the networks for one set of limits."""
    spec = hardware_spec(paper_limits(load_limits(DEFAULTS), name), settings.learned_from)
    folder, noises, epochs = settings.data / name, NOISES[: 1 if settings.quick else None], settings.epochs
    if settings.quick:
        spec, folder, epochs = replace(spec, count=QUICK_PATHS // 2), run.scratch, QUICK_EPOCHS
    done = 0

    def show(rows: int) -> None:
        nonlocal done
        done += rows
        run.progress(done, spec.rows)

    make_dataset(folder / "data", spec, workers=run.workers, scheduler=run.scheduler, on_rows=show)
    known, wanted = read_sequences(folder / "data").learned_from(0), [SequenceOptions(epsilon=each) for each in noises]
    return {each.name: each for each in trained_networks(known, folder, wanted, run, epochs)}


def paper_limits(usual: Limits, name: str) -> Limits:
    """Return `usual` with the paper's plan limits, and flight limits raised to stay above them."""
    acceleration, angular_velocity = LIMITS[name]
    flight = usual.flight
    return replace(
        usual,
        plan=replace(usual.plan, acceleration=acceleration, angular_velocity=angular_velocity),
        flight=replace(
            flight,
            acceleration=_above(acceleration, flight.acceleration),
            angular_velocity=_above(angular_velocity, flight.angular_velocity),
        ),
    )


def _above(planned: float, ladder: Ladder) -> Ladder:
    """Return the ladder, scaled up if necessary so that braking begins at no less than 1.5 times the planned value."""
    factor = max(1.0, 1.5 * planned / ladder.brake)
    return Ladder(factor * ladder.brake, factor * ladder.land, factor * ladder.cut)


def hardware_spec(limits: Limits, learned_from: int) -> DatasetSpec:
    """Return the spec of the dataset that the networks learn from: the paper's paths, in its training box."""
    return DatasetSpec(
        count=learned_from, seed=1, limits=GIVEN, airframe=limits.airframe, plan=limits.plan, families=(),
        boxes=(BOXES["10x10x10"],), waypoints=(WAYPOINTS, WAYPOINTS), nodes=NODES, yaw=YawMode.FREE,
    )  # fmt: skip


def hardware_paths(limits: Limits, number: int) -> dict[str, Path]:
    """Return paths within the room, the first a straight line, by their names in the tables."""
    paths = [min_snap(THE_LINE), *(path for _, path in random_paths(limits, 0, number - 1))]
    return {str(k): path for k, path in enumerate(paths, start=1)}


def long_path(limits: Limits) -> Path:
    """Return a path within the room that is several times as long."""
    distance = limits.space.margin + LONG_WALL_DISTANCE
    box = np.array([limits.space.low, limits.space.high]) + np.array([[distance], [-distance]])
    for seed in numbers():
        path = min_snap(random_waypoints(seed, box, (LONG_WAYPOINTS, LONG_WAYPOINTS)))
        with suppress(CfplanError):  # the path leaves the space between its waypoints, or has a cusp
            path.check()
            check_space(path, limits.space)
            return path
    raise AssertionError


class FlownPlan(NamedTuple):
    """One plan, flown several times."""

    limits: str
    way: str
    planner: str
    path: str


Networks = Mapping[str, Mapping[str, TrainedNetwork]]  # by limits and name


def plans_of(networks: Networks, paths: Iterable[str]) -> dict[str, FlownPlan]:
    """Return the plans by case name. Networks do not plan the long path; the shipped planner only flies certified."""
    plans = [
        FlownPlan(limits, way, planner, path)
        for limits, own in networks.items()
        for way in (RAW, CERTIFIED)
        for planner in (TOPPQUAD, *own, SHIPPED)
        for path in paths
        if (way == CERTIFIED or planner != SHIPPED) and (path != LONG or planner not in own)
    ]
    return {" ".join(each): each for each in plans}


def measure(networks: Networks, paths: Mapping[str, Path], most: int, asked: FlownPlan) -> list[HardwareFlight]:
    """Plan once, and fly the plan as often as the paper does, at most `most` times."""
    network, limits = networks[asked.limits].get(asked.planner), paper_limits(load_limits(DEFAULTS), asked.limits)
    flights = min(most, TOPPQUAD_FLIGHTS if asked.planner == TOPPQUAD else LEARNED_FLIGHTS)
    training = network.training if network else None
    begun = [HardwareFlight(*asked, trial, training=training) for trial in range(flights)]
    try:
        encoded, trajectory = encoded_plan(asked.way, asked.planner, network, paths[asked.path], limits)
    except CfplanError as error:
        return [replace(flight, reason=str(error)) for flight in begun]
    if asked.way == RAW:  # the pilot ends flights that are LOST; in the paper they crash
        limits = replace(limits, flight=replace(limits.flight, deviation=Ladder(LOST, 1.5 * LOST, 2.0 * LOST)))
    mission, seed = mission_of(encoded, limits), 10 * list(paths).index(asked.path)
    return [_flown(replace(flight, travel_time=trajectory.duration), mission, seed + flight.trial) for flight in begun]


def encoded_plan(
    way: str, planner: str, network: TrainedNetwork | None, path: Path, limits: Limits
) -> tuple[EncodedFlight, Trajectory]:
    """Plan with TOPPQuad, a network or the shipped planner, and encode the flight. Raises CfplanError."""
    task = PlanningTask(path, limits.airframe, limits.plan, max(NODES, default_nodes(path)), YawMode.FREE)
    if way == RAW:
        profile = network_plan(network)(path) if network else profile_of(plan_toppquad, task)
        trajectory = Trajectory(path, profile, limits.airframe)
        return encode_trajectory(trajectory, gains=gains_under(limits), space=limits.space), trajectory
    if network:
        found = repair(task, network_plan(network)(path), limits.space)
        planned = Plan(
            path, limits.airframe, limits, found.trajectory, found.certificate, planner, NODES, found.speed_factor,
            speed_factor=1.0, seconds=0.0, notes=(),
        )  # fmt: skip
    else:
        wanted = "toppquad" if planner == TOPPQUAD else AUTO
        planned = plan(path, limits.airframe, limits, planner=wanted, yaw=YawMode.FREE)
        if wanted not in (AUTO, planned.planner):
            raise CfplanError("; ".join(planned.notes), hint="plan by another planner")
    certified = give_way(planned)[0]
    return encode_flight(PlannedFlight(planner, certified, limits)), certified.trajectory


def _flown(flight: HardwareFlight, mission: Mission, seed: int) -> HardwareFlight:
    """Fly a mission in the stepped lab, and return the flight with its results."""
    lossy = (RadioFault(RadioFaultKind.LOSS, 0.0, FOR_GOOD, LOSS),)
    vehicle = VehicleSettings(auto_arming=False, seed=seed)
    scenario, poses = Scenario("", Rung.NONE, lossy, from_start=True, vehicle=vehicle), _Poses()
    found = fly_stepped(scenario, mission, seed=seed, listen=poses.hear)
    outcome = found.outcome
    if _is_drawn(flight):
        flight = replace(flight, points=poses.points)
    if outcome is None or outcome.exit_code is not ExitCode.OK:
        return replace(flight, reason=found.reason)
    return replace(flight, deviation=outcome.deviation.max, settled=outcome.settled_after)


def _is_drawn(flight: HardwareFlight) -> bool:
    """Return whether a figure shows the flight: TOPPQuad's, a network's, or the shipped planner's on the long path."""
    return flight.limits == TRACKED and (flight.planner != SHIPPED or flight.path == LONG)


COLUMNS = (
    Column("limits", "limits"),
    Column("way", "plans"),
    Column("planner", "planner"),
    Column("flights", value=count()),
    Column("deviation", "largest deviation: mean", "m", ".3f", meaning="over flights that did not fail, by the poses",
           value=among(flown, mean("deviation"))),
    Column("deviation_most", "of all", "m", ".3f", value=among(flown, largest("deviation"))),
    paper_column(HARDWARE, "deviation", ("planner",), "m", ".3f"),
    Column("travel_time", "travel time", "s", ".2f", meaning="planned, mean over those flights",
           value=among(flown, mean("travel_time"))),
    Column("settled", "settling", "s", ".2f", meaning="after that, until it stays near the end",
           value=among(flown, mean("settled"))),
    paper_column(HARDWARE, "time", ("planner",), "s", ".2f", "with settling, along other paths"),
    Column("failed", "failures", of="flights", meaning=f"no plan, ended by the pilot, or {LOST:g} m from its place",
           value=count(failed)),
)  # fmt: skip


def tables(settings: Settings, rows: list[HardwareFlight]) -> Iterator[Table]:
    """Yield the paper's table, the same for the straight line and the long path alone, and the trainings."""
    number = len({row.path for row in rows} - {LONG})
    pairs = ", ".join("{} {:g} m/s² and {:g} rad/s".format(name, *LIMITS[name]) for name in settings.limits)
    title = f"{number} paths in the room, 2 m/s; limits: {pairs}"
    by = ("limits", "way", "planner")
    yield table("hardware", title, COLUMNS, [row for row in rows if row.path != LONG], by=by)
    alone = [column for column in COLUMNS if not column.key.startswith("paper_")]
    for name, path, title in (("line", LINE, "The straight line among them, alone"), ("long", LONG, "The long path")):
        yield table(name, title, alone, [row for row in rows if row.path == path], by=by)
    trained = (Column("limits", "limits"), Column("network", "network", value=lambda rows: rows[0].planner))
    yield table(
        "training", "Networks", (*trained, *TRAINING_COLUMNS), [row for row in rows if row.training],
        by=("limits", "planner"),
    )  # fmt: skip


STUDY = Study(Settings, work, tables, "-o results/hardware.json")
