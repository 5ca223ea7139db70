"""From a fleet file to certified plans that keep apart.

fleet file → each vehicle's plan → start delays and clock rates, or else detours → the certificates of every pair and of
lost vehicles
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InfeasibleError, NotCertifiedError
from cfplan.flight.firmware import estimate_errors
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.setpoints.packets import decode, encode
from cfplan.flight.setpoints.stops import stop_clock
from cfplan.planning.fleet.coordination import Blocked, Finish, coordinate
from cfplan.planning.fleet.fleet_file import FleetFile, load_fleet_file
from cfplan.planning.fleet.lost import Loss, LossModel, Tube
from cfplan.planning.fleet.members import FleetMember
from cfplan.planning.fleet.separation import CLEAR, Separation, Stops, allowed_deviation, separations, stop_separations
from cfplan.planning.plan import check_endurance
from cfplan.planning.plan_result import Plan
from cfplan.preparation.detours import Detours
from cfplan.preparation.plan_flight import FlightOptions, PlannedFlight, give_way, plan_flight
from cfplan.preparation.prepare_flight import PreparedFlight, encode_flight, find_link_loss, make_mission, rehearse
from cfplan.preparation.slow_motion import require_harmless_slow_motion
from cfplan.preparation.steps import OnStep, ignore_steps, step
from cfplan.safety.limits import Limits
from cfplan.safety.space import FLOOR, inside
from cfplan.simulation.dry_run import DryRun
from cfplan.simulation.link_loss import TUBE_PART, link_loss_tubes
from cfplan.vehicle.airframe import GRAVITY

T = TypeVar("T")
_TUBE_NEARER = 0.10  # m less than `apart` that others keep from a tube, which encloses the deviation of its vehicle
_BLIND = 2.0  # s, about, in which a vehicle without poses brakes and comes down; after 3 s its motors stop
_CEILING = FLOOR + 3  # its number among the faces
_SAMPLE = 0.01  # s between the positions of a path that are compared with walls
_LOST_HINT = "move that path with `place`, or write `lost: warn` in the fleet file"


@dataclass(frozen=True, slots=True)
class PlannedFleet:
    """The plans of a fleet, and how far the vehicles stay from each other."""

    name: str
    apart: float  # m
    skew: float  # s
    members: tuple[FleetMember, ...]
    separations: tuple[Separation, ...]  # of every pair, the nearest first
    losses: tuple[Loss, ...]  # of every vehicle and every shared dongle, the nearest first; none if not regarded
    alone: float  # s, the longest plan before coordination
    limits: Limits
    detours: tuple[str, ...] = ()  # of replanned paths, one phrase each

    @property
    def end(self) -> float:
        """Return when the last vehicle reaches its end, s after the fleet's start."""
        return max(member.end for member in self.members)

    @property
    def flights(self) -> tuple[PlannedFlight, ...]:
        """Return the flight of each vehicle, for rehearsing it; it begins after the member's delay."""
        return tuple(PlannedFlight(member.name, member.plan, self.limits) for member in self.members)

    def vehicle_rows(self) -> list[tuple[str, ...]]:
        """Return a row of text per vehicle: name, start, end, what slows it."""
        return [
            (each.name, f"{each.delay:.2f} s", f"{each.end:.2f} s", each.plan.describe_slowing())
            for each in self.members
        ]

    def pair_rows(self) -> list[tuple[str, ...]]:
        """Return a row of text per pair: names, least distance, allowed distance, time, place."""
        return [
            (
                " – ".join(each.pair),
                f"{each.distance:.3f} m",
                f"{self.apart:.3f} m",
                f"{each.time:.2f} s{', braking' if each.braked else ''}",
                f"{each.place[0]:.2f}, {each.place[1]:.2f}",
            )
            for each in self.separations
        ]

    @property
    def lost_keep(self) -> float:
        """Return the distance that others keep from a lost vehicle, m."""
        return lost_clearance(self.apart)

    def loss_rows(self) -> list[tuple[str, ...]]:
        """Return a row of text per loss: vehicles, nearest pair, distances, time, place, reaction, exposed time."""
        return [
            (
                ", ".join(each.vehicles),
                " – ".join(each.pair),
                f"{each.distance:.3f} m",
                f"{self.lost_keep:.3f} m",
                f"{each.time:.2f} s",
                f"{each.place[0]:.2f}, {each.place[1]:.2f}",
                each.reaction,
                f"{100 * each.exposed:.0f} %",
            )
            for each in self.losses
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return the figures of the fleet, for JSON."""
        vehicles = zip(self.members, self.flights, strict=True)
        return {
            "name": self.name,
            "apart": self.apart,
            "skew": self.skew,
            "duration": self.end,
            "slowest_alone": self.alone,
            "vehicles": [flight.to_dict() | {"starts": each.delay, "ends": each.end} for each, flight in vehicles],
            "pairs": [
                {
                    "pair": each.pair,
                    "distance": each.distance,
                    "place": each.place,
                    "time": each.time,
                    "braking": each.braked,
                }
                for each in self.separations
            ],
            "lost": [asdict(each) for each in self.losses],
            "detours": self.detours,
        }


def plan_fleet(
    source: Path | FleetFile, limits: Limits, options: FlightOptions | None = None, on_step: OnStep = ignore_steps
) -> PlannedFleet:
    """Plan the path of each vehicle, and let them start later or fly slower where they would come too near.

    Raises:
        InputError: a file or an option is wrong.
        InfeasibleError: a path has no certified plan, or no start delays, clock rates or detours were found.
        NotCertifiedError: a pair comes too near.
    """
    fleet = load_fleet(source, on_step)
    alone = plan_alone(fleet, limits, options, on_step)
    return coordinate_fleet(fleet, alone, limits, loss_model(fleet, limits), on_step, options=options)


def load_fleet(source: Path | FleetFile, on_step: OnStep = ignore_steps) -> FleetFile:
    """Return the fleet of a file, or the one given. Raises InputError."""
    with step(on_step, "fleet") as results:
        fleet = source if isinstance(source, FleetFile) else load_fleet_file(source)
        results.append(f"{fleet.name}, {len(fleet.vehicles)} vehicles, {fleet.apart:g} m apart")
    return fleet


def plan_alone(
    fleet: FleetFile, limits: Limits, options: FlightOptions | None = None, on_step: OnStep = ignore_steps
) -> list[FleetMember]:
    """Plan the path of each vehicle without regard to the others. Raises InfeasibleError with the vehicle's name."""
    alone = []
    for vehicle in fleet.vehicles:
        with step(on_step, vehicle.name) as results:
            try:
                plan = plan_flight(vehicle.path_file, limits, options).plan
            except InfeasibleError as error:
                raise InfeasibleError(f"{vehicle.name}: {error.what}", where=error.where, hint=error.hint) from None
            results.append(f"{vehicle.path_file.name}, {plan.trajectory.duration:.2f} s alone")
            if plan.slowing:
                results.append(plan.describe_slowing())
        alone.append(FleetMember(vehicle.name, plan))
    return alone


def coordinate_fleet(
    fleet: FleetFile,
    alone: Sequence[FleetMember],
    limits: Limits,
    model: LossModel | None,
    on_step: OnStep = ignore_steps,
    *,
    options: FlightOptions | None = None,
    finish: Finish | None = None,
) -> PlannedFleet:
    """Coordinate certified plans; certify every pair, and every vehicle and dongle that may be lost.

    Where no clocks keep the vehicles apart, paths are replanned with `options`. `finish` finishes plans that were made
    again; by default they give way as streamed ones do. Without a model of lost vehicles, these are not regarded.
    Raises InfeasibleError and NotCertifiedError as plan_fleet().
    """
    detours = Detours(fleet, limits, options or FlightOptions(), finish)
    stops = None if model is None else model.stops
    longest = max(member.plan.trajectory.duration for member in alone)

    def coordinated(alone: Sequence[FleetMember]) -> tuple[FleetMember, ...] | Blocked:
        members = coordinate(alone, fleet.apart, fleet.skew, finish or _given_way, model, stops)
        if isinstance(members, Blocked) and model is not None:
            members = coordinate(alone, fleet.apart, fleet.skew, finish or _given_way, stops=stops)
        return members

    with step(on_step, "coordination") as results:
        members = coordinated(alone)
        while isinstance(members, Blocked):
            replanned = detours.replan(alone, members)
            if replanned is None:
                raise InfeasibleError(
                    f"no start delays and clock rates keep the vehicles {fleet.apart:g} m apart: {members}"
                    + "".join(f"; {each}" for each in detours.describe()),
                    where=fleet.name,
                    hint="move one of the two paths with `place`, or reverse its waypoints",
                )
            alone = replanned
            members = coordinated(alone)
        waiting = sum(member.delay > 0.0 for member in members)
        slower = sum(new.plan is not old.plan for new, old in zip(members, alone, strict=True))
        end = max(member.end for member in members)
        results.append(f"{end:.2f} s together; the slowest vehicle alone takes {longest:.2f} s")
        results += detours.describe()
        results.append(f"waiting at the start: {waiting}, slowed: {slower}")
    _check_endurance(members, limits)
    found = certify_separation(fleet, members, stops, on_step)
    losses: tuple[Loss, ...] = ()
    if model is not None:
        losses = certify_losses(fleet, members, model, on_step)
        _warn_of_walls(members, limits, on_step)
    return PlannedFleet(
        fleet.name, fleet.apart, fleet.skew, members, found, losses, longest, limits, tuple(detours.describe())
    )


def _check_endurance(members: Sequence[FleetMember], limits: Limits) -> None:
    """Raise InfeasibleError if a vehicle that hovers until all have taken off and it begins flies for too long."""
    queue = (len(members) - 1) * limits.ground.take_off_height / limits.ground.take_off_speed
    for member in members:
        try:
            check_endurance(queue + member.end, limits)
        except InfeasibleError as error:
            raise InfeasibleError(f"{member.name}: {error.what}", where=error.where, hint=error.hint) from None


def certify_separation(
    fleet: FleetFile | PlannedFleet,
    members: Sequence[FleetMember],
    stops: Callable[[Plan], Stops] | None,
    on_step: OnStep = ignore_steps,
) -> tuple[Separation, ...]:
    """Return how near each pair comes, the nearest first, also when all leave their paths to stop.

    Raises NotCertifiedError if a pair comes too near.
    """
    with step(on_step, "separation") as results:
        found = separations(members, fleet.skew)
        if stops is not None:
            braked = stop_separations(members, [stops(member.plan) for member in members], fleet.skew)
            nearest: dict[tuple[str, str], Separation] = {}
            for each in sorted((*found, *braked), key=lambda each: each.distance):
                nearest.setdefault(each.pair, each)
            found = tuple(nearest.values())
        results.append(f"nearest {found[0]}")
        for each in found:
            if not each.keeps(fleet.apart):
                raise NotCertifiedError(
                    f"{each}; they must keep {fleet.apart:g} m",
                    where=fleet.name,
                    hint="plan the fleet again, or move a path",
                )
    return found


def certify_losses(
    fleet: FleetFile, members: Sequence[FleetMember], model: LossModel, on_step: OnStep = ignore_steps
) -> tuple[Loss, ...]:
    """Return the worst moments to lose a vehicle. Raises InfeasibleError if they do not pass, unless it only warns."""
    with step(on_step, "lost vehicles") as results:
        losses = model.losses(members, range(len(members)), fleet.skew)
        avoids_lost = all(each.keeps(model.clearance) for each in losses)
        (results.append if avoids_lost else results.warn)(str(losses[0]))
        if not avoids_lost and not fleet.lost_only_warns:
            raise InfeasibleError(
                f"the others do not keep {model.clearance:.2f} m from a lost vehicle: {losses[0]}",
                where=fleet.name,
                hint=_LOST_HINT if len(losses[0].vehicles) == 1 else f"give each vehicle its own dongle, {_LOST_HINT}",
            )
    return losses


def steps_of(name: str, on_step: OnStep) -> OnStep:
    """Return a listener to the steps of one vehicle, which puts its name before each."""
    return lambda step, state, result: on_step(f"{name}: {step}", state, result)


def drift_without_poses(limits: Limits) -> float:
    """Return how far, m, a vehicle that lands without poses may drift sideways, by the errors of its estimate."""
    attitude_error, velocity_error = estimate_errors(limits)
    return velocity_error * _BLIND + 0.5 * GRAVITY * math.tan(attitude_error) * _BLIND**2


def _warn_of_walls(members: Sequence[FleetMember], limits: Limits, on_step: OnStep) -> None:
    """Warn of a path near walls or obstacles, as without poses a vehicle of a fleet does not move away from them."""
    nearest = []
    for member in members:
        trajectory = member.plan.trajectory
        places = trajectory.at(np.arange(0.0, trajectory.duration + _SAMPLE, _SAMPLE)).position
        away = limits.space.margin - limits.space.beyond(places)
        away[:, [FLOOR, _CEILING]] = np.inf
        row, face = divmod(int(away.argmin()), away.shape[1])
        nearest.append((float(away[row, face]), member.name, limits.space.faces[face]))
    distance, name, wall = min(nearest)
    drift = drift_without_poses(limits)
    text = f"{name} comes within {distance:.2f} m of {wall}"
    with step(on_step, "walls") as results:
        if distance >= drift:
            results.append(text)
        else:
            results.warn(f"{text}, and may drift {drift:.2f} m without poses: in a fleet it does not move off walls")


def lost_clearance(apart: float) -> float:
    """Return the distance, m, from a tube to the columns of the others.

    Where these are off their paths by all that is allowed, 0.15 m or more are left, and vehicles touch at 0.14 m.
    """
    return apart - _TUBE_NEARER


def loss_model(fleet: FleetFile, limits: Limits) -> LossModel:
    """Return where the vehicles of a fleet go when they are lost, and how they stop."""
    deviation = allowed_deviation(fleet.apart)

    def tube(plan: Plan) -> Tube:
        payloads = encode_flight(PlannedFlight("", plan, limits)).payloads
        boxes = link_loss_tubes(payloads, limits, np.arange(len(payloads)))
        boxes = _with_hover_after_take_off(boxes, payloads, limits)
        boxes[..., 0, :2] -= deviation
        boxes[..., 1, :2] += deviation
        return Tube(boxes, RATE, 0.001 * TUBE_PART)

    stop = stop_clock(RATE)[0] / RATE
    return LossModel(once_per_plan(tube), stop, tuple(fleet.dongles.values()), lost_clearance(fleet.apart))


def _with_hover_after_take_off(boxes: NDArray, payloads: NDArray, limits: Limits) -> NDArray:
    """Return tubes, (K, R, S, 2, 3) m, whose first row also encloses a loss in the hover after take-off."""
    start, height = decode(payloads[:1]), limits.ground.take_off_height
    if start.position[0, 2] >= height:
        return boxes
    above = replace(start, position=np.append(start.position[:, :2], [[height]], axis=1))
    higher = link_loss_tubes(encode(above), limits, np.arange(1))
    parts = max(boxes.shape[2], higher.shape[2])
    boxes, higher = (
        np.pad(each, ((0, 0), (0, 0), (0, parts - each.shape[2]), (0, 0), (0, 0)), mode="edge")
        for each in (boxes, higher)
    )
    boxes[:, 0, :, 0] = np.minimum(boxes[:, 0, :, 0], higher[:, 0, :, 0])
    boxes[:, 0, :, 1] = np.maximum(boxes[:, 0, :, 1], higher[:, 0, :, 1])
    return boxes


def once_per_plan(make: Callable[[Plan], T]) -> Callable[[Plan], T]:
    """Return a function that makes something of each plan, once."""
    known: dict[int, tuple[Plan, T]] = {}  # the plan too, as its id is free once it is gone

    def made(plan: Plan) -> T:
        if id(plan) not in known:
            known[id(plan)] = plan, make(plan)
        return known[id(plan)][1]

    return made


def _given_way(plan: Plan) -> Plan:
    return give_way(plan)[0]


def rehearse_fleet(fleet: PlannedFleet, on_step: OnStep = ignore_steps) -> dict[str, DryRun]:
    """Encode and rehearse each vehicle's flight, and lose its link at every setpoint; return the dry runs by name.

    Raises NotCertifiedError where bytes, dry run or link loss do not pass, or a vehicle deviates by more than `apart`
    allows. No vehicle is simulated in another's wash.
    """
    dry_runs = {}
    for flight in fleet.flights:
        with step(on_step, flight.name) as results:
            encoded = encode_flight(flight)
            dry_runs[flight.name] = rehearse(flight, encoded)
            results.append(f"{len(encoded.payloads)} setpoints, deviation {dry_runs[flight.name].expected()}")
            lost = find_link_loss(encoded, fleet.limits)
            (results.append if inside(lost.beyond) else results.warn)(str(lost))
    require_allowed_deviation(fleet, dry_runs, on_step)
    return dry_runs


def prepare_fleet(fleet: PlannedFleet, on_step: OnStep = ignore_steps) -> tuple[PreparedFlight, ...]:
    """Do what prepare_flight() does with the plan of each vehicle. Raises NotCertifiedError as rehearse_fleet()."""
    prepared = []
    for flight in fleet.flights:
        with step(on_step, flight.name) as results:
            encoded = encode_flight(flight)
            rehearsed, lost = rehearse(flight, encoded), find_link_loss(encoded, fleet.limits)
            mission, stops = make_mission(encoded, fleet.limits)
            require_harmless_slow_motion(mission)
            results.append(f"{len(encoded.payloads)} setpoints, deviation {rehearsed.expected()}, a stop from each")
            (results.append if inside(lost.beyond) else results.warn)(str(lost))
        prepared.append(PreparedFlight(flight, encoded, rehearsed, lost, stops, mission))
    require_allowed_deviation(fleet, {each.planned.name: each.dry_run for each in prepared}, on_step)
    return tuple(prepared)


def require_allowed_deviation(fleet: PlannedFleet, dry_runs: Mapping[str, DryRun], on_step: OnStep) -> None:
    """Raise NotCertifiedError if a vehicle deviates in its dry run by more than `apart` leaves room for."""
    allowed = allowed_deviation(fleet.apart)
    with step(on_step, "deviation") as results:
        worst = max(dry_runs, key=lambda name: dry_runs[name].deviation)
        off = dry_runs[worst].deviation
        results.append(f"{worst} deviates most, by {100 * off:.1f} cm in 95 %, and {100 * allowed:.1f} cm are allowed")
        if not off <= allowed:
            nearest = next(each for each in fleet.separations if worst in each.pair)
            needed = math.ceil(100 * (CLEAR + 2.0 * off)) / 100
            raise NotCertifiedError(
                f"{' and '.join(nearest.pair)} are kept {fleet.apart:g} m apart, which allows each to deviate by "
                f"{100 * allowed:.1f} cm, and {worst} deviates by {100 * off:.1f} cm in 95 % of its dry runs",
                where=fleet.name,
                hint=f"write `apart: {needed:.2f}` in the fleet file, or plan with lower limits",
            )
