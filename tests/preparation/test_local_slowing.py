"""Local slowing: slower only where setpoints end badly, until none does; what cannot be mended is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfplan.errors import InfeasibleError
from cfplan.geometry.min_snap import min_snap
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan import plan
from cfplan.planning.repair import repair
from cfplan.preparation.local_slowing import Assessment, slow_locally
from cfplan.safety.certificate import certify
from cfplan.safety.speed_caps import SpeedCaps

REPOSITORY = Path(__file__).parents[2]
RATE = 100.0
WALL = 1.3  # m, x of a wall
PATH = min_snap([[-1.0, -1.0, 1.0], [1.0, 0.0, 1.2], [-0.5, 1.0, 0.8], [0.9, 2.0, 1.0]])


class Coasting:
    """Every setpoint may be the last: from there the vehicle goes on for a time, straight, and must not pass a wall."""

    def __init__(self, seconds: float = 0.5, wall: float = WALL, beyond_always: float = 0.0) -> None:
        self.seconds, self.wall, self.beyond_always = seconds, wall, beyond_always
        self.calls = 0

    def __call__(self, trajectory):
        self.calls += 1
        time = np.arange(0.0, trajectory.duration, 1.0 / RATE)
        state = trajectory.at(time)
        on = self.seconds * np.maximum(state.velocity[:, 0], 0.0)
        excess = state.position[:, 0] + on - self.wall + self.beyond_always

        def describe(at):
            return f"ends {excess[at]:.2f} m beyond the wall"

        return [Assessment("coasting", time, excess, on + 1e-9, describe, lambda _: "the wall", "move the wall")]

    def worst(self, trajectory) -> float:
        """On a far finer grid, in m; negative where all is well."""
        state = trajectory.at(np.linspace(0.0, trajectory.duration, 50_000))
        return float((state.position[:, 0] + self.seconds * np.maximum(state.velocity[:, 0], 0.0) - self.wall).max())

    def fastest(self, planned) -> float:
        """The least time, s: with the speed that just does as a cap at every place, which this toy alone knows."""
        s = planned.profile.s
        tangent = PATH(s, 1) / np.maximum(np.linalg.norm(PATH(s, 1), axis=1), 1e-9)[:, None]
        most = (self.wall - PATH(s)[:, 0]) / (self.seconds * np.maximum(tangent[:, 0], 1e-3))
        caps = SpeedCaps.of(s, np.minimum(most, planned.limits.plan.speed))
        task = PlanningTask(PATH, planned.airframe, planned.limits.plan, nodes=len(s) - 1, speed_caps=caps)
        return repair(task, planned.profile).trajectory.duration


@pytest.fixture(scope="module")
def planned(limits):
    return plan(PATH, limits.airframe, limits)


@pytest.mark.parametrize("seconds", [0.5, 0.6, 0.7])
def test_the_flight_is_slower_only_where_it_would_pass_the_wall(limits, planned, seconds):
    coasting = Coasting(seconds)
    assert coasting.worst(planned.trajectory) > 0.05  # else this would test nothing
    slowed, assessed = slow_locally(planned, coasting)
    assert coasting.worst(slowed.trajectory) <= 1e-3
    assert assessed[0].passed
    assert slowed.certificate.passed
    assert slowed.certificate == certify(slowed.trajectory, limits.plan, limits.space, slowed.slowing.caps)
    assert slowed.time_lost > 0.0
    least = coasting.fastest(planned) / planned.trajectory.duration - 1.0
    print(slowed.time_lost, least, coasting.calls)
    assert slowed.time_lost < 2.0 * least + 0.005
    assert slowed.slowing.before == planned.trajectory.duration
    assert slowed.slowing.reasons == ("coasting near the wall",)
    assert slowed.describe_slowing() == f"{100 * slowed.time_lost:.1f} % slower for coasting near the wall"
    assert coasting.calls <= 7
    away = planned.trajectory.time_at(0.5 * PATH.end) - planned.trajectory.time_at(0.42 * PATH.end)
    still = slowed.trajectory.time_at(0.5 * PATH.end) - slowed.trajectory.time_at(0.42 * PATH.end)
    assert still == pytest.approx(away, rel=0.01)


def test_a_flight_that_ends_well_everywhere_stays_as_it_is(planned):
    coasting = Coasting(0.05)
    slowed, assessed = slow_locally(planned, coasting)
    assert slowed is planned
    assert coasting.calls == 1
    assert assessed[0].passed
    assert slowed.describe_slowing() == ""


@pytest.mark.parametrize("always", [1.0, np.nan])
def test_where_slowness_does_not_help_the_flight_is_refused(planned, always):
    with pytest.raises(InfeasibleError, match=r"coasting at \d+\.\d+ s .*however slowly") as caught:
        slow_locally(planned, Coasting(0.5, beyond_always=always))
    assert caught.value.where.endswith(" m")
    assert caught.value.hint == "move the wall"


@pytest.mark.parametrize("factor", [0.5, 0.8])
def test_a_flight_at_a_share_of_its_speed_is_slowed_from_there(limits, factor):
    slow = plan(PATH, limits.airframe, limits, speed_factor=factor)
    seconds = 0.6 / factor
    assert Coasting(seconds).worst(slow.trajectory) > 0.0
    slowed, _ = slow_locally(slow, Coasting(seconds))
    assert Coasting(seconds).worst(slowed.trajectory) <= 1e-3
    assert slowed.speed_factor == factor
    assert slowed.time_lost > 0.0
    fastest = np.linalg.norm(slowed.trajectory.at(np.linspace(0, 20, 4000)).velocity, axis=1).max()
    assert fastest <= factor * limits.plan.speed


def test_several_reasons_are_told_in_short(planned):
    slowed, _ = slow_locally(planned, Coasting(0.5))
    for others, told in (((), ""), (("b",), " and b"), (("b", "c"), " and 2 places more")):
        both = replace(slowed, slowing=replace(slowed.slowing, reasons=("a", *others)))
        assert both.describe_slowing().endswith(f"slower for a{told}")
