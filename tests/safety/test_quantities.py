"""The table of limited quantities: consistent in itself, and read by everything that holds motion to limits."""

from dataclasses import fields, replace
from pathlib import Path

import casadi
import numpy as np
import pytest

from cfplan.errors import NotCertifiedError
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.pilot import abort_monitor
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.setpoints import stop_certificate
from cfplan.flight.setpoints.byte_check import check_bytes
from cfplan.flight.setpoints.encoding import RATE, encode_trajectory
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.flight.telemetry import Estimate, VehicleStatus
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.yaw import YawMode
from cfplan.planners.baselines import toppquad, toppquad_nlp
from cfplan.planners.expert import point_constraints
from cfplan.planners.expert.intersample import DensePath, violates_at_nodes
from cfplan.planners.task import PlanningTask
from cfplan.safety import quantities
from cfplan.safety.certificate import certify, shares
from cfplan.safety.feasibility import hover_violation, infeasible_limit, violated_limit
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.safety.limits import FlightLimits, PlanLimits
from cfplan.safety.limits_file import load_limits
from cfplan.safety.quantities import AT_MOST, QUANTITIES
from cfplan.vehicle import measures
from cfplan.vehicle.trajectory import Trajectory

CHOSEN = LIMIT_SETS["hardware"]
AIRFRAME, LIMITS = CHOSEN.airframe, CHOSEN.limits
each_quantity = pytest.mark.parametrize("quantity", QUANTITIES, ids=lambda quantity: quantity.name)


@pytest.fixture(scope="module")
def trajectory(make_profile):
    path = min_snap([[0, 0, 1], [1, 1.5, 1.3], [-1, 2, 0.7]])
    return Trajectory(path, make_profile(path.end, np.full(30, 1.0), 0.2 * np.arange(29)), AIRFRAME)


def tightened(quantity, trajectory):
    """Limits that the trajectory keeps but for this quantity, by a quarter of the way from what uses none of it."""
    margins = {margin.name: margin for margin in certify(trajectory, LIMITS).margins}
    unused = quantity.unused(AIRFRAME)
    limit = unused + 0.75 * (margins[quantity.name].worst - unused)
    wide = replace(
        LIMITS, speed=100.0, acceleration=100.0, angular_velocity=100.0, angular_acceleration=1000.0, tilt=1.5,
        motor_thrust_min=1e-3, motor_thrust_max=10.0, specific_thrust_min=1e-3,
    )  # fmt: skip
    return wide, replace(wide, **{quantity.limit: limit})


def test_every_limit_of_a_plan_is_in_the_table_once():
    assert sorted(quantity.limit for quantity in QUANTITIES) == sorted(field.name for field in fields(PlanLimits))
    assert len({quantity.name for quantity in QUANTITIES}) == len(QUANTITIES)


def test_every_measure_is_limited():
    limited = np.concatenate([np.arange(measures.MEASURES)[quantity.which] for quantity in QUANTITIES])
    assert set(limited.tolist()) == set(range(measures.MEASURES))


@each_quantity
def test_value_and_measure_are_inverse_and_rise_together(quantity):
    values = np.linspace(0.05, 1.0, 9)
    measured = quantity.measured(values)
    np.testing.assert_allclose(quantity.value(measured), values, rtol=1e-12)
    assert (np.diff(measured) > 0).all()
    assert (np.diff(quantity.row(measured)) > 0).all()


@each_quantity
def test_the_optimisers_row_meets_its_bound_where_the_quantity_meets_its_limit(quantity):
    measured = np.ones((measures.MEASURES, 1))
    measured[quantity.which] = quantity.measured(quantity.allowed(LIMITS))
    bound = (quantities.UPPER if quantity.side == AT_MOST else quantities.LOWER)[quantity.which]
    np.testing.assert_allclose(quantities.scaled(measured, LIMITS)[quantity.which, 0], bound, rtol=1e-12)


def test_rows_of_symbols_are_those_of_numbers():
    offset, scale = quantities.scales(LIMITS)
    measured = np.linspace(0.1, 1.0, measures.MEASURES)
    symbols = casadi.SX.sym("m", measures.MEASURES)
    rows = casadi.Function("rows", [symbols], quantities.rows_of(casadi.vertsplit(symbols), offset, scale))
    found = [float(row) for row in rows(measured)]
    np.testing.assert_allclose(found, quantities.scaled(measured[:, None], LIMITS)[:, 0], rtol=1e-12)


@each_quantity
def test_the_certificate_judges_it(quantity, trajectory):
    wide, tight = tightened(quantity, trajectory)
    assert certify(trajectory, wide).passed
    failed = [margin.name for margin in certify(trajectory, tight).margins if not margin.passed]
    assert failed == [quantity.name]
    assert quantity.name in shares(trajectory, tight, np.array([0.5]))


@each_quantity
def test_the_expert_judges_it_between_nodes(quantity, trajectory):
    nodes = len(trajectory.profile.s) - 1
    dense = DensePath(trajectory.path, nodes, np.zeros(nodes))
    wide, tight = tightened(quantity, trajectory)
    assert dense.violation(trajectory.profile, AIRFRAME, wide).worst < 0.0
    violation = dense.violation(trajectory.profile, AIRFRAME, tight)
    side = violation.upper if quantity.side == AT_MOST else violation.lower
    assert side[:, quantity.which].max() == violation.worst > 0.0
    assert violates_at_nodes(trajectory.path, trajectory.profile, AIRFRAME, tight)


@each_quantity
def test_the_expert_binds_it_at_points_or_by_h_alone(quantity):
    rows = range(measures.MEASURES)[quantity.which]
    if quantity.name == "speed":
        assert list(rows) == [point_constraints.ROWS]
        return
    bound = point_constraints.UPPER if quantity.side == AT_MOST else point_constraints.LOWER
    assert np.isfinite(bound[list(rows)]).all()
    assert (point_constraints.JUMPS[list(rows)] == quantity.jumps).all()


@each_quantity
def test_boundary_states_are_judged_by_what_an_instant_tells(quantity, trajectory):
    wide, tight = tightened(quantity, trajectory)
    states = [(trajectory.profile.boundary(node), trajectory.profile.s[node]) for node in range(30 - 3)]
    assert not any(violated_limit(state, trajectory.path, s, AIRFRAME, wide) for state, s in states)
    found = {violated_limit(state, trajectory.path, s, AIRFRAME, tight).split(" is ")[0] for state, s in states} - {""}
    assert found == (set() if quantity.jumps else {quantity.noun})


@each_quantity
def test_a_limit_that_hovering_breaks_is_named(quantity):
    broken = replace(LIMITS, **{quantity.limit: quantity.hover(AIRFRAME) + quantity.side * -1e-6})
    assert hover_violation(AIRFRAME, LIMITS) is None
    assert hover_violation(AIRFRAME, broken) is quantity
    assert quantity.limit in infeasible_limit(AIRFRAME, broken)


@each_quantity
def test_bytes_are_judged_by_what_a_setpoint_tells(quantity, trajectory):
    wide, tight = tightened(quantity, trajectory)
    encoded = encode_trajectory(trajectory)
    check_bytes(encoded, trajectory, wide)
    if quantity.jumps:
        check_bytes(encoded, trajectory, tight)
    else:
        with pytest.raises(NotCertifiedError, match=quantity.noun):
            check_bytes(encoded, trajectory, tight)


@each_quantity
def test_stops_are_judged_by_the_table(quantity, trajectory):
    slower = Trajectory(trajectory.path, trajectory.profile.slowed(0.5), AIRFRAME)
    motion = encode_trajectory(slower).motion
    stops = encode_stops(motion, RATE)
    safety = load_limits(Path(__file__).parents[2] / "safety.yaml")
    found = stop_certificate.certify_stops(stops, motion, safety, RATE)
    found.require(safety)
    assert (quantity.name in found.worst) == (quantity.in_stop is not None)
    if quantity.in_stop:
        beyond = quantity.in_stop(safety) + quantity.side
        with pytest.raises(NotCertifiedError, match=quantity.noun):
            replace(found, worst=found.worst | {quantity.name: beyond}).require(safety)


@each_quantity
def test_toppquad_keeps_every_limit(quantity, trajectory):
    task = PlanningTask(trajectory.path, AIRFRAME, LIMITS, 20)
    tighter = quantity.allowed(LIMITS) + 0.1 * (quantity.unused(AIRFRAME) - quantity.allowed(LIMITS))
    other = replace(task, limits=replace(LIMITS, **{quantity.limit: tighter}))
    before, after = program_of(task), program_of(other)
    assert any(not np.array_equal(each, after[name]) for name, each in before.items())


def program_of(task):
    """The numbers by which TOPPQuad's program knows the limits: bounds of variables and rows, and rows at a point."""
    grid = np.linspace(0.0, task.path.end, task.nodes + 1)
    at = np.random.default_rng(0).uniform(0.2, 0.8, toppquad_nlp.VARIABLES), np.ones(8)
    rows = toppquad_nlp.node_rows(task.airframe, task.limits.angular_acceleration)(*at)
    return toppquad.program_bounds(task, grid, YawMode.FIXED) | {"rows": np.array(rows)}


@each_quantity
def test_what_has_a_ladder_ends_a_flight(quantity):
    limits = load_limits(Path(__file__).parents[2] / "safety.yaml")
    if not quantity.ladder:
        return
    beyond = getattr(limits.flight, quantity.ladder).land + 1e-3
    moving = {name: (0.0, beyond if name == quantity.ladder else 0.0, 0.0) for name in abort_monitor.MEASURED}
    monitor = abort_monitor.AbortMonitor(limits)
    for now in (1.0, 1.0 + 2 * limits.flight.patience):
        abort = monitor.gravest(still(now, limits, moving))
    assert abort.rung is Rung.LAND
    assert quantity.name in abort.text


def still(now, limits, moving):
    """What the pilot observes of a vehicle in hover that moves as told."""
    pose = Pose(now, now, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))
    estimate = Estimate(now, (0.0, 0.0, 1.0), moving["speed"], moving["acceleration"], (0.0, 0.0, 0.0, 1.0))
    status = VehicleStatus(now, moving["angular_velocity"], (0, 0, 0, 0), 4.0, 0)
    return abort_monitor.Observation(now, pose=pose, estimate=estimate, status=status)


def test_stops_are_bound_in_all_quantities_but_one():
    assert {q.name for q in QUANTITIES} - {q.name for q in stop_certificate.BOUND} == {"angular acceleration"}


def test_ladders_are_those_of_the_flight_limits():
    ladders = {field.name for field in fields(FlightLimits)} - {"deviation", "fence", "patience", "stop_tilt"}
    assert {quantity.ladder for quantity in quantities.ON_LADDER} == ladders
