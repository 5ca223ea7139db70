"""From a path file or a plan file to a plan that is certified under the present limits."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cfplan.deadline import NEVER, Deadline
from cfplan.errors import InputError
from cfplan.files.suffixes import PLAN_SUFFIX
from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.geometry.path_file import PathFile, load_path_file
from cfplan.numbers import shown
from cfplan.planners.baselines.convex import lower_bound
from cfplan.planners.baselines.point_mass import point_mass_time
from cfplan.planners.task import PlanningTask
from cfplan.planning.path.choice import FastestPath, chosen_path
from cfplan.planning.plan import check_endurance, default_budget, plan
from cfplan.planning.plan_file import load_plan, save_plan
from cfplan.planning.plan_result import Plan
from cfplan.planning.planners import AUTO
from cfplan.planning.repair import repair_plan
from cfplan.preparation.glitch_assessment import assess_glitches
from cfplan.preparation.link_loss_assessment import MARGIN, assess_link_loss, assess_link_loss_of_stops
from cfplan.preparation.local_slowing import Assessment, SimulatedLinkLoss, slow_locally
from cfplan.preparation.steps import OnStep, ignore_steps, step
from cfplan.safety.certificate import Certificate, certify
from cfplan.safety.limits import Limits
from cfplan.safety.space import check_space
from cfplan.vehicle.correction import PlanCorrection, corrected
from cfplan.vehicle.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_AT_REST = 1e-3  # m/s and m/s²


@dataclass(frozen=True, slots=True)
class FlightOptions:
    """How to plan and encode a flight."""

    planner: str = AUTO
    nodes: int | None = None  # grid intervals; None chooses them by the path's length
    speed_factor: float | None = None  # of the speed that the limits allow; None takes the path file's
    stream_for: float = 0.0  # s, least duration of the setpoints, which hover after the end of the path
    budget: float | None = None  # s that planning and giving way may take; None chooses it by the path's length
    models: tuple[Path, ...] = ()  # folders of models to look in first
    correction: PlanCorrection | None = None  # of a plan file, learned from earlier flights of it


@dataclass(frozen=True, slots=True)
class PlannedFlight:
    """A plan, its name, and the limits under which it was certified."""

    name: str
    plan: Plan
    limits: Limits
    link_loss: SimulatedLinkLoss | None = None  # of the plan's bytes, if planning simulated it
    was_read: bool = False  # from a plan file, for which only the limits have been checked
    path_file: PathFile | None = None  # source of the plan, if known
    fastest: FastestPath | None = None  # the choice of its path, if there was one
    uncorrected: Plan | None = None  # the plan before its correction, if there is one

    def __repr__(self) -> str:
        verdict = "certified" if self.certificate.passed else "not certified"
        length, planner = self.plan.path.length, self.plan.planner
        return f"<Plan of {self.name!r}: {length:.1f} m in {self.duration:.2f} s by {planner}, {verdict}>"

    @property
    def certificate(self) -> Certificate:
        """Return the plan's certificate."""
        return self.plan.certificate

    @property
    def duration(self) -> float:
        """Return the time of flight along the path, s."""
        return self.plan.trajectory.duration

    def save(self, file: Path | str, provenance: Mapping[str, str] | None = None) -> None:
        """Write the plan as a Parquet file that `plan_flight` reads. Raises InputError if it cannot be written."""
        if Path(file).suffix != PLAN_SUFFIX:
            raise InputError(
                f"the name of a plan file must end in {PLAN_SUFFIX}", where=str(file), hint=f"add {PLAN_SUFFIX}"
            )
        save_plan(self.plan, file, {"name": self.name} | dict(provenance or {}))

    def plot(self) -> "Figure":
        """Return a matplotlib figure of the plan in its room, with its active limits, for `.savefig(file)`."""
        from cfplan.planning.figure import draw_plan

        return draw_plan(
            self.plan, self.name, path_file=self.path_file, least_snap=self.fastest and self.fastest.least_snap
        )

    def save_figure(self, file: Path, *, overwrite: bool = False) -> None:
        """Write the drawing as .png, .pdf or .svg. Raises InputError if it cannot be written."""
        from cfplan.planning.figure import save_figure

        save_figure(self.plot(), file, overwrite=overwrite)

    def lower_bound(self) -> float:
        """Return a lower bound, s, on flight times along the path at the plan's speed factor; takes up to a second."""
        plan = self.plan
        return lower_bound(PlanningTask(plan.path, plan.airframe, self.limits.plan)) / plan.speed_factor

    def point_mass_bound(self) -> float | None:
        """Return the time, s, of a point mass with these limits on speed and acceleration through the waypoints.

        None if the path was not chosen, there are too many waypoints, or none is found.
        """
        if self.path_file is None or self.fastest is None:
            return None
        time = point_mass_time(self.path_file.waypoints, self.limits.plan, self.path_file.regions)
        return None if time is None else time / self.plan.speed_factor

    def to_dict(self) -> dict[str, Any]:
        """Return the figures of the plan and its certificate, for JSON."""
        plan = self.plan
        return {
            "name": self.name,
            "vehicle": plan.airframe.name,
            "planner": plan.planner,
            "length": plan.path.length,
            "duration": plan.trajectory.duration,
            "nodes": plan.nodes,
            "planning_seconds": plan.seconds,
            "slowed": plan.repair_speed_factor,
            "speed_share": plan.speed_factor,
            "notes": list(plan.notes),
            "time_lost": plan.time_lost,
            "slower_for": list(plan.slowing.reasons) if plan.slowing else [],
            "left_out": plan.left_out,
            "certificate": plan.certificate.to_dict(),
        }


def plan_flight(
    source: Path | PathFile, limits: Limits, options: FlightOptions | None = None, on_step: OnStep = ignore_steps
) -> PlannedFlight:
    """Plan a path file, or read a plan file and certify it again. The certificate may fail: check it.

    With a correction, the plan of the file is shifted, slowed where it exceeds a limit, and gives way again.

    Raises:
        InputError: a file or an option is wrong.
        InfeasibleError: the path leaves the space, no profile keeps the limits, or link loss takes the vehicle outside.
    """
    if isinstance(source, Path) and source.suffix == PLAN_SUFFIX:
        read = _read_plan(source, limits, on_step)
        return read if options is None or options.correction is None else _corrected(read, options, on_step)
    options = options or FlightOptions()
    if options.correction is not None:
        raise InputError("a correction is of one plan", where=str(source), hint="name the file of that plan")
    with step(on_step, "path") as results:
        path_file = load_path_file(source) if isinstance(source, Path) else source
        deadline = Deadline.after(default_budget(path_file.path) if options.budget is None else options.budget)
        path_file, fastest = chosen_path(path_file, limits, budget=deadline.left, models=options.models)
        check_space(path_file.path, limits.space, waypoints=path_file.waypoints, where=str(path_file.source))
        results.append(f"{path_file.name}, {path_file.path.length:.1f} m, {len(path_file.waypoints)} waypoints")
        results += path_file.losses
    with step(on_step, "plan") as results:
        planned = plan(
            path_file.path,
            limits.airframe,
            limits,
            planner=options.planner,
            nodes=options.nodes,
            yaw=path_file.yaw,
            yaw_angle=path_file.yaw_angle,
            speed_factor=path_file.speed if options.speed_factor is None else options.speed_factor,
            deadline=deadline,
            models=options.models,
        )
        left = deadline.left
        at_share = f" at {planned.speed_factor:g} of full speed" if planned.speed_factor < 1.0 else ""
        results.append(f"{planned.trajectory.duration:.2f} s of flight{at_share} by {planned.planner}")
        if fastest:
            results.append(fastest.describe(planned.speed_factor))
        if planned.left_out:
            results.warn(f"the budget of time is spent: {planned.left_out}")
        results.details += planned.notes
    planned, link_loss = give_way(planned, on_step, Deadline.after(left))
    return PlannedFlight(path_file.name, planned, limits, link_loss, path_file=path_file, fastest=fastest)


def give_way(
    planned: Plan, on_step: OnStep = ignore_steps, deadline: Deadline = NEVER
) -> tuple[Plan, SimulatedLinkLoss | None]:
    """Return the plan, slower where link loss, in the plan or in a stop, would take the vehicle outside the walls, or
    where a gap in setpoints or poses would lose it; and the simulated link loss.

    If safety.yaml says only to warn of link loss, it is neither simulated nor a reason to slow. After the deadline
    plans are slowed more than necessary, which takes less time.

    Raises:
        InfeasibleError: at some place that happens at any speed, or the slower flight outlasts the battery.
    """
    limits = planned.limits

    def assess(trajectory: Trajectory) -> list[Assessment]:
        encoded = encode_trajectory(trajectory, gains=gains_under(limits), space=limits.space)
        if limits.link_loss.only_warn:
            return [assess_glitches(encoded, limits)]
        link_loss = assess_link_loss(encoded, limits)
        if not link_loss.passed or link_loss.simulated is None:
            return [link_loss]  # to be repaired before anything else is checked
        with ThreadPoolExecutor() as pool:
            stops = pool.submit(assess_link_loss_of_stops, encoded, limits, link_loss.simulated.moments)
            return [assess_glitches(encoded, limits), link_loss, stops.result()]

    with step(on_step, "slowing") as results:
        slowed, (glitches, *link_loss) = slow_locally(planned, assess, deadline)
        results.append(slowed.describe_slowing() or "not needed")
        for each, where in zip(link_loss, ("at any setpoint", "within sampled stops"), strict=False):
            inside = MARGIN - each.excess[each.worst]
            results.details.append(f"at least {inside:.2f} m inside the walls after link loss {where}")
        results.details.append(f"a gap {glitches.describe(glitches.worst)} at most")
        if slowed.slowing and deadline.passed:
            results.warn("perhaps more than needed, as the budget of time is spent")
    check_endurance(slowed.trajectory.duration, limits)
    return slowed, link_loss[0].simulated if link_loss else None


def _corrected(planned: PlannedFlight, options: FlightOptions, on_step: OnStep) -> PlannedFlight:
    """Return the plan with the correction of the options applied. Raises as give_way()."""
    assert options.correction is not None
    plan, before = planned.plan, planned.duration
    deadline = Deadline.after(default_budget(plan.path) if options.budget is None else options.budget)
    with step(on_step, "corrected") as results:
        path = corrected(plan.trajectory, options.correction).path
        caps = plan.slowing.caps if plan.slowing else None
        shifted = repair_plan(replace(plan, path=path), plan.profile, caps, deadline)
        duration = shifted.trajectory.duration
        results.append(f"{duration:.2f} s of flight ({shown(100 * (duration / before - 1.0), '+.1f')} %)")
    shifted, link_loss = give_way(shifted, on_step, deadline)
    return replace(planned, plan=shifted, link_loss=link_loss, was_read=False, uncorrected=plan)


def _read_plan(file: Path, limits: Limits, on_step: OnStep) -> PlannedFlight:
    """Read a plan made under any limits, and certify it under these.

    Raises InputError if its vehicle is another or it is not from rest to rest, InfeasibleError if it is too long.
    """
    with step(on_step, "plan") as results:
        plan = load_plan(file)
        if plan.airframe != limits.airframe:
            raise InputError(
                f"planned for {plan.airframe.name}, but safety.yaml has {limits.vehicle}",
                where=str(file),
                hint="plan the path again for this vehicle",
            )
        ends = plan.trajectory.at(np.array([0.0, plan.trajectory.duration]))
        moving = float(np.abs([ends.velocity, ends.acceleration]).max())
        if moving > _AT_REST:
            raise InputError(
                "it does not begin and end at rest", where=str(file),
                hint="a plan that was made in the air cannot be flown by itself: plan a path file",
            )  # fmt: skip
        check_endurance(plan.trajectory.duration, limits)
        caps = plan.slowing.caps if plan.slowing else None
        certificate = certify(plan.trajectory, limits.plan, limits.space, caps)
        results.append(f"{plan.trajectory.duration:.2f} s, {plan.planner}, read from {file}")
        if plan.slowing:
            results.append(plan.describe_slowing())
    return PlannedFlight(file.stem, replace(plan, limits=limits, certificate=certificate), limits, was_read=True)
