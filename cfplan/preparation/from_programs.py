"""Planning and rehearsing from programs, by the functions that commands use: `import cfplan` offers them."""

from pathlib import Path

from numpy.typing import ArrayLike

from cfplan.errors import InputError
from cfplan.geometry import path_file
from cfplan.geometry.path_file import PathFile
from cfplan.planning.planners import AUTO
from cfplan.preparation import prepare_flight
from cfplan.preparation.plan_flight import FlightOptions, PlannedFlight, plan_flight
from cfplan.preparation.steps import OnStep, ignore_steps
from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.dry_run import DryRun


def load_path(source: Path | str | ArrayLike) -> PathFile:
    """Return the path of a path file, or through waypoints, (K, 3) m, at yaw 0.

    Raises InputError, with place and hint, if the file does not exist or has a mistake, or the points are invalid.
    """
    return path_file.load_path_file(source) if isinstance(source, Path | str) else path_file.path_through(source)


def plan(
    path: PathFile | Path | str | ArrayLike,
    limits: Limits | Path | str,
    *,
    planner: str = AUTO,
    speed_factor: float | None = None,
    budget: float | None = None,
    on_step: OnStep = ignore_steps,
) -> PlannedFlight:
    """Plan a path under limits and certify it, as `cfplan plan` does; or read a plan file and certify it anew.

    Args:
        path: from load_path, or a path file, or a plan file (.parquet), or waypoints, (K, 3) m.
        limits: from load_limits, or a safety.yaml.
        planner: "auto", "learned", "expert", "convex", …; docs/planning.md has them.
        speed_factor: of the speed that the limits allow, above 0 and at most 1; None takes the path's own.
        budget: s that planning and giving way may take together; None chooses it by the path's length.
        on_step: called with the steps of planning.

    Raises:
        InputError: a file or an argument is wrong.
        InfeasibleError: the path leaves the space, no profile keeps the limits, or link loss takes the vehicle outside.
    """
    if not isinstance(limits, Limits):
        if not isinstance(limits, Path | str):
            raise InputError(
                f"{type(limits).__name__} is neither limits nor a file", where="limits", hint='give "safety.yaml"'
            )
        limits = load_limits(limits)
    if not isinstance(path, PathFile | Path | str):
        path = path_file.path_through(path)
    source = Path(path) if isinstance(path, str) else path
    options = FlightOptions(planner=planner, speed_factor=speed_factor, budget=budget)
    return plan_flight(source, limits, options, on_step)


def rehearse(plan: PlannedFlight, *, on_step: OnStep = ignore_steps) -> DryRun:
    """Fly the plan's own setpoints in the simulator, as `cfplan fly` does in its dry run; `.deviation` is the worst, m.

    Raises NotCertifiedError if the certificate, the setpoints or the dry run fail.
    """
    if not isinstance(plan, PlannedFlight):
        raise InputError(
            f"{type(plan).__name__} is not a plan", where="plan", hint="make it with cfplan.plan(path, limits)"
        )
    return prepare_flight.rehearse(plan, prepare_flight.encode_flight(plan, on_step), on_step)
