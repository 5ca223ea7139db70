"""What a planner answers: a profile, or the reason why there is none."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import BoundaryState, SpeedProfile


class Status(StrEnum):
    """How planning ended; the text names the remedy."""

    SOLVED = "solved"
    NOT_CONVERGED = "the solver did not converge; try more nodes or another planner"
    INFEASIBLE = "no profile meets the limits; loosen them or make the path gentler"
    BAD_BOUNDARY = "the boundary state breaks the limits; start slower or loosen them"


@dataclass(frozen=True, slots=True)
class Solution:
    """A planner's answer. Not certified: what a solver says of itself counts for nothing."""

    status: Status
    profile: SpeedProfile | None
    # None exactly when the status is not SOLVED
    reason: str = ""
    # the solver's own words, for people
    stats: Mapping[str, float | int | str] = field(default_factory=dict)
    # solve_seconds, iterations, solver, …
    joints: tuple[float, ...] = ()
    # s, where the windows meet that a long path was taken by


class Planner(Protocol):
    """Any way to find a speed profile: expert, learned, or baseline."""

    def __call__(
        self,
        path: Path,
        airframe: Airframe,
        limits: PlanLimits,
        *,
        nodes: int = 100,
        yaw: YawMode = YawMode.FIXED,
        yaw_angle: float = 0.0,
        start: BoundaryState | None = None,
        end: BoundaryState | None = None,
    ) -> Solution:
        """Plan over `nodes` intervals uniform in s. A boundary left out is free within the limits (a rest end)."""
