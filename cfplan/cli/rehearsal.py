"""From a path file to setpoints that have been certified and rehearsed: the steps that plan, check, sim, fly share."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfplan.cli.options import find_safety_file
from cfplan.cli.output import Steps
from cfplan.errors import InputError

if TYPE_CHECKING:
    from cfplan.flight.setpoints.encoding import EncodedFlight
    from cfplan.planning.plan import Plan
    from cfplan.safety.limits import Limits
    from cfplan.simulation.dry_run import DryRun

PLAN_SUFFIX = ".parquet"


@dataclass(frozen=True, slots=True)
class PlanOptions:
    """How to plan, as given on the command line."""

    safety_file: Path | None
    planner: str
    nodes: int | None
    speed_factor: float | None


@dataclass(frozen=True, slots=True)
class PlannedFlight:
    """A plan with its name and the limits that hold today."""

    name: str
    plan: "Plan"
    limits: "Limits"
    lower_bound: float | None = None
    # s, that no flight along the path can beat; None where it was not asked

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        plan = self.plan
        return {
            "name": self.name,
            "vehicle": plan.airframe.name,
            "planner": plan.planner,
            "length": plan.path.length,
            "duration": plan.trajectory.duration,
            "lower_bound": self.lower_bound,
            "nodes": plan.nodes,
            "planning_seconds": plan.seconds,
            "slowed": plan.repair_speed_factor,
            "speed_share": plan.speed_factor,
            "notes": list(plan.notes),
            "certificate": plan.certificate.to_dict(),
        }


def obtain_plan(path_or_plan: Path, options: PlanOptions, steps: Steps) -> PlannedFlight:
    """The plan of a path file, or the one in a plan file; either way certified against today's safety.yaml.

    Raises what loading, planning and certifying raise; a certificate that fails is not an error here.
    """
    from cfplan.safety.limits_file import load_limits

    with steps.step("limits") as said:
        safety_file = find_safety_file(options.safety_file, path_or_plan)
        limits = load_limits(safety_file)
        said.append(f"{limits.vehicle}, {limits.plan.speed:g} m/s, {limits.plan.acceleration:g} m/s² ({safety_file})")
    if path_or_plan.suffix == PLAN_SUFFIX:
        with steps.step("plan") as said:
            plan = _read_plan(path_or_plan, limits)
            said.append(f"{plan.trajectory.duration:.2f} s, {plan.planner}, read from {path_or_plan}")
        return PlannedFlight(path_or_plan.stem, plan, limits)

    from cfplan.geometry.path_file import load_path_file
    from cfplan.planners.baselines.convex import lower_bound
    from cfplan.planners.task import PlanningTask
    from cfplan.planning.plan import plan as make_plan
    from cfplan.safety.space import check_space

    with steps.step("path") as said:
        path_file = load_path_file(path_or_plan)
        check_space(path_file.path, limits.space, waypoints=path_file.waypoints, where=str(path_or_plan))
        said.append(f"{path_file.name}, {path_file.path.length:.1f} m, {len(path_file.waypoints)} waypoints")
    with steps.step("plan") as said:
        plan = make_plan(
            path_file.path,
            limits.airframe,
            limits,
            planner=options.planner,
            nodes=options.nodes,
            yaw=path_file.yaw,
            yaw_angle=path_file.yaw_angle,
            speed_factor=options.speed_factor if options.speed_factor is not None else path_file.speed,
        )
        said.append(f"{plan.trajectory.duration:.2f} s of flight by {plan.planner}")
        said.extend(plan.notes)
    with steps.step("bound") as said:
        bound = plan.lower_bound or lower_bound(PlanningTask(plan.path, plan.airframe, limits.plan))
        said.append(
            f"no flight takes less than {bound:.2f} s; this one {plan.trajectory.duration / bound - 1:.1%} more"
        )
    return PlannedFlight(path_file.name, plan, limits, bound)


def _read_plan(file: Path, limits: "Limits") -> "Plan":
    """What was planned under other limits must keep today's; what was planned for another vehicle cannot."""
    from dataclasses import replace

    from cfplan.planning.plan_file import load_plan
    from cfplan.safety.certificate import certify

    plan = load_plan(file)
    if plan.airframe != limits.airframe:
        raise InputError(
            f"planned for {plan.airframe.name}, but safety.yaml has {limits.vehicle}",
            where=str(file),
            hint="plan the path again for this vehicle",
        )
    return replace(plan, limits=limits, certificate=certify(plan.trajectory, limits.plan, limits.space))


def certify_bytes(flight: PlannedFlight, steps: Steps) -> "EncodedFlight":
    """Show the certificate's worst share, encode the flight, and check what the bytes say."""
    from cfplan.errors import NotCertifiedError
    from cfplan.flight.setpoints.encoding import encode_checked

    plan, certificate = flight.plan, flight.plan.certificate
    with steps.step("certificate") as said:
        worst = certificate.worst
        said.append(f"worst {100 * worst.share:.1f} % of the limit on {worst.name} at {worst.time:.2f} s")
        if not certificate.passed:
            raise NotCertifiedError(
                f"{worst.name} reaches {100 * worst.share:.1f} % of its limit at {worst.time:.2f} s",
                where=flight.name,
                hint="plan the path again under this safety.yaml",
            )
    with steps.step("bytes") as said:
        encoded = encode_checked(plan.trajectory, flight.limits.plan)
        said.append(f"{len(encoded.payloads)} setpoints")
    return encoded


def rehearse(flight: PlannedFlight, encoded: "EncodedFlight", steps: Steps) -> "DryRun":
    """Fly exactly these bytes in the simulator, and see where they lead if the pilot dies.

    Raises NotCertifiedError where the dry run fails.
    """
    from cfplan.simulation.dry_run import dry_run
    from cfplan.simulation.link_loss import orphaned

    with steps.step("dry run") as said:
        result = dry_run(encoded, flight.plan.trajectory, flight.limits.airframe, flight.limits.flight)
        said.append(f"deviation {100 * result.deviation:.1f} cm at most, {100 * result.deviation_rms:.1f} cm rms")
        said.append(f"{result.real_time_factor:.0f} times real time")
        result.require_passed()
    with steps.step("lost pilot") as said:
        said.append(str(orphaned(encoded.payloads, flight.limits)))
    return result
