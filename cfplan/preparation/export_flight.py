"""Export: a certified plan for other tools, as polynomials of Crazyswarm, as the vehicle's memory, or as samples.

The written data is read back the way its receiver does, and certified. Polynomials are then flown in the simulator by
the vehicle's own commander.
"""

from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.files.atomic import atomic_output, write_atomically
from cfplan.files.suffixes import PLAN_SUFFIX
from cfplan.flight.on_board.certified_pieces import OnBoardTrajectory, certified_compressed, certified_pieces
from cfplan.flight.on_board.correction import correct
from cfplan.flight.on_board.memory_format import MEMORY_SIZE, MOST_PIECES
from cfplan.flight.on_board.pieces import Pieces
from cfplan.geometry.polynomial_csv import polynomial_rows, read_polynomial_rows
from cfplan.numbers import shown
from cfplan.planning.plan import check_endurance
from cfplan.preparation.plan_flight import FlightOptions, PlannedFlight, plan_flight
from cfplan.preparation.steps import OnStep, ignore_steps, step
from cfplan.safety.certificate import certify
from cfplan.safety.limits import Limits
from cfplan.safety.quantities import INSTANT
from cfplan.safety.space import inside
from cfplan.simulation.dry_run import DryRun
from cfplan.simulation.on_board_run import on_board_run
from cfplan.vehicle.measures import measures_of
from cfplan.vehicle.trajectory import Trajectory

GENTLE = 0.57  # of the limit on angular acceleration: polynomials overshoot at its jumps by the rest
COLUMNS = ["t", "x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "yaw", "wx", "wy", "wz", "qx", "qy", "qz", "qw"]
_DIGITS = 6
_ROUNDING = 0.5 * 10.0**-_DIGITS
COARSE = 0.01  # m from the plan; raw pieces with larger deviations are compared with compressed ones
_STRIDE = 10  # ms between the samples of a dry run for learning a correction


class Form(Enum):
    """The form of an export."""

    CRAZYSWARM = "crazyswarm"
    MEMORY = "memory"
    COMPRESSED = "compressed"
    SAMPLES = "samples"

    @property
    def suffix(self) -> str:
        """Return the suffix of its file."""
        return ".bin" if self in (Form.MEMORY, Form.COMPRESSED) else ".csv"


@dataclass(frozen=True, slots=True)
class ExportedFlight:
    """Certified polynomials, with their plan and checks."""

    planned: PlannedFlight
    on_board: OnBoardTrajectory
    dry_run: DryRun

    def to_dict(self) -> dict[str, Any]:
        """Return its figures, for JSON."""
        made = self.on_board
        return {
            "name": self.planned.name,
            "pieces": len(made.pieces.durations),
            "compressed": made.compressed,
            "bytes": len(made.memory),
            "duration": made.duration,
            "plan_duration": self.planned.duration,
            "slowing": made.reference.slowing,
            "leads": made.reference.leads,
            "fit_error": made.error,
            "start": made.pieces.coefficients[0, :, 0].astype(float).tolist(),
            "certificate": made.certificate.to_dict(),
            "dry_run": self.dry_run.summary(),
        }


def plan_for_polynomials(
    source: Path, limits: Limits, options: FlightOptions, on_step: OnStep = ignore_steps
) -> PlannedFlight:
    """Plan a path for polynomials, with less angular acceleration, or read a plan. Raises as plan_flight().

    A corrected plan is planned for polynomials too.
    """
    if source.suffix == PLAN_SUFFIX and options.correction is None:
        return plan_flight(source, limits, options, on_step)
    planned = plan_flight(source, limits_for_polynomials(limits), options, on_step)
    uncorrected = planned.uncorrected and replace(planned.uncorrected, limits=limits)
    return replace(planned, limits=limits, uncorrected=uncorrected)


def limits_for_polynomials(limits: Limits) -> Limits:
    """Return the limits for a plan to which polynomials are fitted: less angular acceleration, as fits overshoot it."""
    gentle = replace(limits.plan, angular_acceleration=GENTLE * limits.plan.angular_acceleration)
    streamed_loss = replace(limits.link_loss, only_warn=True)  # there is no stream
    return replace(limits, plan=gentle, link_loss=streamed_loss)


def fit_polynomials(
    planned: PlannedFlight,
    form: Form,
    *,
    leads: bool = True,
    most: int = MOST_PIECES,
    room: int = MEMORY_SIZE,
    on_step: OnStep = ignore_steps,
) -> ExportedFlight:
    """Fit certified polynomials to a plan, and fly them in the simulator.

    The form MEMORY is compressed, in at most `room` bytes, if `most` raw pieces are too few, or follow the plan less
    closely than compressed ones.

    Raises:
        InfeasibleError: they take longer than the battery is trusted for.
        NotCertifiedError: no polynomials keep the limits near the plan, or the dry run fails.
    """
    trajectory, limits = planned.plan.trajectory, planned.limits
    with step(on_step, "polynomials") as results:
        if form is Form.COMPRESSED:
            made = certified_compressed(trajectory, limits, leads=leads, room=room)
        elif form is Form.MEMORY:
            made = _raw_or_compressed(trajectory, limits, leads, most, room)
        else:
            made = certified_pieces(trajectory, limits, leads=leads, most=most)
        results.append(_describe(made, planned))
    with step(on_step, "dry run") as results:
        run = on_board_run(made, limits)
        results.append(f"largest deviation {run.expected()}")
    if leads:
        made, run = _corrected(made, run, planned, most, room, on_step)
    check_endurance(made.duration, limits)
    run.require_passed()
    return ExportedFlight(planned, made, run)


def _raw_or_compressed(trajectory: Trajectory, limits: Limits, leads: bool, most: int, room: int) -> OnBoardTrajectory:
    """Return raw pieces, or compressed ones if raw ones are too few or too coarse and these are nearer the plan."""
    try:
        raw = certified_pieces(trajectory, limits, leads=leads, most=most)
    except NotCertifiedError:
        return certified_compressed(trajectory, limits, leads=leads, room=room)
    if raw.error <= COARSE:
        return raw
    try:
        compressed = certified_compressed(trajectory, limits, leads=leads, room=room)
    except NotCertifiedError:
        return raw
    return compressed if compressed.error < raw.error else raw


def _corrected(
    made: OnBoardTrajectory, run: DryRun, planned: PlannedFlight, most: int, room: int, on_step: OnStep
) -> tuple[OnBoardTrajectory, DryRun]:
    """Return polynomials corrected by their dry run, with a new dry run, if that reduces the deviation."""
    trajectory, limits = planned.plan.trajectory, planned.limits
    times = run.loop.time[::_STRIDE]
    strayed = run.loop.position[::_STRIDE] - made.reference.plan_at(times)[:, 0, :3]
    with step(on_step, "correction") as results:
        correction = correct(times, strayed, made.duration)
        try:
            if made.compressed:
                better = certified_compressed(trajectory, limits, room=room, correction=correction)
            else:
                better = certified_pieces(trajectory, limits, most=most, correction=correction)
        except NotCertifiedError as error:
            results.append(f"none: {error.what}")
            return made, run
        again = on_board_run(better, limits)
        if not again.deviation < run.deviation:
            results.append("none: the vehicle strays no less")
            return made, run
        results.append(_describe(better, planned))
        results.append(f"largest deviation {again.expected()}")
    return better, again


def _describe(made: OnBoardTrajectory, planned: PlannedFlight) -> str:
    kind = f"compressed, {len(made.memory)} bytes" if made.compressed else f"{len(made.memory)} bytes"
    longer = made.duration / planned.duration - 1.0
    return (
        f"{len(made.pieces.durations)} pieces, {kind}, {made.duration:.2f} s ({shown(100 * longer, '+.1f')} %), "
        f"within {1000 * made.error:.0f} mm"
    )


def slowed(planned: PlannedFlight, slowing: float) -> PlannedFlight:
    """Return the flight with a plan that takes `slowing` times as long, certified again for polynomials."""
    plan, limits = planned.plan, planned.limits
    if slowing != 1.0:
        trajectory = Trajectory(plan.path, plan.profile.slowed(1.0 / slowing), plan.airframe)
        certificate = certify(trajectory, limits.plan, limits.space, plan.slowing.caps if plan.slowing else None)
        notes = (*plan.notes, f"slowed by {100 * (slowing - 1.0):.1f} % for polynomials")
        plan = replace(plan, trajectory=trajectory, certificate=certificate, notes=notes)
    return replace(planned, plan=replace(plan, limits=limits))


def write_polynomials(exported: ExportedFlight, form: Form, file: Path) -> None:
    """Write polynomials, and read them back like their receiver. Raises InputError or NotCertifiedError."""
    pieces = exported.on_board.pieces
    if form is not Form.CRAZYSWARM:
        write_atomically(file, exported.on_board.memory)
        return
    with atomic_output(file) as unfinished:
        unfinished.write_bytes(polynomial_rows(pieces.durations, pieces.coefficients).encode())
        read = Pieces(*read_polynomial_rows(unfinished))
        if not (
            np.array_equal(read.durations, pieces.durations) and np.array_equal(read.coefficients, pieces.coefficients)
        ):
            raise NotCertifiedError("the file reads back differently", where=str(file), hint="please report this")


def write_samples(planned: PlannedFlight, rate: float, file: Path, wait: float = 0.0) -> int:
    """Write a plan's states at `rate`, Hz, including its end, and check the file; return the number of samples.

    Before its plan the vehicle hovers at the start for `wait`, s. Raises InputError, or NotCertifiedError if the plan's
    certificate or a sample exceeds a limit.
    """
    trajectory, limits = planned.plan.trajectory, planned.limits
    worst = planned.certificate.worst
    if not planned.certificate.passed:
        raise NotCertifiedError(
            f"{worst.name} reaches {100 * worst.share:.1f} % of its limit at {worst.time:.2f} s",
            where=planned.name, hint="plan the path again under this safety.yaml",
        )  # fmt: skip
    rows = sample_rows(trajectory, rate, wait)
    lines = [",".join(f"{value:.{_DIGITS}f}" for value in row) for row in rows.tolist()]
    with atomic_output(file) as unfinished:
        unfinished.write_bytes(("\n".join([",".join(COLUMNS), *lines]) + "\n").encode())
        read = np.loadtxt(unfinished, delimiter=",", skiprows=1, ndmin=2)
        check_samples(read, trajectory, limits, str(file), wait)
    return len(read)


def sample_rows(trajectory: Trajectory, rate: float, wait: float = 0.0) -> NDArray:
    """Return (N, 18): the columns of a file of samples, SI units and rad, the quaternion body to world."""
    end = wait + trajectory.duration
    times = np.unique(np.round(np.append(np.arange(np.ceil(end * rate)) / rate, end), _DIGITS))
    state = trajectory.at(times - wait)
    return np.column_stack(
        [
            times, state.position, state.velocity, state.acceleration, state.yaw, state.body_rate, state.quaternion,
        ]
    )  # fmt: skip


def check_samples(rows: NDArray, trajectory: Trajectory, limits: Limits, where: str, wait: float = 0.0) -> None:
    """Check that samples, (N, 18), agree with a trajectory after `wait`, s, and keep the limits, up to rounding.

    Raises NotCertifiedError with the line.
    """
    state = trajectory.at(rows[:, 0] - wait)
    expected = [
        state.position, state.velocity, state.acceleration, state.yaw, state.body_rate, state.quaternion,
    ]  # fmt: skip
    slack = 50.0 * _ROUNDING  # includes the motion within the rounding of time
    measured = measures_of(rows[:, 4:7], rows[:, 7:10], rows[:, 11:14], state.thrust_axis, state.specific_thrust)
    exceeded = [q.excess(q.worst(measured), q.allowed(limits.plan)) > slack for q in INSTANT]
    wrong = np.abs(rows[:, 1:] - np.column_stack(expected)).max(axis=1) > slack
    bad = wrong | np.any(exceeded, axis=0) | ~inside(limits.space.nearest(rows[:, 1:4])[0], slack)
    if bad.any():
        raise NotCertifiedError(
            "the sample is not that of the plan, or exceeds a limit",
            where=f"{where}:{int(np.argmax(bad)) + 2}", hint="plan the path again, and export that",
        )  # fmt: skip
