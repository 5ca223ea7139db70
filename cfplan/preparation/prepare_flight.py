"""Prepare a flight: the data flow from a path file to a mission, on one screen.

    path file → path → plan → certificate → bytes → dry run, link loss → stops → mission

Each arrow is one function from frozen dataclasses to frozen dataclasses. `prepare_flight` calls all of them in order;
commands that need only some steps call those.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cfplan.errors import NotCertifiedError
from cfplan.flight.pilot.mission import Mission, mission_of
from cfplan.flight.setpoints.byte_check import check_bytes
from cfplan.flight.setpoints.encoding import HOLD, EncodedFlight, encode_trajectory
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.setpoints.stop_certificate import StopCertificate, certify_stops
from cfplan.planning.plan_result import Plan
from cfplan.preparation.glitch_assessment import assess_glitches
from cfplan.preparation.link_loss_assessment import OUTSIDE_HINT, assess_link_loss_of_stops
from cfplan.preparation.local_slowing import SimulatedLinkLoss
from cfplan.preparation.plan_flight import FlightOptions, PlannedFlight, plan_flight
from cfplan.preparation.slow_motion import require_harmless_slow_motion
from cfplan.preparation.steps import OnStep, ignore_steps, step
from cfplan.safety.limits import Limits
from cfplan.safety.space import inside
from cfplan.simulation.dry_run import DryRun, dry_run
from cfplan.simulation.link_loss import LinkLoss, link_loss_at_every_setpoint, simulate_link_loss


@dataclass(frozen=True, slots=True)
class PreparedFlight:
    """A certified mission, with its plan and checks."""

    planned: PlannedFlight
    encoded: EncodedFlight
    dry_run: DryRun
    link_loss: LinkLoss
    stops: StopCertificate
    mission: Mission

    @property
    def plan(self) -> Plan:
        """Return the plan, with its certificate."""
        return self.planned.plan


def prepare_flight(
    source: Path, limits: Limits, options: FlightOptions | None = None, on_step: OnStep = ignore_steps
) -> PreparedFlight:
    """Plan, certify, encode and rehearse the flight along a path file or of a plan file.

    Raises:
        InputError: a file or an option is wrong.
        InfeasibleError: the path leaves the space, or no profile keeps the limits.
        NotCertifiedError: the certificate, the bytes, the dry run, link loss or a stop does not pass.
    """
    options = options or FlightOptions()
    planned = plan_flight(source, limits, options, on_step)
    encoded = encode_flight(planned, on_step, stream_for=options.stream_for)
    rehearsed = rehearse(planned, encoded, on_step)
    lost = find_link_loss(encoded, limits, on_step, planned.link_loss)
    if planned.was_read:  # else planning has checked it, for the same bytes
        require_glitch_margin(encoded, limits, on_step)
        require_harmless_stops(encoded, limits, on_step)
    mission, stops = make_mission(encoded, limits, on_step)
    require_harmless_slow_motion(mission, on_step)
    return PreparedFlight(planned, encoded, rehearsed, lost, stops, mission)


def prepare_mission(source: Path, limits: Limits, options: FlightOptions | None = None) -> Mission:
    """Plan, certify and encode a mission without rehearsing it or certifying its stops: only for the virtual vehicle.

    Studies of faults fly such missions. Raises what planning and encoding raise.
    """
    options = options or FlightOptions()
    return mission_of(encode_flight(plan_flight(source, limits, options), stream_for=options.stream_for), limits)


def encode_flight(planned: PlannedFlight, on_step: OnStep = ignore_steps, *, stream_for: float = 0.0) -> EncodedFlight:
    """Encode a certified plan, and check the bytes against the trajectory. Raises NotCertifiedError."""
    plan = planned.plan
    with step(on_step, "certificate") as results:
        worst = plan.certificate.worst
        results.append(f"worst {100 * worst.share:.1f} % of the limit on {worst.name} at {worst.time:.2f} s")
        if not plan.certificate.passed:
            raise NotCertifiedError(
                f"{worst.name} reaches {100 * worst.share:.1f} % of its limit at {worst.time:.2f} s",
                where=planned.name,
                hint="plan the path again under this safety.yaml",
            )
    with step(on_step, "bytes") as results:
        encoded = encode_trajectory(
            plan.trajectory,
            hold=max(HOLD, stream_for - plan.trajectory.duration),
            gains=gains_under(planned.limits),
            space=planned.limits.space,
        )
        check_bytes(encoded, plan.trajectory, planned.limits.plan)
        results.append(f"{len(encoded.payloads)} setpoints")
    return encoded


def rehearse(planned: PlannedFlight, encoded: EncodedFlight, on_step: OnStep = ignore_steps) -> DryRun:
    """Fly exactly these bytes in the simulator. Raises NotCertifiedError if the dry run fails."""
    limits = planned.limits
    with step(on_step, "dry run") as results:
        rehearsed = dry_run(encoded, planned.plan.trajectory, limits)
        results.append(f"largest deviation {rehearsed.expected()}")
        results.details.append(f"{rehearsed.real_time_factor:.0f} times faster than real time")
        rehearsed.require_passed()
    return rehearsed


def find_link_loss(
    encoded: EncodedFlight,
    limits: Limits,
    on_step: OnStep = ignore_steps,
    simulated: SimulatedLinkLoss | None = None,
) -> LinkLoss:
    """Simulate the loss of pilot or radio at every setpoint of the flight, and return the worst case.

    If planning has `simulated` the same bytes under these limits, its result is used. Raises NotCertifiedError if the
    vehicle comes down outside the walls, unless safety.yaml says only to warn.
    """
    with step(on_step, "link loss") as results:
        if simulated is not None and np.array_equal(simulated.payloads, encoded.payloads):
            lost = simulated.moments.worst
        else:
            lost = simulate_link_loss(encoded.payloads, limits)
        (results.append if inside(lost.beyond) else results.warn)(str(lost))
        if not inside(lost.beyond) and not limits.link_loss.only_warn:
            raise NotCertifiedError(str(lost), where="link loss", hint=OUTSIDE_HINT)
    return lost


def require_glitch_margin(encoded: EncodedFlight, limits: Limits, on_step: OnStep = ignore_steps) -> None:
    """Simulate a gap in setpoints, poses or both at every setpoint. Raises NotCertifiedError if one nearly loses the
    vehicle.
    """
    with step(on_step, "glitches") as results:
        assessed = assess_glitches(encoded, limits)
        results.append(f"a gap {assessed.describe(assessed.worst)} at most")
        if not assessed.passed:
            raise NotCertifiedError(f"a gap {assessed.describe(assessed.worst)}", where="glitches", hint=assessed.hint)


def require_harmless_stops(encoded: EncodedFlight, limits: Limits, on_step: OnStep = ignore_steps) -> None:
    """Simulate link loss within sampled stops. Raises NotCertifiedError if one ends outside the walls.

    Skipped if safety.yaml says only to warn of link loss.
    """
    if limits.link_loss.only_warn:
        return
    with step(on_step, "link loss of stops") as results:
        plan = link_loss_at_every_setpoint(encoded.payloads, limits)
        assessed = assess_link_loss_of_stops(encoded, limits, plan, margin=0.0)
        results.append(f"link loss within a stop {assessed.describe(assessed.worst)} at most")
        if not assessed.passed:
            why = (
                f"link loss within a stop at {assessed.time[assessed.worst]:.2f} s {assessed.describe(assessed.worst)}"
            )
            raise NotCertifiedError(why, where="link loss", hint=assessed.hint)


def make_mission(
    encoded: EncodedFlight, limits: Limits, on_step: OnStep = ignore_steps
) -> tuple[Mission, StopCertificate]:
    """Encode a stop from every setpoint and certify them all. Raises NotCertifiedError."""
    with step(on_step, "stops") as results:
        mission = mission_of(encoded, limits)
        stops = certify_stops(
            mission.stops, encoded.motion, limits, mission.rate, gains=encoded.gains, space=encoded.space
        )
        stops.require(limits)
        results.append(f"certified from each of {stops.count} setpoints, {stops.as_planned} within the plan's limits")
    return mission, stops
