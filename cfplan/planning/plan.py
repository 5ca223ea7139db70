"""plan(): from a path and limits to a certified trajectory, with a record of how it was found."""

import math
import pathlib
import time

from cfplan.deadline import NEVER, Deadline
from cfplan.errors import InfeasibleError, InputError
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan_result import Plan
from cfplan.planning.planners import AUTO, MOST_NODES, find_planner
from cfplan.planning.policy import choose
from cfplan.planning.repair import slow
from cfplan.safety.limits import Limits
from cfplan.safety.space import check_space
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import BoundaryState

LEAST_SPEED_FACTOR = 0.01
BUDGET, BUDGET_PER_METRE = 5.0, 0.02  # s, and s a metre
ANSWERING = 0.2  # of the time until the deadline, kept to complete an unfinished search
REASONABLE_NODES = range(2, 10 * MOST_NODES + 1)


def plan(
    path: Path,
    airframe: Airframe,
    limits: Limits,
    *,
    planner: str = AUTO,
    nodes: int | None = None,
    yaw: YawMode = YawMode.FIXED,
    yaw_angle: float = 0.0,
    speed_factor: float = 1.0,
    start: BoundaryState | None = None,
    deadline: Deadline = NEVER,
    models: tuple[pathlib.Path, ...] = (),
) -> Plan:
    """Return the fastest certified flight along the path that the planner finds.

    "auto" uses the learned planner, and the expert if that falls short, see policy.POLICIES. `models` are folders of
    models with precedence over those that come with cfplan.
    `speed_factor` slows the whole result to that fraction of its speed, so accelerations fall with its square. With a
    boundary state nothing may be slowed, or the state would not hold.

    At the deadline the certified result so far is returned; `Plan.left_out` lists what there was no time for. A fifth
    of the time is kept to complete an unfinished search by lowering, slowing and their certificates.

    Raises:
        InfeasibleError: the path leaves the space, takes longer than the battery lasts, or no profile is found.
        InputError: unknown planner, no model for it, speed factor or nodes out of range.
    """
    begun = time.perf_counter()
    _check_arguments(planner, nodes, speed_factor, bound=start is not None)
    check_space(path, limits.space)
    check_endurance(path.length / limits.plan.speed / speed_factor, limits, "at least ")
    task = PlanningTask(
        path, airframe, limits.plan, yaw=yaw, yaw_angle=yaw_angle, start=start, models=models,
        deadline=deadline.earlier(ANSWERING * deadline.left) if deadline.left < math.inf else NEVER,
    )  # fmt: skip
    best, notes, left_out = choose(planner, task, nodes, limits.space)
    repaired = flown = best.repaired
    if changed := repaired.describe():
        notes += (f"{best.planner}'s profile was {changed}",)
    if speed_factor < 1.0:
        flown = slow(task, repaired.trajectory.profile.slowed(speed_factor), limits.space)
    check_endurance(flown.trajectory.duration, limits)
    return Plan(
        path=path,
        airframe=airframe,
        limits=limits,
        trajectory=flown.trajectory,
        certificate=flown.certificate,
        planner=best.planner,
        nodes=best.nodes,
        repair_speed_factor=repaired.speed_factor,
        speed_factor=speed_factor,
        seconds=time.perf_counter() - begun,
        notes=notes,
        joints=best.joints,
        left_out=left_out,
    )


def default_budget(path: Path) -> float:
    """Return the default budget for planning a path, s."""
    return BUDGET + BUDGET_PER_METRE * path.length


def _check_arguments(planner: str, nodes: int | None, speed_factor: float, bound: bool) -> None:
    if planner != AUTO:
        find_planner(planner)
    if nodes is not None and nodes not in REASONABLE_NODES:
        raise InputError(
            f"nodes must be from {REASONABLE_NODES[0]} to {REASONABLE_NODES[-1]}, not {nodes}",
            where="nodes",
            hint="leave nodes out to have them chosen",
        )
    if not LEAST_SPEED_FACTOR <= speed_factor <= 1.0:
        raise InputError(
            f"the speed factor must be from {LEAST_SPEED_FACTOR} to 1, not {speed_factor:g}",
            where="speed_factor",
            hint="0.5 flies at half the speed",
        )
    if bound and speed_factor < 1.0:
        raise InputError(
            "a speed factor would break the boundary state that is given",
            where="speed_factor",
            hint="leave the speed factor or the boundary state out",
        )


def check_endurance(duration: float, limits: Limits, which: str = "") -> None:
    """Refuse a flight that takes longer than the battery lasts. Raises InfeasibleError."""
    ground = limits.ground
    height = limits.space.high[2] - limits.space.low[2]
    around = height / ground.take_off_speed + height / ground.land_speed
    if duration + around > limits.battery.endurance:
        raise InfeasibleError(
            f"the path takes {which}{duration:.1f} s, with take-off and landing up to {duration + around:.1f} s; the "
            f"battery is trusted for {limits.battery.endurance:g} s",
            where="battery.endurance",
            hint="fly fewer laps, a shorter path, or fly at a higher --speed",
        )
