"""The core of planning in the air: a state, events, and the effects of each event, without clocks or processes.

At most one proposal is being made, and at most one is with the pilot. The latest request wins: a waiting request is
superseded when another arrives. A proposal that comes too late is made again from farther ahead. While the pilot does
not answer, requests are refused, because its commitment is not known.

    Asked, Answered, Made, Begun; or time passes  →  step()  →  the next state, and Make, Propose, Tell
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cfplan.air.replanning import answer_request, next_part
from cfplan.air.requests import AnswerTimes, PathAnswer, PathRequest, PathVerdict, Wish
from cfplan.air.timeline import Replanned, Timeline
from cfplan.errors import CfplanError
from cfplan.flight.pilot.proposals import LOOKS_UNTIL, NEXT_PART_TIMEOUT
from cfplan.flight.setpoints.commitment import LEAST_AHEAD, Fault, Proposal, spliced
from cfplan.flight.setpoints.encoding import RATE
from cfplan.safety.limits import Limits

NOT_FLOWN = "the plan is not flown yet"
NO_NEXT_PART = f"the next part of the plan was not ready after {NEXT_PART_TIMEOUT:g} s of rest"
NO_ANSWER = "the pilot does not answer; where it still accepts what was proposed last, that is flown"
ON_ITS_WAY = "the vehicle is there, or on its way there already"
PILOT_ANSWER_TIMEOUT = 1.0  # s to wait for the pilot's answer; a later answer still counts
FIRST_PART, NEXT_PART = 0.3, 0.8  # s, least duration of the first part of a plan, and of each later part
PART = 4.0  # s of part per s of planning look-ahead, if that is longer
NEAR = 0.5  # s before the next part must be planned, at which planning it begins
QUIET = 1.0  # s without a request, after which parts are planned far ahead: no request is likely to replace them
FARTHEST = 30.0  # s, how far ahead parts are then committed at most
TRANSFER_TIME = 0.001  # s, least time in which a proposal reaches the pilot
RECENT_JOBS, LATENCY_QUANTILE = 15, 0.8  # recent jobs of a kind; the quantile of their durations that predicts the next
TRIES, RETRY_BACKOFF = 3, 2.0  # attempts per request if proposals come late; factor on the look-ahead of the next


# Events.


@dataclass(frozen=True, slots=True)
class Begun:
    """The pilot has begun to stream; setpoint 0 is due at `start`, s."""

    start: float


@dataclass(frozen=True, slots=True)
class Asked:
    """A request has arrived."""

    request: PathRequest


@dataclass(frozen=True, slots=True)
class Answered:
    """The pilot has answered a proposal."""

    proposal: int  # checksum
    commitment: int | None  # checksum of the commitment with it; None if it was refused
    came: float  # s, when the pilot received the proposal; 0 if unknown
    reason: str = ""  # why it was refused


@dataclass(frozen=True, slots=True)
class Job:
    """A planning job from a setpoint on: a request, or without one the next part of the plan."""

    request: PathRequest | None
    received: float  # s, when the request arrived
    begun: float  # s
    ahead: float  # s after `begun` by which its proposal is expected to reach the pilot
    splice: int  # setpoint
    part: int  # setpoints to commit at once
    tries: int = 1  # attempts, this one included; the proposals of the others came too late

    @property
    def kind(self) -> str:
        """Return the kind of job, by which durations are recorded."""
        return "part" if self.request is None else "stop" if self.request.wish is Wish.STOP else "plan"

    def outcome(self, timeline: Timeline, limits: Limits) -> "Made":
        """Do the job. Raises nothing: a fault must not leave the rest of the flight without a planner."""
        try:
            if self.request is None:
                return Made(self, next_part(timeline, self.splice, limits, self.part))
            return Made(self, answer_request(timeline, self.request, self.splice, limits, self.part))
        except CfplanError as error:
            return Made(self, str(error))
        except Exception as error:
            return Made(self, f"fault in the planner: {error!r}")


@dataclass(frozen=True, slots=True, eq=False)
class Made:
    """A job is done."""

    job: Job
    result: Replanned | Timeline | str  # the timeline if nothing need be proposed; why planning failed


Event = Begun | Asked | Answered | Made


# Effects.


@dataclass(frozen=True, slots=True)
class Make:
    """Do this job on the present timeline."""

    job: Job


@dataclass(frozen=True, slots=True, eq=False)
class Propose:
    """Send the pilot a proposal."""

    proposal: Proposal


@dataclass(frozen=True, slots=True, eq=False)
class Tell:
    """Answer a request."""

    answer: PathAnswer


Effect = Make | Propose | Tell


@dataclass(frozen=True, slots=True, eq=False)
class Sent:
    """A proposal that is with the pilot."""

    job: Job
    made: Replanned
    sent: float  # s
    behind: Replanned | None = None  # to be proposed next, if this is the stop before it
    stop: int = 0  # checksum of the stop before it
    unanswered: bool = False  # for longer than PILOT_ANSWER_TIMEOUT


@dataclass(frozen=True, slots=True, eq=False)
class CoreState:
    """The planner's state."""

    timeline: Timeline
    took: dict[str, tuple[float, ...]]  # s that recent jobs of each kind took until the pilot had their proposals
    begun: float = math.nan  # s, when setpoint 0 is due
    waiting: tuple[PathRequest, float] | None = None  # the latest request, and when it arrived, s
    asked: float = -math.inf  # s, when the last request arrived
    job: Job | None = None  # the job under way
    sent: Sent | None = None
    accepted: int = 0  # number of the request whose plan is being flown

    def ahead(self, kind: str) -> float:
        """Return how far ahead to plan, s, so that most jobs of a kind are in time."""
        return float(np.quantile(self.took[kind], LATENCY_QUANTILE)) + TRANSFER_TIME

    def first(self, now: float, ahead: float) -> int:
        """Return the earliest splice of a plan that is proposed `ahead`, s, from now."""
        return math.ceil((now - self.begun + ahead + LOOKS_UNTIL) * RATE) - 1 + LEAST_AHEAD

    def learned(self, kind: str, took: float) -> "CoreState":
        """Return the state with one more recorded job duration, s."""
        return replace(self, took=self.took | {kind: (*self.took[kind], took)[-RECENT_JOBS:]})

    @property
    def wakes(self) -> float | None:
        """Return when step() must be called again even without events, s from now; None: never."""
        if self.sent is not None:
            return PILOT_ANSWER_TIMEOUT
        return 1.0 / RATE if self.timeline.unfinished else None


def first_state(timeline: Timeline, plan: float, stop: float) -> CoreState:
    """Return the state before the flight; `plan` and `stop`, s, are durations to assume for the first jobs."""
    return CoreState(timeline, {"plan": (plan,), "stop": (stop,), "part": (stop,)})


def step(state: CoreState, events: Sequence[Event], now: float, limits: Limits) -> tuple[CoreState, list[Effect]]:
    """Return the state after the events, in order, and their effects; without events only time has passed, to `now`."""
    effects: list[Effect] = []
    for event in events:
        state, more = _after(state, event, now, limits)
        effects += more
    if _rests_too_long(state, now):
        state, more = _cut_short(state, NO_NEXT_PART, limits, going_on=False)
        effects += more
    state, more = _next(state, now)
    return state, effects + more


def _after(state: CoreState, event: Event, now: float, limits: Limits) -> tuple[CoreState, list[Effect]]:
    """Return the state after an event, and its effects."""
    match event:
        case Begun(start):
            return replace(state, begun=start), []
        case Asked(request):
            superseded = [] if state.waiting is None else [state.waiting[0].number]
            state = replace(state, waiting=(request, now), asked=now)
            return state, [Tell(PathAnswer(number, PathVerdict.SUPERSEDED)) for number in superseded]
        case Made(job, result):
            return _made(replace(state, job=None), job, result, now, limits)
        case Answered() if state.sent is not None and event.proposal == state.sent.made.proposal.checksum:
            return _answered(replace(state, sent=None), state.sent, event, now, limits)
    return state, []


def _next(state: CoreState, now: float) -> tuple[CoreState, list[Effect]]:
    """Begin the next job unless one is under way or a proposal is with the pilot."""
    if state.job is not None:
        return state, []
    if state.sent is not None and not state.sent.unanswered and now < state.sent.sent + PILOT_ANSWER_TIMEOUT:
        return state, []
    if state.sent is not None:
        numbers = [] if state.sent.unanswered or state.sent.job.request is None else [state.sent.job.request.number]
        numbers += [] if state.waiting is None else [state.waiting[0].number]
        state = replace(state, sent=replace(state.sent, unanswered=True), waiting=None)
        return state, [Tell(PathAnswer(number, PathVerdict.REFUSED, NO_ANSWER)) for number in numbers]
    if state.waiting is not None and math.isnan(state.begun):
        number = state.waiting[0].number
        return replace(state, waiting=None), [Tell(PathAnswer(number, PathVerdict.REFUSED, NOT_FLOWN))]
    if _wants_more(state, now) and (state.waiting is None or _next_part_is_urgent(state, now)):
        return _begin(state, None, now, now, state.ahead("part"))
    if state.waiting is not None:
        request, received = state.waiting
        kind = "stop" if request.wish is Wish.STOP else "plan"
        return _begin(replace(state, waiting=None), request, received, now, state.ahead(kind))
    return state, []


def _begin(
    state: CoreState, request: PathRequest | None, received: float, now: float, ahead: float, tries: int = 1
) -> tuple[CoreState, list[Effect]]:
    """Begin a job that looks `ahead`, s; its part is long enough for the next one to be made meanwhile."""
    part = round(max(NEXT_PART if request is None else FIRST_PART, PART * ahead) * RATE)
    splice = max(state.first(now, ahead), state.timeline.begin)
    job = Job(request, received, now, ahead, splice, part, tries)
    return replace(state, job=job), [Make(job)]


def _wants_more(state: CoreState, now: float) -> bool:
    """Return whether the next part of a plan should be planned now."""
    timeline, within = state.timeline, NEAR if now - state.asked < QUIET else FARTHEST
    if math.isnan(state.begun) or not timeline.unfinished:
        return False
    return timeline.part_ends is None or timeline.part_ends < state.first(now, state.ahead("part") + within)


def _rests_too_long(state: CoreState, now: float) -> bool:
    """Return whether the vehicle rests before the end of its plan for so long that a finishing pilot lands it."""
    timeline = state.timeline
    return timeline.unfinished and now >= state.begun + timeline.commitment.last / RATE + NEXT_PART_TIMEOUT


def _next_part_is_urgent(state: CoreState, now: float) -> bool:
    """Return whether the next part must be planned before a waiting request, so as to be in time."""
    ends = state.timeline.part_ends
    return ends is not None and ends < state.first(now, state.ahead("plan") + 2.0 * state.ahead("part"))


def _made(
    state: CoreState, job: Job, result: Replanned | Timeline | str, now: float, limits: Limits
) -> tuple[CoreState, list[Effect]]:
    """Handle the result of a job: propose it, or answer why there is nothing to propose."""
    match result:
        case str():
            if job.request is None:
                return _cut_short(state, result, limits, going_on=state.timeline.part_ends is not None)
            return state, [
                Tell(PathAnswer(job.request.number, PathVerdict.REFUSED, result, seconds=now - job.received))
            ]
        case Timeline():
            state = replace(state, timeline=result)
            if job.request is None:
                return state, []
            reason = ON_ITS_WAY if job.request.waypoints else ""
            answer = PathAnswer(job.request.number, PathVerdict.ACCEPTED, reason, ends=result.ends)
            return state, [Tell(replace(answer, seconds=now - job.received))]
    sent = Sent(job, result, now) if result.stop is None else Sent(job, result.stop, now, behind=result)
    if state.first(now, TRANSFER_TIME) > sent.made.proposal.splice:
        return _late(state, job, Fault.LATE.value, now)
    return replace(state, sent=sent), [Propose(sent.made.proposal)]


def _answered(
    state: CoreState, sent: Sent, answer: Answered, now: float, limits: Limits
) -> tuple[CoreState, list[Effect]]:
    """Handle the pilot's answer to a proposal."""
    job, made = sent.job, sent.made
    state = state.learned(job.kind, max(answer.came, sent.sent) - job.begun)
    if answer.commitment is None:
        if sent.unanswered and job.request is not None:
            return state, []  # refusal already reported
        if answer.reason.startswith(Fault.LATE):
            return _late(state, job, answer.reason, now)
        if job.request is None:
            return _cut_short(state, answer.reason, limits, going_on=state.timeline.part_ends is not None)
        refused = PathAnswer(job.request.number, PathVerdict.REFUSED, answer.reason, seconds=now - job.received)
        return state, [Tell(refused)]
    due = math.floor((now - state.begun) * RATE)  # the pilot looked a little earlier
    committed = spliced(state.timeline.commitment, made.proposal, min(due, made.proposal.splice - LEAST_AHEAD))
    if committed.checksum != answer.commitment:  # the pilot got other bytes than were sent: its commitment is unknown
        return replace(state, sent=sent), []
    state = replace(state, timeline=made.accepted(committed))
    if sent.behind is not None:
        onward = sent.behind.behind(committed)
        state = replace(state, sent=Sent(job, onward, now, stop=made.proposal.checksum))
        return state, [Propose(onward.proposal)]
    if job.request is None:
        changed = made.plan is not None
        return state, [Tell(_accepted(state.accepted, sent, PathVerdict.CHANGED))] if changed else []
    times = AnswerTimes(job.received, job.begun, made.plan.seconds if made.plan else 0.0, sent.sent, now)
    accepted = replace(_accepted(job.request.number, sent), times=times, seconds=now - job.received)
    return replace(state, accepted=job.request.number), [Tell(accepted)]


def _late(state: CoreState, job: Job, reason: str, now: float) -> tuple[CoreState, list[Effect]]:
    """Handle a late proposal: replan a request from farther ahead; the next part of a plan is due again anyway."""
    state = state.learned(job.kind, now - job.begun)
    if job.request is None:
        return state, []
    if job.tries == TRIES:
        return state, [Tell(PathAnswer(job.request.number, PathVerdict.LATE, reason, seconds=now - job.received))]
    ahead = RETRY_BACKOFF * max(now - job.begun, job.ahead)
    return _begin(state, job.request, job.received, now, ahead, job.tries + 1)


def _cut_short(state: CoreState, reason: str, limits: Limits, *, going_on: bool) -> tuple[CoreState, list[Effect]]:
    """End the motion at rest behind the committed part, because the next part failed.

    With `going_on` the vehicle goes on from there, unless it was the plan from there that failed.
    """
    timeline = state.timeline.cut_short(limits, going_on=going_on)
    state = replace(state, timeline=timeline)
    if timeline.unfinished:
        return state, []
    return state, [Tell(PathAnswer(state.accepted, PathVerdict.CUT_SHORT, reason, ends=timeline.ends))]


def _accepted(number: int, sent: Sent, verdict: PathVerdict = PathVerdict.ACCEPTED) -> PathAnswer:
    """Return the answer to a request whose proposal the pilot has accepted."""
    made = sent.made
    return PathAnswer(
        number, verdict, joint=made.joint, ends=made.timeline.ends, splice=made.proposal.splice,
        checksum=made.proposal.checksum, plan=made.plan, stop=sent.stop,
    )  # fmt: skip
