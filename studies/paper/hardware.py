"""The paper's hardware tables, on the virtual lab: TOPPQuad and learned plans, flown by the pilot with poses by Vicon.

Eight paths in a motion capture room, the first a straight line, and a long one; several flights of each, which differ
by the noise of sensors, cameras and radio. The paper states two sets of limits, so there are two. Plans are flown in
two ways: as they are, which cfplan otherwise refuses, and certified, as cfplan flies them. Room, vehicle and all other
limits are those that `cfplan init` writes. Of the first set the poses are kept, for the figures of the tracks.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np

from cfplan.errors import CfplanError, ExitCode, InputError
from cfplan.flight.pilot.mission import Mission, mission_of
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.telemetry import Phase, PhaseEntered, PoseReceived, Telemetry
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import random_waypoints
from cfplan.geometry.yaw import YawMode
from cfplan.learning.dataset_spec import GIVEN, DatasetSpec
from cfplan.learning.paper.training import SequenceOptions
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan import plan
from cfplan.planning.plan_result import Plan as CertifiedPlan
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
from studies.fault_scenarios import FOR_GOOD, Scenario
from studies.faults import fly_stepped
from studies.giving_way import random_paths
from studies.runner.items import HERE, Progress, Running, work_table, work_through
from studies.paper.architectures import training_steps
from studies.paper.networks import (
    NODES,
    WAYPOINTS,
    TrainedNetwork,
    identities,
    labelled_data,
    trained_networks,
)
from studies.paper.printed import HARDWARE
from studies.paper.trials import TOPPQUAD, Plan, finite_mean, network_plan, profile_of
from studies.runner.result import Column, StudyResult, Table, detail_table
from cfplan.vehicle.trajectory import Trajectory

DATA = FilePath("datasets/paper-hardware")  # a folder for each set of limits, with its dataset and its networks
LEARNED_FROM = 9000  # paths, as in the paper
NOISES = (0.001, 0.01, 0.1)  # m, of the LSTMs that the paper flew
SHIPPED = "the shipped planner"
TOPPQUAD_FLIGHTS, LEARNED_FLIGHTS = 4, 5  # of each path
LOSS = 0.05  # of radio packets
LINE, LONG = "1", "long"
THE_LINE = np.array([[-1.4, -2.8, 0.8], [1.4, 2.8, 1.2]])  # m
LONG_WAYPOINTS, LONG_WALL_DISTANCE = 16, 0.35  # of the long path, and m that they keep from the margin
LIMITS = {"appendix": (5.0, 8.0), "text": (10.0, 10.0)}  # m/s² and rad/s, as the paper has them in the two places
RAW, CERTIFIED = "as planned", "certified"
TRACKED = next(iter(LIMITS))  # the limits whose flights are drawn
TRACK_SPACING, TRACK_POINTS = 0.1, 121  # s between two kept poses; points of a path


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
    deviation: float = np.nan  # m, largest by the poses, from where the setpoint is at that time
    settled: float = np.nan  # s after the end of the motion; inf where it did not settle

    @property
    def failed(self) -> bool:
        """Return whether there was no flight to the end of the path, or it was LOST."""
        return bool(self.reason) or not self.deviation < LOST


@dataclass(frozen=True, slots=True)
class Track:
    """Where a vehicle was along a path, by the poses; or, without a planner, the path itself."""

    path: str
    points: list[list[int]]  # mm
    way: str = ""
    planner: str = ""
    trial: int = 0


class _Poses:
    """Keeps some poses of those that arrive while the path is flown."""

    def __init__(self) -> None:
        self.points: list[list[int]] = []
        self._flying, self._next = False, -np.inf

    def hear(self, message: Telemetry) -> None:
        match message:
            case PhaseEntered(phase=phase):
                self._flying = phase is Phase.STREAM
            case PoseReceived(time=time, position=position) if self._flying and time >= self._next:
                self.points.append(_millimetres(position))
                self._next = time + TRACK_SPACING


Raw = Callable[[Path, Limits], Trajectory]  # raises CfplanError where there is none
Certified = Callable[[Path, Limits], CertifiedPlan]  # likewise


@dataclass(frozen=True, slots=True)
class FlownPlanner:
    """A planner, and what of it is flown."""

    name: str
    raw: Raw | None  # None: it is only flown certified
    certified: Certified
    flights: int = LEARNED_FLIGHTS  # of each path
    any_length: bool = False  # whether it plans paths longer than the paper's


def hardware(
    *,
    paths: int = 8,
    learned_from: int = LEARNED_FROM,
    data: FilePath = DATA,
    epochs: int | None = None,
    quick: bool = False,
    running: Running = HERE,
    progress: Progress = lambda done, total: None,
) -> StudyResult:
    """Fly `paths` paths and the long one by each planner; paths are labelled and networks trained if need be.

    Under `data` each set of limits has a folder, in which labelling and training that were stopped go on.

    Raises:
        InputError: fewer than one path, or other data or networks in the folder.
    """
    if paths < 1:
        raise InputError("paths must be at least 1", where="paths", hint="give --paths 8, as in the paper")
    usual = load_limits(DEFAULTS)
    names = list(LIMITS)[:1] if quick else list(LIMITS)
    flown_paths = hardware_paths(usual, paths) | ({} if quick else {LONG: long_path(usual)})
    wanted = [SequenceOptions(epsilon=epsilon) for epsilon in (NOISES[:1] if quick else NOISES)]
    networks: dict[str, list[TrainedNetwork]] = {}
    training: list[dict[str, Any]] = []
    steps: dict[str, tuple[int, float]] = {}
    for name in names:
        spec = hardware_spec(paper_limits(usual, name), learned_from)
        with labelled_data(data / name, spec, progress, running=running, epochs=epochs, quick=quick) as material:
            networks[name] = trained_networks(material, wanted, progress)
            steps |= training_steps(networks[name], len(material.learned_from.rows), f"{name} ")
            training += [
                {"limits": name, "network": each.name, "learned_from": len(material.learned_from.rows),
                 "epochs": each.options.epochs, "seconds": each.training_seconds} for each in networks[name]
            ]  # fmt: skip
    planners = {name: flown_planners({each.name: network_plan(each) for each in own}) for name, own in networks.items()}
    settings = {"paths": paths, "learned_from": learned_from, "radio_loss": LOSS, "quick": quick}
    work = work_through(
        "hardware", settings | {"networks": {name: identities(own) for name, own in networks.items()}},
        partial(_flights, planners, flown_paths, 1 if quick else None), _flown_together(planners, flown_paths), running,
        progress,
    )  # fmt: skip
    flown = [(HardwareFlight(**flight), points) for value in work.values for flight, points in value]
    flights = [flight for flight, _ in flown]
    tables = (*hardware_tables(flights), Table("training", "Networks", TRAINING_COLUMNS, tuple(training)))
    details = (
        detail_table("flights", flights), detail_table("tracks", _tracks(flown_paths, flown)),
        work_table(steps | {"plan": (len(work.values), work.seconds)}),
    )  # fmt: skip
    return StudyResult("hardware", settings, tables, details, work.interrupted)


def paper_limits(usual: Limits, name: str) -> Limits:
    """Return the limits with those of the paper in them, and thresholds of flight above them."""
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
    """Return thresholds of which the first is half as high again as what is planned, at least."""
    factor = max(1.0, 1.5 * planned / ladder.brake)
    return Ladder(factor * ladder.brake, factor * ladder.land, factor * ladder.cut)


def hardware_spec(limits: Limits, learned_from: int) -> DatasetSpec:
    """Return the paths that the networks learn from: the paper's, from its training box."""
    return DatasetSpec(
        count=learned_from, seed=1, limits=GIVEN, airframe=limits.airframe, plan=limits.plan, families=(),
        boxes=(BOXES["10x10x10"],), waypoints=(WAYPOINTS, WAYPOINTS), nodes=NODES, yaw=YawMode.FREE,
    )  # fmt: skip


def hardware_paths(limits: Limits, number: int) -> dict[str, Path]:
    """Return paths that stay within the room, the first a straight line, by the names of the tables."""
    paths = [min_snap(THE_LINE), *(path for _, path in random_paths(limits, 0, number - 1))]
    return {str(k): path for k, path in enumerate(paths, start=1)}


def long_path(limits: Limits) -> Path:
    """Return a path several times as long that stays within the room."""
    distance = limits.space.margin + LONG_WALL_DISTANCE
    box = np.array([limits.space.low, limits.space.high]) + np.array([[distance], [-distance]])
    for seed in count():
        path = min_snap(random_waypoints(seed, box, (LONG_WAYPOINTS, LONG_WAYPOINTS)))
        with suppress(CfplanError):  # between its waypoints it leaves the space, or has a cusp
            path.check()
            check_space(path, limits.space)
            return path
    raise AssertionError


def flown_planners(networks: Mapping[str, Plan]) -> list[FlownPlanner]:
    """Return TOPPQuad, the networks and the planner that ships."""
    return [
        FlownPlanner(TOPPQUAD, _toppquad, _policy("toppquad"), TOPPQUAD_FLIGHTS, any_length=True),
        *(FlownPlanner(name, _raw(network), _repaired(name, network)) for name, network in networks.items()),
        FlownPlanner(SHIPPED, None, _policy(AUTO), any_length=True),
    ]


def _toppquad(path: Path, limits: Limits) -> Trajectory:
    return Trajectory(path, profile_of(plan_toppquad, _task(path, limits)), limits.airframe)


def _raw(network: Plan) -> Raw:
    return lambda path, limits: Trajectory(path, network(path), limits.airframe)


def _policy(planner: str) -> Certified:
    def certified(path: Path, limits: Limits) -> CertifiedPlan:
        found = plan(path, limits.airframe, limits, planner=planner, yaw=YawMode.FREE)
        if planner not in (AUTO, found.planner):
            raise CfplanError("; ".join(found.notes), hint="plan by another planner")
        return give_way(found)[0]

    return certified


def _repaired(name: str, network: Plan) -> Certified:
    def certified(path: Path, limits: Limits) -> CertifiedPlan:
        found = repair(_task(path, limits), network(path), limits.space)
        return give_way(CertifiedPlan(
            path, limits.airframe, limits, found.trajectory, found.certificate, name, NODES, found.speed_factor,
            speed_factor=1.0, seconds=0.0, notes=(),
        ))[0]  # fmt: skip

    return certified


def _task(path: Path, limits: Limits) -> PlanningTask:
    return PlanningTask(path, limits.airframe, limits.plan, max(NODES, default_nodes(path)), YawMode.FREE)


class FlownGroup(NamedTuple):
    """Flights of one plan."""

    limits: str
    way: str
    planner: int  # its place among those of the limits
    path: str


def _flown_together(planners: Mapping[str, Sequence[FlownPlanner]], paths: Iterable[str]) -> dict[str, FlownGroup]:
    groups = [
        FlownGroup(name, way, place, path)
        for name, own in planners.items()
        for way in (RAW, CERTIFIED)
        for place, planner in enumerate(own)
        for path in paths
        if (way == CERTIFIED or planner.raw) and (path != LONG or planner.any_length)
    ]
    return {" ".join(map(str, group)): group for group in groups}


def _flights(
    planners: Mapping[str, Sequence[FlownPlanner]], paths: Mapping[str, Path], most: int | None, group: FlownGroup
) -> list[tuple[HardwareFlight, list[list[int]]]]:
    """Plan once, and fly that as often as the paper; return with each flight where it was, mm."""
    name, way, place, path = group
    planner, limits = planners[name][place], paper_limits(load_limits(DEFAULTS), name)
    flights = planner.flights if most is None else min(most, planner.flights)
    begun = [HardwareFlight(name, way, planner.name, path, trial) for trial in range(flights)]
    try:
        mission, duration = _mission(way, planner, paths[path], limits)
    except CfplanError as error:
        return [(replace(flight, reason=str(error)), []) for flight in begun]
    seed = 10 * list(paths).index(path)
    return [_flown(replace(flight, travel_time=duration), mission, seed + flight.trial) for flight in begun]


def _mission(way: str, planner: FlownPlanner, path: Path, limits: Limits) -> tuple[Mission, float]:
    """Return what is flown, and how long its motion lasts, s."""
    if way == CERTIFIED:
        certified = planner.certified(path, limits)
        return mission_of(encode_flight(PlannedFlight(planner.name, certified, limits)), limits), (
            certified.trajectory.duration
        )
    assert planner.raw
    trajectory = planner.raw(path, limits)
    # The paper's flights have no other end than a crash: here the pilot ends those that are LOST.
    patient = replace(limits, flight=replace(limits.flight, deviation=Ladder(LOST, 1.5 * LOST, 2.0 * LOST)))
    encoded = encode_trajectory(trajectory, gains=gains_under(limits), space=limits.space)
    return mission_of(encoded, patient), trajectory.duration


def _flown(flight: HardwareFlight, mission: Mission, seed: int) -> tuple[HardwareFlight, list[list[int]]]:
    """Return what became of it, and where it was, mm."""
    lossy = (RadioFault(RadioFaultKind.LOSS, 0.0, FOR_GOOD, LOSS),)
    vehicle = VehicleSettings(auto_arming=False, seed=seed)
    scenario, poses = Scenario("", Rung.NONE, lossy, from_start=True, vehicle=vehicle), _Poses()
    flown = fly_stepped(scenario, mission, seed=seed, listen=poses.hear)
    outcome = flown.outcome
    if outcome is None or outcome.exit_code is not ExitCode.OK:
        return replace(flight, reason=flown.reason), poses.points
    return replace(flight, deviation=outcome.deviation.max, settled=outcome.settled_after), poses.points


def _tracks(paths: Mapping[str, Path], flown: Sequence[tuple[HardwareFlight, list[list[int]]]]) -> Iterator[Track]:
    """Yield what the paper draws: each path, and the flights of TOPPQuad and of the networks, under TRACKED.

    On the long path the planner that ships is in their place.
    """
    for name, path in paths.items():
        yield Track(name, [_millimetres(point) for point in path(np.linspace(0.0, path.end, TRACK_POINTS))])
    for flight, points in flown:
        if flight.limits == TRACKED and points and (flight.planner != SHIPPED or flight.path == LONG):
            yield Track(flight.path, points, flight.way, flight.planner, flight.trial)


def _millimetres(point: Iterable[float]) -> list[int]:
    return [round(1000.0 * float(value)) for value in point]


COLUMNS = (
    Column("limits", "limits"),
    Column("way", "plans"),
    Column("planner", "planner"),
    Column("flights"),
    Column("deviation", "largest deviation: mean", "m", ".3f", meaning="over flights that did not fail, by the poses"),
    Column("deviation_most", "of all", "m", ".3f"),
    Column("paper_deviation", "paper", "m", ".3f"),
    Column("travel_time", "travel time", "s", ".2f", meaning="planned, mean over those flights"),
    Column("settled", "settling", "s", ".2f", meaning="after that, until it stays near the end"),
    Column("paper_time", "paper", "s", ".2f", meaning="with settling, along other paths"),
    Column("failed", "failures", of="flights", meaning=f"no plan, ended by the pilot, or {LOST:g} m from its place"),
)
TRAINING_COLUMNS = (
    Column("limits", "limits"), Column("network", "network"), Column("learned_from", "paths learned from"),
    Column("epochs", "epochs"), Column("seconds", "training", "s", ".0f", meaning="of the processor, one thread"),
)  # fmt: skip


def hardware_tables(flights: Sequence[HardwareFlight]) -> tuple[Table, ...]:
    """Return the paper's table, and the same of the straight line and of the long path alone."""
    usual = {flight.path for flight in flights} - {LONG}
    pairs = ", ".join(f"{name} {first:g} m/s² and {second:g} rad/s" for name, (first, second) in LIMITS.items())
    groups = (
        ("hardware", f"{len(usual)} paths in the room, 2 m/s; limits: {pairs}", usual),
        ("line", "The straight line among them, alone", {LINE}),
        ("long", "The long path", {LONG}),
    )
    return tuple(
        Table(name, title, COLUMNS, tuple(_rows([flight for flight in flights if flight.path in paths], name)))
        for name, title, paths in groups
    )


def _rows(flights: Sequence[HardwareFlight], table: str) -> Iterator[dict[str, Any]]:
    groups: dict[tuple[str, str, str], list[HardwareFlight]] = {}
    for flight in flights:
        groups.setdefault((flight.limits, flight.way, flight.planner), []).append(flight)
    for (limits, way, planner), own in groups.items():
        flown = [flight for flight in own if not flight.failed]
        printed = HARDWARE.get(planner) if table == "hardware" else None
        yield {
            "limits": limits,
            "way": way,
            "planner": planner,
            "flights": len(own),
            "deviation": finite_mean(flight.deviation for flight in flown),
            "deviation_most": max((flight.deviation for flight in flown), default=np.nan),
            "travel_time": finite_mean(flight.travel_time for flight in flown),
            "settled": finite_mean(flight.settled for flight in flown),
            "failed": len(own) - len(flown),
            "paper_deviation": printed.deviation if printed else None,
            "paper_time": printed.travel_time if printed else None,
        }
