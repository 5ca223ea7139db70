"""Prepare an on-board flight: from a path file to polynomials for the vehicle's own commander.

    path file → plan → slower where its fall would leave the walls → polynomials, certified as decoded → dry run
              → landing at their end → stops by go-to → mission

The commander has no time-out. The watchdog must stop the motors when the link dies, and from each moment the vehicle
must fall inside the walls.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError, NotCertifiedError
from cfplan.flight.on_board.certified_pieces import OnBoardTrajectory
from cfplan.flight.on_board.fall import Falls, falls_from
from cfplan.flight.on_board.go_to import STOP_DURATION, go_to_states, motion_of, stop_targets
from cfplan.flight.on_board.memory_format import MEMORY_SIZE, MOST_PIECES
from cfplan.flight.on_board.piece_certificate import Samples, certify_pieces, measures_along
from cfplan.flight.on_board.pieces import Pieces, states_at
from cfplan.flight.on_board.program import LANDING_PIECES, LANDING_SIZE, OnBoardProgram, with_landing
from cfplan.flight.on_board.reference import TAIL
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.setpoints.encoding import LEAD, RATE, encode_motion, encode_trajectory
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.planning.plan_result import Plan
from cfplan.preparation.export_flight import ExportedFlight, Form, fit_polynomials, plan_for_polynomials, slowed
from cfplan.preparation.local_slowing import Assessment, slow_locally
from cfplan.preparation.plan_flight import FlightOptions, PlannedFlight
from cfplan.preparation.steps import OnStep, ignore_steps, step
from cfplan.safety.limits import Limits
from cfplan.safety.quantities import QUANTITIES
from cfplan.safety.space import inside
from cfplan.simulation.dry_run import DryRun
from cfplan.simulation.link_loss import LinkLoss
from cfplan.vehicle.trajectory import Trajectory

_MARGIN = 0.02  # m inside the walls, planning's target: polynomials are slower than their plan, and near it
_DEVIATION = 0.04  # m, assumed in planning for the dry run
_FALL_HINT = (
    "keep the path farther from there, or fly it with a lower --speed; in a room with nets, write `outside: warn` "
    "under `link_loss` in safety.yaml"
)


@dataclass(frozen=True, slots=True)
class PreparedOnBoard:
    """A certified on-board mission, with its plan and checks."""

    planned: PlannedFlight
    dry_run: DryRun
    link_loss: LinkLoss  # the fall once the watchdog has stopped the motors
    mission: Mission

    @property
    def plan(self) -> Plan:
        """Return the plan, as slow as the polynomials are."""
        return self.planned.plan


def prepare_on_board_flight(
    source: Path, limits: Limits, options: FlightOptions | None = None, on_step: OnStep = ignore_steps
) -> PreparedOnBoard:
    """Plan, fit, certify and rehearse a flight by the vehicle's own commander, along a path file or of a plan file.

    Raises:
        InputError: a file or an option is wrong, or safety.yaml has the watchdog off.
        InfeasibleError: the path leaves the space, or no profile keeps the limits.
        NotCertifiedError: the certificate, the dry run, a stop, or the fall after link loss does not pass.
    """
    require_watchdog(limits)
    planned = plan_for_polynomials(source, limits, options or FlightOptions(), on_step)
    if not planned.was_read and not limits.link_loss.only_warn:
        planned = give_way_to_fall(planned, on_step)
    return with_program(planned, fit_for_program(planned, on_step), on_step)


def require_watchdog(limits: Limits) -> None:
    """Raise InputError unless the watchdog is on."""
    if not limits.firmware.watchdog:
        raise InputError(
            "the vehicle has no time-out for what it flies on board, and its watchdog is off",
            where="firmware.watchdog",
            hint="set it to true in safety.yaml: it stops the motors a second after the link died",
        )


def fit_for_program(planned: PlannedFlight, on_step: OnStep = ignore_steps) -> ExportedFlight:
    """Fit polynomials that leave room for the landing. Raises NotCertifiedError as fit_polynomials()."""
    pieces, room = MOST_PIECES - LANDING_PIECES, MEMORY_SIZE - LANDING_SIZE
    return fit_polynomials(planned, Form.MEMORY, most=pieces, room=room, on_step=on_step)


def with_program(planned: PlannedFlight, exported: ExportedFlight, on_step: OnStep = ignore_steps) -> PreparedOnBoard:
    """Return the mission of polynomials that were fitted to a plan, with the landing at their end.

    Raises NotCertifiedError if the landing, a stop, or the fall after link loss does not pass.
    """
    made, limits = exported.on_board, planned.limits
    memory, whole = with_landing(made, limits.space.low[2], limits.ground.land_speed)
    certificate = certify_pieces(whole, limits.airframe, limits.plan)
    if not certificate.passed:
        raise NotCertifiedError(
            f"the landing reaches {100 * certificate.worst.share:.1f} % of the limit on {certificate.worst.name}",
            where="landing", hint="lower `ground.land_speed` in safety.yaml; touching down takes 0.1 m/s anyhow",
        )  # fmt: skip
    lost, falls = _require_harmless_fall(made, limits, exported.dry_run.deviation, on_step)
    flown = slowed(planned, made.reference.slowing)
    mission = _mission(flown.plan, limits, made, on_step)
    program = OnBoardProgram(
        memory, made.compressed, len(whole.durations), _place(whole), _descent(whole, made, limits), falls,
        exported.dry_run.deviation,
    )  # fmt: skip
    return PreparedOnBoard(flown, exported.dry_run, lost, replace(mission, on_board=program))


def give_way_to_fall(planned: PlannedFlight, on_step: OnStep = ignore_steps) -> PlannedFlight:
    """Return the plan, slower where the vehicle would fall beyond the walls. Raises InfeasibleError if none helps."""

    space = planned.limits.space

    def assess(trajectory: Trajectory) -> list[Assessment]:
        time = np.arange(int(np.ceil(trajectory.duration * RATE)) + 1) / RATE
        state = trajectory.at(time)
        falls = falls_from(
            np.stack([state.position, state.velocity, state.acceleration], axis=1), planned.limits, _DEVIATION
        )
        return [
            Assessment(
                what="the fall after link loss",
                time=time,
                excess=falls.beyond + _MARGIN,
                reach=np.maximum(falls.reach, 1e-3),
                describe=lambda at: f"ends {space.describe(falls.beyond[at], falls.face[at])}",
                near=lambda at: space.faces[falls.face[at]],
                hint=_FALL_HINT,
            )
        ]

    with step(on_step, "slowing for the fall") as results:
        slower, _ = slow_locally(planned.plan, assess)
        results.append(slower.describe_slowing() or "not needed")
    return replace(planned, plan=slower)


def _require_harmless_fall(
    made: OnBoardTrajectory, limits: Limits, deviation: float, on_step: OnStep
) -> tuple[LinkLoss, str]:
    """Simulate the motors stopping at every moment of a trajectory; return the worst case, and its description.

    Raises NotCertifiedError if the vehicle falls beyond a wall, unless safety.yaml says only to warn.
    """
    time = np.arange(int(np.ceil(made.duration * RATE)) + 1) / RATE
    with step(on_step, "link loss on board") as results:
        falls: Falls = falls_from(made.reference.plan_at(time)[:, :3, :3], limits, deviation)
        at = falls.worst
        beyond = float(falls.beyond[at])
        lost = LinkLoss(float(time[at]), float(falls.distance[at]), beyond)
        where = limits.space.describe(beyond, int(falls.face[at]))
        (results.append if inside(beyond) else results.warn)(f"its watchdog stops the motors, it falls {where} at most")
        if not inside(beyond) and not limits.link_loss.only_warn:
            raise NotCertifiedError(
                f"link loss at {time[at]:.2f} s ends {where}: it flies on, and its watchdog stops the motors after 1 s",
                where="link loss on board",
                hint=_FALL_HINT,
            )
    return lost, where


def _mission(plan: Plan, limits: Limits, made: OnBoardTrajectory, on_step: OnStep) -> Mission:
    """Return the mission, whose setpoints and stops describe the motion of the vehicle's commander to the pilot.

    Raises NotCertifiedError if a stop exceeds the limits of stops, or leaves the space less its margin.
    """
    gains, space = gains_under(limits), limits.space
    encoded = encode_trajectory(plan.trajectory, hold=TAIL, gains=gains, space=space)
    count = round(STOP_DURATION * RATE) + 1
    with step(on_step, "stops") as results:
        begin = states_at(made.pieces, np.minimum(encoded.times, made.duration))[:, :3]
        stops = go_to_states(begin, stop_targets(begin), STOP_DURATION, count)
        check_stops(stops, limits)
        motion = motion_of(stops.reshape(-1, 5, 4), limits.airframe)
        sent = encode_motion(motion, motion.acceleration, gains, space=space)
        results.append(f"by go-to, certified from each of {len(begin)} moments")
    return Mission(encoded.payloads, sent.reshape(len(begin), count, PAYLOAD_SIZE), limits, LEAD)


def check_stops(stops: NDArray, limits: Limits) -> None:
    """Check the limits of stops, (N, M, 5, 4) states. Raises NotCertifiedError with the first moment at fault."""
    count = stops.shape[1]
    states = stops.reshape(-1, 5, 4)
    measured = measures_along(Samples(np.zeros(len(states)), states, np.zeros(len(states), bool)), limits.airframe)
    for quantity in QUANTITIES:
        if quantity.in_stop is None:
            continue
        value, limit = quantity.worst(measured), quantity.in_stop(limits)
        if (bad := ~(quantity.excess(value, limit) <= 0.0)).any():
            at = int(np.argmax(bad))
            raise NotCertifiedError(
                f"a stop reaches a {quantity.noun} of {value[at]:.3g} {quantity.unit}; it may be {limit:.3g}",
                where=f"stop at {at // count / RATE:.2f} s", hint="plan with a lower speed or acceleration",
            )  # fmt: skip
    beyond, face = limits.space.nearest(states[:, 0, :3])
    if not inside(beyond).all():
        at = int(np.argmax(beyond))
        raise NotCertifiedError(
            f"a stop comes {beyond[at]:.2f} m nearer to {limits.space.faces[face[at]]} than the margin",
            where=f"stop at {at // count / RATE:.2f} s",
            hint="keep the path farther from there, or plan with a lower speed",
        )


def _place(pieces: Pieces) -> tuple[float, float, float, float]:
    x, y, z, yaw = pieces.coefficients[0, :, 0].astype(float).tolist()
    return x, y, z, yaw


def _descent(pieces: Pieces, made: OnBoardTrajectory, limits: Limits) -> NDArray:
    """Return the landing at the end of the pieces as setpoints, (N, 29) uint8."""
    times = np.arange(int((pieces.duration - made.duration) * RATE)) / RATE + made.duration
    motion = motion_of(states_at(pieces, times), limits.airframe)
    return encode_motion(motion, motion.acceleration, gains_under(limits), space=limits.space)
