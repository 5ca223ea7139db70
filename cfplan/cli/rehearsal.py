"""From a path file to setpoints that have been certified and rehearsed: the steps that plan, check, sim, fly share."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cfplan.cli.options import find_safety_file
from cfplan.cli.output import Steps

if TYPE_CHECKING:
    from cfplan.flight.encoding import EncodedFlight
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
    speed_share: float | None


def obtain_plan(path_or_plan: Path, options: PlanOptions, steps: Steps) -> "tuple[Plan, Limits]":
    """The plan of a path file, or the one in a plan file; either way certified against today's safety.yaml.

    Raises what loading, planning and certifying raise; a certificate that fails is not an error here.
    """
    from cfplan.safety.limits import load_limits

    with steps.step("limits") as said:
        safety_file = find_safety_file(options.safety_file, path_or_plan)
        limits = load_limits(safety_file)
        said.append(f"{limits.vehicle}, {limits.plan.speed:g} m/s, {limits.plan.acceleration:g} m/s² ({safety_file})")
    if path_or_plan.suffix == PLAN_SUFFIX:
        from cfplan.planning.files import load_plan

        with steps.step("plan") as said:
            plan = load_plan(path_or_plan, limits)
            said.append(f"{plan.trajectory.duration:.2f} s, {plan.planner}, read from {path_or_plan}")
        return plan, limits

    from cfplan.geometry.path_file import load_path_file
    from cfplan.planning.plan import plan as make_plan

    with steps.step("path") as said:
        path_file = load_path_file(path_or_plan)
        limits.space.require(path_file.path, waypoints=path_file.waypoints, where=str(path_or_plan))
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
            speed_share=options.speed_share if options.speed_share is not None else path_file.speed,
            name=path_file.name,
        )
        said.append(f"{plan.trajectory.duration:.2f} s of flight by {plan.planner}")
        said.extend(plan.notes)
    return plan, limits


def certify_bytes(plan: "Plan", limits: "Limits", steps: Steps) -> "EncodedFlight":
    """Show the certificate's worst share, encode the flight, and check what the bytes say."""
    from cfplan.errors import NotCertifiedError
    from cfplan.flight.encoding import check_bytes, encode_trajectory

    with steps.step("certificate") as said:
        worst = plan.certificate.worst
        said.append(f"worst {100 * worst.share:.1f} % of the limit on {worst.name} at {worst.time:.2f} s")
        if not plan.certificate.passed:
            raise NotCertifiedError(
                f"{worst.name} reaches {100 * worst.share:.1f} % of its limit at {worst.time:.2f} s",
                where=plan.name,
                hint="plan the path again under this safety.yaml",
            )
    with steps.step("bytes") as said:
        encoded = encode_trajectory(plan.trajectory)
        check_bytes(encoded, plan.trajectory, limits.plan)
        said.append(f"{len(encoded.payloads)} setpoints")
    return encoded


def rehearse(plan: "Plan", encoded: "EncodedFlight", limits: "Limits", steps: Steps) -> "DryRun":
    """Fly exactly these bytes in the simulator. Raises NotCertifiedError where the dry run fails."""
    from cfplan.errors import NotCertifiedError
    from cfplan.simulation.dry_run import dry_run

    with steps.step("dry run") as said:
        result = dry_run(encoded, plan.trajectory, limits.airframe, limits.flight)
        said.append(f"deviation {100 * result.max_deviation:.1f} cm at most, {100 * result.rms_deviation:.1f} cm rms")
        if not result.passed:
            raise NotCertifiedError(
                f"the dry run failed: {result.reason}", where=plan.name, hint="fly slower with --speed 0.7"
            )
    return result
