"""PlanningTask: the input of every planner, checked once where it is made."""

import math
import pathlib
from collections.abc import Callable
from dataclasses import astuple, dataclass, field

from cfplan.deadline import NEVER, Deadline
from cfplan.errors import InputError
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.planners.solution import Solution, Status
from cfplan.safety.feasibility import BOUNDARY_TOLERANCE, infeasible_limit, violated_limit
from cfplan.safety.limits import PlanLimits
from cfplan.safety.speed_caps import SpeedCaps
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import BoundaryState

LEAST_NODES = 12
NODES_PER_PIECE = 3  # of the path, at least, where a spline is laid over the grid
FREE_START = math.pi / 2  # rad, from the angle given on, within which yaw begins where it is FREE, as in the paper


@dataclass(frozen=True, slots=True)
class PlanningTask:
    """A path to be flown as fast as the limits allow, from a boundary state or from rest.

    Raises InputError where a number is not finite. Limits that exclude every plan raise no error: see `refusal`.
    """

    path: Path
    airframe: Airframe
    limits: PlanLimits
    nodes: int = 100  # intervals of the grid, uniform in s
    yaw: YawMode = YawMode.FIXED
    yaw_angle: float = 0.0  # rad: held where yaw is FIXED; where FREE, it begins within FREE_START above it
    start: BoundaryState | None = None  # None: free within the limits (a rest end)
    speed_caps: SpeedCaps | None = None  # along the path, besides the limit on speed
    deadline: Deadline = field(default=NEVER, compare=False, repr=False)  # by which to answer, if only with a reason
    dispensable: bool = field(default=False, compare=False, repr=False)  # abandoned at the deadline: others answered
    models: tuple[pathlib.Path, ...] = ()  # of the learned planner: folders of models, or one of a model itself
    refusal: Solution | None = field(init=False, compare=False, repr=False)
    """The solution of a planner that keeps all limits and boundary states, if no search is needed to see that none can
    be kept: the limits exclude hovering, or a boundary state breaks them. Other planners may answer otherwise."""

    def __post_init__(self) -> None:
        if not math.isfinite(self.yaw_angle):
            raise InputError(
                f"the yaw angle must be a finite number, not {self.yaw_angle}", where="yaw_angle", hint="give radians"
            )
        if self.start and not all(math.isfinite(value) for value in astuple(self.start)):
            raise InputError(
                f"the start state is not finite: {self.start}", where="start", hint="leave it out for a path at rest"
            )
        if self.speed_caps and not self.speed_caps.lie_within(self.path.end):
            raise InputError(
                f"speed caps from s = {self.speed_caps.s[0]:g} to {self.speed_caps.s[-1]:g} leave the path, which ends "
                f"at {self.path.end:g}",
                where="speed caps",
                hint="give places from 0 to the end of the path",
            )
        object.__setattr__(self, "refusal", self._refuse())

    def _refuse(self) -> Solution | None:
        if reason := infeasible_limit(self.airframe, self.limits):
            return Solution(Status.INFEASIBLE, None, reason)
        if self.start and (
            reason := violated_limit(self.start, self.path, 0.0, self.airframe, self.limits)
            or self._violated_cap(self.start)
        ):
            return Solution(Status.BAD_BOUNDARY, None, f"start: {reason}")
        return None

    def _violated_cap(self, start: BoundaryState) -> str:
        if not self.speed_caps:
            return ""
        speed, cap = math.sqrt(start.h) * math.hypot(*self.path(0.0, 1)), float(self.speed_caps.at(0.0))
        return f"speed is {speed:.4g} m/s, the cap {cap:.4g} m/s" if speed > (1.0 + BOUNDARY_TOLERANCE) * cap else ""

    def check_nodes(self) -> None:
        """Refuse fewer nodes than the path's shape needs; for planners that lay a spline over the grid.

        Raises:
            InputError: too few nodes; the hint names the least number.
        """
        pieces = len(self.path.breaks) - 1
        least = max(LEAST_NODES, NODES_PER_PIECE * pieces)
        if self.nodes < least:
            raise InputError(
                f"{self.nodes} nodes are too few for a path of {pieces} pieces",
                hint=f"take at least {least}; 100 is usual",
            )


Planner = Callable[[PlanningTask], Solution]  # an expert, learned, or baseline planner
