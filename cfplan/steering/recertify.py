"""Certify a record again: everything that its pilot was committed to, and that it streamed exactly this.

Each committed plan is read from its file and certified again, from the vehicle as simulated up to its splice: its
limits, its bytes, a stop from each setpoint, link loss, gaps and the dry run. Its setpoints and stops must equal those
that the pilot verified, to the byte, and each streamed setpoint the committed one. Plans that were committed in parts
are certified part by part.
"""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.air.certifying import STOP_AND_HOVER, Onward, certify_beginning, certify_whole
from cfplan.air.stopping import STOPS, stop_within
from cfplan.air.timeline import Replanned, Timeline, hold, hold_hover, joint_of
from cfplan.errors import CfplanError, InputError, NotCertifiedError
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.setpoints.commitment import propose, spliced
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, decode
from cfplan.flight.telemetry import Phase
from cfplan.planning.plan_file import load_plan
from cfplan.planning.plan_result import Plan
from cfplan.recording.commitments import committed_setpoints
from cfplan.recording.record import PLAN_FILE, PLAN_IN_FLIGHT, Record
from cfplan.safety.certificate import Certificate
from cfplan.safety.limits import Limits

YAW = "yaw"  # key of the initial yaw, rad, of a steered flight in a header's provenance
_SAME = 1e-6  # m, m/s, m/s², m/s³, tolerated jump of the motion at a joint
_RUNGS = tuple(f"{rung.name.lower()}:" for rung in Rung)


@dataclass(frozen=True, slots=True)
class Recertified:
    """The result of certifying a record again."""

    plans: int  # committed plans
    stops: int  # requested and committed stops
    certificate: Certificate | None  # of the plan with the largest usage; None for a hover only
    joints: int  # joints without a jump
    jump: float  # the largest, in m, m/s, m/s² or m/s³
    committed: int  # setpoints, each with its stop
    streamed: int  # setpoints that were sent, each as committed
    left_after: float | None  # s from setpoint 0, when a rung of the abort ladder was taken; None if none was

    def rows(self) -> list[tuple[str, str]]:
        """Return rows of text."""
        left = f", until the plan was left after {self.left_after:.2f} s" if self.left_after is not None else ""
        worst = self.certificate.worst if self.certificate is not None else None
        share = f"{100 * worst.share:.1f} % of the limit on {worst.name}" if worst is not None else "a hover"
        return [
            ("plans, certified again", f"{self.plans}, using {share} at most"),
            ("stops asked for, certified again", str(self.stops)),
            ("joints between plans", self._joints()),
            ("setpoints committed to", f"{self.committed}, each with a certified stop"),
            ("setpoints streamed", f"{self.streamed}, each as committed{left}"),
        ]

    def _joints(self) -> str:
        if not self.joints:
            return "none: one plan was flown"
        return f"{self.joints}, none jumps by more than {_SAME:g} (m, m/s, m/s², m/s³)"


def recertify(record: Record) -> Recertified:
    """Certify a record's commitments again, and compare them with what was streamed.

    Raises InputError if a plan's file is missing or damaged, NotCertifiedError if anything fails.
    """
    commitments = record.commitments
    plans = [_plan_of(record, int(checksum)) for checksum in commitments.checksum[1:]]
    timeline, first = _beginning(record, plans)
    found = [plan.certificate for plan in (first, *plans) if plan is not None]
    for number, certificate in enumerate(found, 1):
        if not certificate.passed:
            worst = certificate.worst
            raise NotCertifiedError(
                f"it uses {100 * worst.share:.1f} % of the limit on {worst.name}",
                where=f"plan {number}",
                hint="the record was changed since, or made by another version",
            )
    limits = next(plan.limits for plan in (first, *plans) if plan is not None)
    jump, stops, setpoints = 0.0, 0, len(timeline.commitment.payloads)
    for number, plan in enumerate(plans, 1):
        splice = int(commitments.splice[number])
        if plan is not None:
            jump = max(jump, _jump(timeline.for_plans_from(splice, limits), joint_of(splice), plan))
            limits = plan.limits
        committed, checksum = commitments.payloads[number], int(commitments.checksum[number])
        made = _committed(timeline, splice, plan, limits, committed, checksum=checksum, number=number)
        begins = int(commitments.splice[number:].min())  # no other plan leaves before that setpoint
        timeline = made.accepted(spliced(timeline.commitment, made.proposal, begins))
        stops += timeline.stopping
        setpoints += len(commitments.payloads[number]) // PAYLOAD_SIZE
    sequence = committed_setpoints(record) if len(commitments.time) else timeline.commitment.payloads
    streamed, left_after = _compare(record, sequence)
    certificates = sorted(found, key=lambda certificate: certificate.worst.share)
    worst_of_all = certificates[-1] if certificates else None
    count = sum(plan is not None for plan in plans)
    return Recertified(len(found), stops, worst_of_all, count, jump, setpoints, streamed, left_after)


def _plan_of(record: Record, checksum: int) -> Plan | None:
    """Return the plan of a proposal; None if the record has none, as for a stop."""
    file = record.folder / PLAN_IN_FLIGHT.format(checksum)
    return load_plan(file) if file.is_file() else None


def _beginning(record: Record, plans: list[Plan | None]) -> tuple[Timeline, Plan | None]:
    """Return the timeline before the first request, and its plan; None for a hover."""
    if (record.folder / PLAN_FILE).is_file():
        first = load_plan(record.folder / PLAN_FILE)
        ends = first.path(np.array([0.0, first.path.end]))
        return hold(first, ends), first
    first_made = next((plan for plan in plans if plan is not None), None)
    if first_made is None or not len(record.header.path):
        raise InputError(
            "no plan was committed, so there is nothing to certify",
            where=str(record.folder),
            hint="name the record of a flight that `cfplan fly` or a program flew along a path",
        )
    x, y, z = record.header.path[0].tolist()
    yaw = float(record.header.provenance.get(YAW, "0"))
    return hold_hover((x, y, z), yaw, first_made.limits), None


def _jump(timeline: Timeline, joint: float, plan: Plan) -> float:
    """Return the largest jump, of position to jerk, at a joint, s. Raises NotCertifiedError if there is one."""
    before, after = timeline.motion.at(joint), plan.trajectory.at(0.0)
    jumps = [
        float(np.abs(getattr(after, name) - getattr(before, name)).max())
        for name in ("position", "velocity", "acceleration", "jerk")
    ]
    if max(jumps) > _SAME:
        raise NotCertifiedError(
            f"the motion jumps by {max(jumps):.2g} at {joint:.2f} s",
            where="a joint",
            hint="the record was changed since, or made by another version",
        )
    return max(jumps)


def _committed(
    timeline: Timeline, splice: int, plan: Plan | None, limits: Limits, payloads: bytes, *, checksum: int, number: int
) -> Replanned:
    """Certify a plan again, or another part of it, and return it.

    Raises NotCertifiedError if it differs.
    """
    where = f"plan {number}, from setpoint {splice} on"
    committed = np.frombuffer(payloads, np.uint8).reshape(-1, PAYLOAD_SIZE)
    timeline = timeline.for_plans_from(splice, limits)
    motion = timeline.motion
    if plan is not None:
        motion = motion.continued(joint_of(splice), plan.trajectory)
    onward = timeline.onward(splice, motion)
    if plan is None and (timeline.part_ends is None or not _goes_on(onward, committed, limits)):
        return _stopped(timeline, splice, committed, checksum, where, limits)
    try:
        if len(committed) == len(onward.encoded(limits).payloads):
            made = certify_whole(onward, limits)
        else:
            made = certify_beginning(onward, len(committed) - STOP_AND_HOVER, limits, foresee=False)
    except CfplanError as error:
        raise NotCertifiedError(f"{error.where}: {error.what}", where=where, hint=error.hint) from error
    if committed.shape != made.payloads.shape or (committed != made.payloads).any():
        raise NotCertifiedError("the setpoints are not those of the plan", where=where, hint="was the record changed?")
    proposal = propose(timeline.commitment, splice, made.payloads, made.stops, made.ending)
    if proposal.checksum != checksum:
        raise NotCertifiedError("the stops are not those that were verified", where=where, hint="was it changed?")
    later = replace(timeline, motion=motion).with_certified(splice, made)
    return Replanned(proposal, later, plan, joint_of(splice))


def _goes_on(onward: Onward, committed: NDArray, limits: Limits) -> bool:
    """Return whether setpoints continue the present plan, and are not a stop."""
    payloads = onward.encoded(limits).payloads
    following = len(committed) - STOP_AND_HOVER
    if following < 2:  # a stop is as long, and begins like the plan; a remainder is complete
        return np.array_equal(committed, payloads)
    return np.array_equal(committed[:following], payloads[:following])


def _stopped(
    timeline: Timeline, splice: int, committed: NDArray, checksum: int, where: str, limits: Limits
) -> Replanned:
    """Return a requested stop, certified again. Raises InputError if there is none."""
    for duration in STOPS:
        with suppress(CfplanError):
            made = stop_within(timeline, splice, duration, limits)
            if made.proposal.checksum == checksum and np.array_equal(made.proposal.payloads, committed):
                return made
    raise InputError(
        "there is no such file with its plan, and it is not a certified stop",
        where=where,
        hint="copy the whole folder of the record; else it was changed since",
    )


def _compare(record: Record, sequence: NDArray) -> tuple[int, float | None]:
    """Return how many setpoints were streamed, each as committed, and when the plan was left, s.

    Raises NotCertifiedError if one differs.
    """
    phases, sent, events = record.phases, record.setpoints, record.events
    began = phases.time[phases.phase == Phase.STREAM]
    if not len(began):
        return 0, None
    over = phases.time[(phases.time > began[0]) & ~np.isin(phases.phase, (Phase.STREAM, Phase.HOLD))]
    aborts = [time for time, text in zip(events.time, events.text, strict=True) if text.startswith(_RUNGS)]
    left = min((time for time in aborts if time >= began[0]), default=np.inf)
    end = min(left, float(over[0]) if len(over) else np.inf)
    rows = np.flatnonzero((sent.time >= began[0]) & (sent.time < end))
    planned = decode(sequence)
    numbers = np.minimum(sent.index[rows], len(sequence) - 1)
    for name in ("position", "velocity", "acceleration", "quaternion", "body_rate"):
        off = np.abs(getattr(sent, name)[rows] - getattr(planned, name)[numbers]).max(axis=1, initial=0.0)
        if (off > 0.0).any():
            at = rows[int(np.argmax(off))]
            raise NotCertifiedError(
                f"its {name.replace('_', ' ')} is off by {off.max():.4f} from what was committed",
                where=f"setpoint {sent.index[at]} as streamed",
                hint="the pilot sent something else, or the record was changed since",
            )
    return len(rows), float(left - began[0]) if np.isfinite(left) and left <= end else None
