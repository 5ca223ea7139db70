"""Solution: a planner's answer, a speed profile or the reason why there is none."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from cfplan.vehicle.profile import SpeedProfile


class Status(StrEnum):
    """How planning ended; the text names the remedy."""

    SOLVED = "solved"
    NOT_CONVERGED = "the solver did not converge; try more nodes or another planner"
    INFEASIBLE = "no profile meets the limits; loosen them or make the path gentler"
    OUT_OF_TIME = "the budget of time was spent; give more, or take fewer nodes"
    BAD_BOUNDARY = "the boundary state breaks the limits; start slower or loosen them"


@dataclass(frozen=True, slots=True)
class Solution:
    """A planner's answer. Not certified: only the certificate decides whether a profile keeps its limits."""

    status: Status
    profile: SpeedProfile | None  # None exactly when the status is not SOLVED
    reason: str = ""  # the solver's message: why there is no profile, or which part of it is not solved
    stats: Mapping[str, float | int | str] = field(default_factory=dict)  # solve_seconds, iterations, solver, …
    joints: tuple[float, ...] = ()  # s, where the windows of a long path meet
