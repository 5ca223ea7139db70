"""A planner on a stepped clock, in the pilot's own thread: it plans in no time, and proposes as late as it is told to.

Its requests, plans and answers are those of the planner's process; only processes, pipes and the computer's own time
are left out. It can be made to fail as a process can.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from cfplan.errors import CfplanError
from cfplan.flight.clock import Clock
from cfplan.flight.setpoints.commitment import LEAST_AHEAD, Commitment, Fault, Proposal, Refusal, checksum_of
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.telemetry import Triple
from cfplan.preparation.air_planner import (
    NEXT_PART,
    SLACK,
    PathAnswer,
    PathRequest,
    PathVerdict,
    Wish,
    answer_accepted,
    answer_changed,
    answer_cut_short,
    answer_held,
    answer_refused,
    part_within,
    plan_behind_stop,
    plan_next_part,
    plan_request,
    presses,
    wants_more,
)
from cfplan.preparation.replan import HeldFlight, Replanned, accepted, after_failure, following
from cfplan.safety.limits import Limits

PLANNING = 0.1  # s that planning takes
STOPPED = 1.0  # s for which a planner that is stopped stands still


class PlannerFault(Enum):
    """What can be wrong with a planner."""

    KILLED = "killed"  # it plans and answers nothing any more
    STOPPED = "stopped"  # each proposal comes STOPPED s later than it should
    LATE = "late"  # each proposal comes a setpoint later than it may
    GARBAGE = "garbage"  # proposals hold other bytes than were certified
    OTHER_JOINT = "other joint"  # proposals begin three setpoints away from where they were made for


@dataclass(slots=True)
class _InHand:
    """A proposal on its way to the pilot, or at it."""

    request: PathRequest | None  # None where it is the next part of the plan that is flown
    asked: float  # s
    made: Replanned
    proposal: Proposal  # as it is sent
    due: float  # s, when it arrives
    behind: Replanned | None = None  # to be proposed next, where this is the stop before it
    stop: int = 0  # checksum of the stop before it


class SteppedPlanner:
    """Makes proposals of requests for a pilot on the same clock; a ProposalSource."""

    def __init__(
        self,
        held: HeldFlight,
        limits: Limits,
        clock: Clock,
        on_answer: Callable[[PathAnswer], None],
        *,
        planning: float = PLANNING,
    ):
        """Hold what the pilot's mission was made from; `planning`, s, is what a plan takes."""
        self.held, self._limits, self._clock, self._on_answer = held, limits, clock, on_answer
        self._planning = planning
        self.fault: PlannerFault | None = None
        self.on_committed: Callable[[Replanned], None] = lambda _: None  # hears what the pilot is committed to
        self._number = 0
        self._begun = math.nan
        self._waiting: tuple[PathRequest, float] | None = None
        self._asked = -math.inf  # s, when the last request came
        self._in_hand: _InHand | None = None
        self._accepted = 0  # number of the request whose plan is flown

    def request(self, wish: Wish, waypoints: Sequence[Triple] = ()) -> int:
        """Ask for a change; return the number of its answer. The latest request wins."""
        self._number += 1
        if self._waiting is not None:
            self._on_answer(PathAnswer(self._waiting[0].number, PathVerdict.SUPERSEDED))
        self._asked = self._clock.now()
        self._waiting = PathRequest(self._number, wish, tuple(waypoints)), self._asked
        return self._number

    @property
    def pending(self) -> frozenset[int]:
        """Return the numbers of the requests without an answer so far: of one at the pilot, and of one that waits."""
        at_pilot = None if self._in_hand is None else self._in_hand.request
        waiting = None if self._waiting is None else self._waiting[0]
        return frozenset(each.number for each in (at_pilot, waiting) if each is not None)

    # What the pilot calls.

    def begin(self, start: float) -> None:
        self._begun = start

    def wait(self, patience: float) -> bool:
        return False  # it plans in the pilot's ticks

    def newest(self) -> Proposal | None:
        now = self._clock.now()
        if self._in_hand is None and self.fault is not PlannerFault.KILLED:
            first, ahead = self._next(now)
            more = wants_more(self.held, first, now - self._asked)
            if more and (self._waiting is None or presses(self.held, first, ahead)):
                self._go_on(now, first, part_within(ahead, NEXT_PART))
            elif self._waiting is not None:
                (request, asked), self._waiting = self._waiting, None
                self._plan(request, asked, now)
        if self._in_hand is None or now < self._in_hand.due:
            return None
        self._in_hand.due = math.inf  # given once
        return self._in_hand.proposal

    def answer(self, proposal: Proposal, answer: Commitment | Refusal) -> None:
        if self._in_hand is None:
            return
        done, self._in_hand = self._in_hand, None
        if isinstance(answer, Commitment):
            self.held = accepted(done.made, answer)
            self.on_committed(replace(done.made, held=self.held))
            if done.behind is not None:
                made = following(done.behind, answer)
                self._send(replace(done, made=made, proposal=self._spoilt(made.proposal), due=self._clock.now(),
                                   behind=None, stop=proposal.checksum))  # fmt: skip
            elif done.request is not None:
                self._accepted = done.request.number
                self._tell(answer_accepted(self._accepted, done.made, done.stop), done.asked)
            elif done.made.plan is not None:
                self._on_answer(answer_changed(self._accepted, done.made))
        elif done.request is not None:
            self._tell(answer_refused(done.request, answer), done.asked)
        elif answer.fault is not Fault.LATE:
            self._interrupt(str(answer))

    def _next(self, now: float) -> tuple[int, float]:
        """Return the setpoint from which on one may plan now, and how far ahead that is, s."""
        ahead = self._planning + SLACK
        return math.ceil((now - self._begun + ahead) * RATE) + LEAST_AHEAD, ahead

    def _plan(self, request: PathRequest, asked: float, now: float) -> None:
        first, ahead = self._next(now)
        try:
            made = self._planned(request, first, part_within(ahead))
        except CfplanError as error:
            self._tell(PathAnswer(request.number, PathVerdict.REFUSED, str(error)), asked)
            return
        if isinstance(made, HeldFlight):
            self.held = made
            self._tell(answer_held(request, made), asked)
            return
        sent = made if made.stop is None else made.stop
        behind = None if made.stop is None else made
        self._send(_InHand(request, asked, sent, self._spoilt(sent.proposal), now + self._planning, behind))

    def _planned(self, request: PathRequest, first: int, part: int) -> Replanned | HeldFlight:
        """Return what is to be proposed, from rest where no plan leads there from the motion."""
        try:
            return plan_request(self.held, request, first, self._limits, part)
        except CfplanError as error:
            return plan_behind_stop(self.held, request, first, self._limits, part, error)

    def _go_on(self, now: float, first: int, part: int) -> None:
        """Make the proposal of the next part of the plan that is flown."""
        try:
            made = plan_next_part(self.held, first, self._limits, part)
        except CfplanError as error:
            self._interrupt(str(error))
            return
        if isinstance(made, HeldFlight):
            self.held = made
            return
        self._send(_InHand(None, now, made, self._spoilt(made.proposal), now + self._planning))

    def _interrupt(self, reason: str) -> None:
        """Let the vehicle rest behind what is committed, and go on from there unless that is what does not pass."""
        self.held = after_failure(self.held, self._limits)
        if not self.held.unfinished:
            self._on_answer(answer_cut_short(self._accepted, self.held, reason))

    def _send(self, proposal: _InHand) -> None:
        if self.fault is PlannerFault.STOPPED:
            proposal.due += STOPPED
        elif self.fault is PlannerFault.LATE:
            proposal.due = self._begun + (proposal.made.proposal.splice - LEAST_AHEAD + 1) / RATE
        self._in_hand = proposal

    def _spoilt(self, proposal: Proposal) -> Proposal:
        if self.fault is PlannerFault.GARBAGE:
            return replace(proposal, payloads=np.roll(proposal.payloads, 7))
        if self.fault is PlannerFault.OTHER_JOINT:
            moved = proposal.splice + 3
            checksum = checksum_of(moved, proposal.payloads, proposal.stops)
            return replace(proposal, splice=moved, checksum=checksum)
        return proposal

    def _tell(self, answer: PathAnswer, asked: float) -> None:
        self._on_answer(replace(answer, seconds=self._clock.now() - asked))
