"""Plans give way where link loss would take the vehicle outside the walls; what is planned so is accepted as a file."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import InfeasibleError, NotCertifiedError
from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.planning.plan_file import load_plan, save_plan
from cfplan.preparation.link_loss_assessment import MARGIN, assess_link_loss
from cfplan.preparation.plan_flight import plan_flight
from cfplan.preparation.prepare_flight import encode_flight, find_link_loss
from cfplan.preparation.steps import StepState
from cfplan.simulation.link_loss import link_loss_at_every_setpoint

# Across the room, and fast up to a wall.
WAYPOINTS = "waypoints: [[0.45, 1.77, 0.5], [-0.98, 0.78, 0.5], [1.99, 2.49, 0.5]]\n"


@pytest.fixture(scope="module")
def path_file(tmp_path_factory):
    file = tmp_path_factory.mktemp("paths") / "towards-a-wall.yaml"
    file.write_text(WAYPOINTS)
    return file


@pytest.fixture(scope="module")
def warned(path_file, limits):
    """As planned without giving way."""
    return plan_flight(path_file, replace(limits, link_loss=replace(limits.link_loss, only_warn=True)))


@pytest.fixture(scope="module")
def gave_way(path_file, limits):
    return plan_flight(path_file, limits)


def beyond(planned, limits) -> float:
    """How far beyond a wall the vehicle comes down from the worst of all setpoints, with the worst of all lags."""
    payloads = encode_trajectory(planned.plan.trajectory, space=limits.space).payloads
    return float(link_loss_at_every_setpoint(payloads, limits).beyond.max())


def test_a_plan_gives_way_near_the_wall_and_no_setpoint_ends_outside(warned, gave_way, limits):
    assert beyond(warned, limits) > 0.05  # else this would test nothing
    assert beyond(gave_way, limits) <= -MARGIN
    assert gave_way.plan.certificate.passed
    assert gave_way.plan.slowing.reasons[0] == "link loss near the wall x = 2.25 m"
    assert 0.0 < gave_way.plan.time_lost < 0.15
    document = gave_way.to_dict()
    assert document["time_lost"] == gave_way.plan.time_lost
    assert document["slower_for"] == list(gave_way.plan.slowing.reasons)


def test_the_cost_is_told(path_file, limits, gave_way):
    noted = []
    plan_flight(path_file, limits, on_step=lambda *report: noted.append(report))
    assert ("slowing", StepState.FINISHED, gave_way.plan.describe_slowing()) in noted
    (*link_loss, gap) = [result for name, state, result in noted if (name, state) == ("slowing", StepState.DETAIL)]
    assert [each.split(" m ")[1] for each in link_loss] == [
        "inside the walls after link loss at any setpoint", "inside the walls after link loss within sampled stops",
    ]  # fmt: skip
    assert gap.startswith("a gap of 0.2 s in ")


def test_a_plan_that_outlasts_the_battery_only_by_giving_way_is_refused(path_file, warned, gave_way, limits):
    ground, space = limits.ground, limits.space
    around = (space.high[2] - space.low[2]) * (1.0 / ground.take_off_speed + 1.0 / ground.land_speed)
    between = 0.5 * (warned.duration + gave_way.duration) + around
    with pytest.raises(InfeasibleError, match="trusted for"):
        plan_flight(path_file, replace(limits, battery=replace(limits.battery, endurance=between)))


def test_where_safety_yaml_says_to_warn_nothing_is_slowed(warned):
    assert warned.plan.slowing is None
    assert warned.to_dict()["slower_for"] == []


def test_its_file_is_accepted_and_one_that_did_not_give_way_is_not(gave_way, warned, limits, tmp_path):
    save_plan(gave_way.plan, tmp_path / "gave-way.parquet")
    read = plan_flight(tmp_path / "gave-way.parquet", limits)
    assert read.plan.slowing == gave_way.plan.slowing
    assert find_link_loss(encode_flight(read), limits).beyond <= 0.0
    save_plan(warned.plan, tmp_path / "did-not.parquet")
    assert load_plan(tmp_path / "did-not.parquet").certificate.passed
    with pytest.raises(NotCertifiedError, match="beyond the walls"):
        find_link_loss(encode_flight(plan_flight(tmp_path / "did-not.parquet", limits)), limits)


def test_where_slowness_does_not_help_the_path_is_refused_by_its_wall(limits, tmp_path):
    tight = replace(limits, space=replace(limits.space, high=(1.91, 4.0, 2.0), margin=0.005))
    (tmp_path / "path.yaml").write_text("waypoints: [[0.0, 0.0, 1.0], [1.9, 0.0, 1.0]]\n")
    noted = []
    with pytest.raises(InfeasibleError, match=r"link loss at .* wall x = 1.91 m, however slowly") as caught:
        plan_flight(tmp_path / "path.yaml", tight, on_step=lambda *report: noted.append(report[:2]))
    assert caught.value.where.endswith(", 0.00, 1.00) m")
    assert "link_loss" in caught.value.hint
    assert noted[-1] == ("slowing", StepState.FAILED)


def test_the_assessment_tells_of_each_setpoint_which_wall_is_nearest_and_how_far(gave_way, limits):
    encoded = encode_trajectory(gave_way.plan.trajectory, space=limits.space)
    assessed = assess_link_loss(encoded, limits, margin=0.0)
    moments = link_loss_at_every_setpoint(encoded.payloads, limits)
    assert len(assessed.excess) == len(encoded.payloads)
    assert assessed.excess.max() == moments.beyond.max()
    for at in np.flatnonzero(moments.beyond > moments.beyond.max() - 0.02):
        walls = {f"the wall {axis} = {wall:g} m": far for k, axis in enumerate("xy") for wall, far in (
            (limits.space.low[k], limits.space.low[k] - moments.low[at, k]),
            (limits.space.high[k], moments.high[at, k] - limits.space.high[k]),
        )}  # fmt: skip
        walls["the ceiling z = 2 m"] = moments.high[at, 2] - limits.space.high[2]
        assert assessed.excess[at] == pytest.approx(max(walls.values()))
        assert walls[assessed.near(at)] == max(walls.values())
        assert assessed.near(at) in assessed.describe(at)
        assert 0.0 < assessed.reach[at] < 2.0
