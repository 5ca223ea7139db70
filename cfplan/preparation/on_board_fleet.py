"""Prepare a fleet that flies on board: from a fleet file to a program for the commander of each vehicle.

    fleet file → each vehicle's plan, slower for its fall → start delays and clock rates → polynomials, all slowed
               together → programs → the certificates of every pair, of all stops, and of lost vehicles

A vehicle whose link is lost flies on, until its watchdog stops the motors. The others stop by go-to, off their paths.
Commands take longer to be obeyed than setpoints, which adds to the skew.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from cfplan.flight.fleet.conductor import OBEYS_LATE
from cfplan.flight.on_board.fall import fall_tubes
from cfplan.flight.on_board.go_to import STOP_DURATION, go_to_states, stop_targets
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, decode
from cfplan.planning.fleet.fleet_file import FleetFile
from cfplan.planning.fleet.lost import BACK, NOTICED, LossModel, Tube
from cfplan.planning.fleet.separation import Stops, allowed_deviation
from cfplan.planning.plan_result import Plan
from cfplan.preparation.export_fleet import fit_fleet
from cfplan.preparation.export_flight import ExportedFlight, limits_for_polynomials
from cfplan.preparation.on_board_flight import (
    PreparedOnBoard,
    fit_for_program,
    give_way_to_fall,
    require_watchdog,
    with_program,
)
from cfplan.preparation.plan_fleet import (
    PlannedFleet,
    certify_losses,
    certify_separation,
    coordinate_fleet,
    load_fleet,
    lost_clearance,
    once_per_plan,
    plan_alone,
    steps_of,
)
from cfplan.preparation.plan_flight import FlightOptions, PlannedFlight
from cfplan.preparation.steps import OnStep, ignore_steps
from cfplan.safety.limits import Limits
from cfplan.vehicle.trajectory import Trajectory

_PART = 0.04  # s of a part of a tube
_BEFORE_START = -10.0  # s: a vehicle that is lost then hovers until it falls
_LEAD = 0.08  # m; the assumed lead of polynomials before they are fitted


def prepare_fleet_on_board(
    source: Path | FleetFile, limits: Limits, options: FlightOptions | None = None, on_step: OnStep = ignore_steps
) -> tuple[PlannedFleet, tuple[PreparedOnBoard, ...]]:
    """Plan, coordinate, fit and certify a fleet whose vehicles fly on board.

    Raises what plan_fleet() and prepare_on_board_flight() raise.
    """
    require_watchdog(limits)
    fleet, gentle = load_fleet(source, on_step), limits_for_polynomials(limits)
    fleet = replace(fleet, skew=fleet.skew + OBEYS_LATE)

    def slower_for_fall(plan: Plan, on_step: OnStep = ignore_steps) -> Plan:
        if limits.link_loss.only_warn:
            return plan
        return replace(give_way_to_fall(PlannedFlight("", plan, limits), on_step).plan, limits=plan.limits)

    alone = [
        replace(each, plan=slower_for_fall(each.plan, steps_of(each.name, on_step)))
        for each in plan_alone(fleet, gentle, options, on_step)
    ]
    model = _loss_model(fleet, limits, once_per_plan(_stops_of_plan))
    planned = coordinate_fleet(fleet, alone, gentle, model, on_step, options=options, finish=slower_for_fall)
    planned = replace(planned, limits=limits)

    def fit(flight: PlannedFlight, wait: float, on_step: OnStep) -> ExportedFlight:
        return fit_for_program(flight, on_step)

    fitted = fit_fleet(planned, fit, on_step)
    members = fitted.fleet.members
    prepared = tuple(
        with_program(flight, each, steps_of(flight.name, on_step))
        for flight, each in zip(fitted.fleet.flights, fitted.exported, strict=True)
    )
    of_programs = {id(member.plan): _stops_of_program(each) for member, each in zip(members, prepared, strict=True)}
    model = _loss_model(fleet, limits, lambda plan: of_programs[id(plan)])
    found = certify_separation(fleet, members, model.stops, on_step)
    losses = certify_losses(fleet, members, model, on_step)
    return replace(fitted.fleet, separations=found, losses=losses), prepared


def _loss_model(fleet: FleetFile, limits: Limits, stops: Callable[[Plan], Stops]) -> LossModel:
    """Return where the vehicles of a fleet go when they are lost, and how they stop."""
    deviation = allowed_deviation(fleet.apart)

    def tube(plan: Plan) -> Tube:
        times = np.append(_BEFORE_START, _setpoints(plan.trajectory))
        boxes = fall_tubes(plan.trajectory, times, limits, deviation=deviation, part=_PART, stops=(BACK, NOTICED[1]))
        return Tube(boxes, RATE, _PART, first=1)

    together = tuple(fleet.dongles.values())
    return LossModel(once_per_plan(tube), stops, together, lost_clearance(fleet.apart))


def _setpoints(trajectory: Trajectory) -> np.ndarray:
    return np.arange(int(np.ceil(trajectory.duration * RATE)) + 1) / RATE


def _stops_of_plan(plan: Plan) -> Stops:
    """Return the stops by go-to from a plan, which approximate those from its polynomials."""
    state = plan.trajectory.at(_setpoints(plan.trajectory))
    begin = np.zeros((len(state.position), 3, 4))
    begin[:, :, :3] = np.stack([state.position, state.velocity, state.acceleration], axis=1)
    states = go_to_states(begin, stop_targets(begin), STOP_DURATION, round(STOP_DURATION * RATE) + 1)
    return _stops(states[:, :, 0, :2], _LEAD)


def _stops_of_program(prepared: PreparedOnBoard) -> Stops:
    rows, trajectory = prepared.mission.stops, prepared.plan.trajectory
    places = decode(rows.reshape(-1, PAYLOAD_SIZE)).position[:, :2].reshape(*rows.shape[:2], 2)
    planned = trajectory.path(trajectory.s_at(np.arange(len(places)) / RATE))[:, :2]
    return _stops(places, float(np.linalg.norm(places[:, 0] - planned, axis=1).max()))


def _stops(places: np.ndarray, off: float) -> Stops:
    moved = np.linalg.norm(np.diff(places, axis=1), axis=2).max(), np.linalg.norm(np.diff(places, axis=0), axis=2).max()
    return Stops(np.ascontiguousarray(places), RATE, RATE * float(max(moved)), off)
