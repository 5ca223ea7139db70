"""The plan that a log is compared with: as it was flown, or planned as by `cfplan fly`."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from cfplan.cli import options
from cfplan.errors import InfeasibleError

if TYPE_CHECKING:
    from cfplan.cli.output import Steps
    from cfplan.planning.plan_result import Plan
    from cfplan.recording.overlay import Reference
    from cfplan.safety.limits import Limits

FAR = 1e6  # m


def reference_plan(source: Path, safety_file: Path | None, steps: "Steps") -> "Reference":
    """Return the plan of a record or of a plan file as it was flown, else plan the path file as `cfplan fly` does.

    Showing a flight must not fail because of the room: a path that the present safety.yaml refuses is planned without
    walls, and a warning is printed.

    Raises InputError if a file is wrong, InfeasibleError if no profile keeps the limits of motion.
    """
    from cfplan.files.suffixes import PLAN_SUFFIX
    from cfplan.preparation.plan_flight import FlightOptions, plan_flight
    from cfplan.recording.overlay import reference_of
    from cfplan.recording.record import PLAN_FILE

    file = source / PLAN_FILE if (source / PLAN_FILE).is_file() else source
    if file.suffix == PLAN_SUFFIX:  # as planned then, under the limits in the file
        options.refuse(("safety_file",), "the plan of --plan is shown as it was planned", "leave it out")
        from cfplan.planning.plan_file import load_plan

        with steps.step("plan") as results:
            trajectory = load_plan(file).trajectory
            results.append(f"{trajectory.duration:.2f} s, read from {file}")
        return reference_of(trajectory, file.stem if file is source else source.resolve().name)
    limits = options.read_limits(safety_file, source, steps)
    try:
        planned = plan_flight(source, limits, FlightOptions(), steps)
    except InfeasibleError as error:
        with steps.step("room") as results:
            results.warn(f"not to be flown there: {error.what}")
        plan = _without_walls(source, limits, steps)
        return reference_of(plan.trajectory, source.stem)
    return reference_of(planned.plan.trajectory, planned.name)


def _without_walls(source: Path, limits: "Limits", steps: "Steps") -> "Plan":
    """Plan a path file within the limits of motion alone. Raises InfeasibleError if no profile keeps them."""
    from cfplan.geometry.path_file import load_path_file
    from cfplan.planning.path.choice import chosen_path
    from cfplan.planning.plan import plan

    everywhere = replace(limits.space, low=(-FAR, -FAR, -FAR), high=(FAR, FAR, FAR), obstacles=())
    for_ever = replace(limits.battery, endurance=math.inf)
    limits = replace(limits, space=everywhere, battery=for_ever)
    with steps.step("plan") as results:
        path_file, _ = chosen_path(load_path_file(source), limits)
        planned = plan(
            path_file.path,
            limits.airframe,
            limits,
            yaw=path_file.yaw,
            yaw_angle=path_file.yaw_angle,
            speed_factor=path_file.speed,
        )
        results.append(f"{planned.trajectory.duration:.2f} s by {planned.planner}, as if there were no walls")
    return planned
