"""The one entry to planning: from a path and limits to a certified trajectory, and how it came about."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cfplan.errors import InfeasibleError, InputError, NotCertifiedError
from cfplan.expert.solution import Solution
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.planning.planners import find_planner
from cfplan.planning.repair import repair
from cfplan.safety.certificate import Certificate
from cfplan.safety.limits import Limits
from cfplan.safety.slowing import Slowed
from cfplan.safety.space import check_space
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import BoundaryState, SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

NODES_PER_METRE = 10
FEWEST_NODES, MOST_NODES = 60, 3000
NODES_PER_PIECE = 4
GOOD_SHARE = 0.97  # a plan that had to be slowed further is worth a second try with twice the nodes
LEAST_SPEED_SHARE = 0.01
FALLBACKS = ("convex", "min-snap")


@dataclass(frozen=True, slots=True)
class Plan:
    """A certified trajectory and how it came about."""

    path: Path
    airframe: Airframe
    limits: Limits
    trajectory: Trajectory
    certificate: Certificate
    planner: str
    # the one that succeeded
    nodes: int
    # intervals of the profile
    slowed: float
    # share of the planner's speed at which the plan passed, 1 where nothing had to change
    speed_share: float
    # share of that which was asked for
    seconds: float
    # s that planning took, all tries and certificates included
    notes: tuple[str, ...]
    # what a reader should know, one sentence each

    @property
    def profile(self) -> SpeedProfile:
        """The profile as flown, slowing included."""
        return self.trajectory.profile


def default_nodes(path: Path) -> int:
    """Intervals for a path: ten a metre, within bounds, and a few for each of its pieces."""
    by_length = int(np.clip(round(NODES_PER_METRE * path.length), FEWEST_NODES, MOST_NODES))
    return max(by_length, NODES_PER_PIECE * (len(path.breaks) - 1))


def plan(
    path: Path,
    airframe: Airframe,
    limits: Limits,
    *,
    planner: str = "expert",
    nodes: int | None = None,
    yaw: YawMode = YawMode.FIXED,
    yaw_angle: float = 0.0,
    speed_share: float = 1.0,
    start: BoundaryState | None = None,
    end: BoundaryState | None = None,
) -> Plan:
    """The fastest certified flight along the path that the planner finds.

    `speed_share` slows the whole result: the same motion at that share of its speed, so that accelerations fall with
    its square. Where a boundary state is given, nothing may be slowed, or it would no longer hold.

    Raises:
        InfeasibleError: the path leaves the space, takes longer than the battery lasts, or no profile is found.
        InputError: unknown planner, speed share or nodes out of range.
    """
    begun = time.perf_counter()
    _check_arguments(nodes, speed_share, bound=start is not None or end is not None)
    check_space(path, limits.space)
    count = nodes if nodes is not None else default_nodes(path)

    notes: list[str] = []
    tries = _tries(planner, count, fixed=nodes is not None)
    options = {"yaw": yaw, "yaw_angle": yaw_angle, "start": start, "end": end}
    slowed, name, count = _best(path, airframe, limits, planner, tries, options, notes)
    if slowed.share < 1.0:
        if start is not None or end is not None:
            raise InfeasibleError(
                f"the profile passes only at {slowed.share:.2%} of its speed, which would break the boundary state",
                hint="start slower, or leave the boundary free",
            )
        notes.append(f"{name}'s profile was slowed to {slowed.share:.2%} of its speed to pass")
    flown = slowed
    if speed_share < 1.0:
        flown = repair(path, slowed.trajectory.profile.slowed(speed_share), airframe, limits.plan, limits.space)
    _check_endurance(flown.trajectory.duration, limits)
    return Plan(
        path=path,
        airframe=airframe,
        limits=limits,
        trajectory=flown.trajectory,
        certificate=flown.certificate,
        planner=name,
        nodes=count,
        slowed=slowed.share,
        speed_share=speed_share,
        seconds=time.perf_counter() - begun,
        notes=tuple(notes),
    )


def _check_arguments(nodes: int | None, speed_share: float, bound: bool) -> None:
    if nodes is not None and not 2 <= nodes <= 10 * MOST_NODES:
        raise InputError(
            f"{nodes} nodes; 2 to {10 * MOST_NODES} make sense",
            where="nodes",
            hint="leave nodes out to have them chosen",
        )
    if not LEAST_SPEED_SHARE <= speed_share <= 1.0:
        raise InputError(
            f"a speed share of {speed_share:g} is not from {LEAST_SPEED_SHARE} to 1",
            where="speed_share",
            hint="0.5 flies at half the speed",
        )
    if bound and speed_share < 1.0:
        raise InputError(
            "a speed share would break the boundary state that is given",
            where="speed_share",
            hint="leave the share or the boundary state out",
        )


def _tries(planner: str, nodes: int, fixed: bool) -> Iterator[tuple[str, int]]:
    """What to try, in order: more nodes unless they are fixed, then planners that hardly fail."""
    yield planner, nodes
    if not fixed:
        yield planner, 2 * nodes
    for fallback in FALLBACKS:
        if fallback != planner:
            yield fallback, nodes


def _best(
    path: Path,
    airframe: Airframe,
    limits: Limits,
    planner: str,
    tries: Iterator[tuple[str, int]],
    options: Mapping[str, Any],
    notes: list[str],
) -> tuple[Slowed, str, int]:
    """The fastest of the planner's tries, or the first of a fallback; stops at the first good one."""
    best: tuple[Slowed, str, int] | None = None
    for name, nodes in tries:
        if best is not None and (best[0].share >= GOOD_SHARE or name != planner):
            break
        solution = find_planner(name)(path, airframe, limits.plan, nodes=nodes, **options)
        if solution.profile is None:
            notes.append(_failure(name, nodes, solution))
            continue
        try:
            found = repair(path, solution.profile, airframe, limits.plan, limits.space)
        except (InfeasibleError, NotCertifiedError) as error:
            notes.append(f"{name} with {nodes} nodes: {error}")
            continue
        if best is None or found.trajectory.duration < best[0].trajectory.duration:
            best = found, name, nodes
    if best is None:
        raise InfeasibleError(
            f"no plan. {'; '.join(notes)}", hint="loosen the plan's limits, or make the path gentler or longer"
        )
    return best


def _failure(name: str, nodes: int, solution: Solution) -> str:
    own_words = f" ({' '.join(solution.reason.split())})" if solution.reason else ""
    return f"{name} with {nodes} nodes: {solution.status}{own_words}"


def _check_endurance(duration: float, limits: Limits) -> None:
    ground = limits.ground
    height = limits.space.high[2] - limits.space.low[2]
    around = height / ground.take_off_speed + height / ground.land_speed
    if duration + around > limits.battery.endurance:
        raise InfeasibleError(
            f"the path takes {duration:.1f} s, with take-off and landing up to {duration + around:.1f} s; the battery "
            f"is trusted for {limits.battery.endurance:g} s",
            where="battery.endurance",
            hint="fly fewer laps, a shorter path, or a larger share of the speed",
        )
