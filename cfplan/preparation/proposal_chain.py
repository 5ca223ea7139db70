"""The proposals of a planner on their way to the pilot, and what it is bound to once it has accepted them.

A proposal may count as accepted before it is: then another is planned on it meanwhile. One at most is looked at by the
pilot; one at most behind it is held back, until what is simulated of it has passed and the pilot has answered. Where
one does not pass, what was held before it is held again, and what was planned on it is dropped.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait

from cfplan.errors import CfplanError
from cfplan.flight.clock import Clock
from cfplan.flight.pilot.proposals import PilotAnswer, read_answer
from cfplan.flight.setpoints.commitment import LEAST_AHEAD, Fault, spliced
from cfplan.flight.setpoints.encoding import RATE
from cfplan.preparation.air_planner import AnswerTimes, PathAnswer, PathRequest, PathVerdict, answer_accepted
from cfplan.preparation.beside import Pending
from cfplan.preparation.certified_flight import UnfoundedError
from cfplan.preparation.lead import Lead
from cfplan.preparation.replan import HeldFlight, Replanned, accepted
from cfplan.preparation.request_queue import RequestQueue

NO_ANSWER = "the pilot does not answer; where it still accepts what was proposed last, that is flown"
PILOT_ANSWER_TIMEOUT = 1.0  # s in which a pilot answers; what comes later counts as well
_LOOK_SOON = 0.0005  # s, until it is seen whether what is waited for is simulated


@dataclass(frozen=True, slots=True, eq=False)
class Proposed:
    """A proposal that is with the pilot, or held back."""

    made: Replanned
    request: PathRequest | None = None  # None where nobody asked for it: the next part of the plan that is flown
    received: float = math.nan  # s, when that came
    begun: float = math.nan  # s, when it was begun to be planned
    sent: float = math.nan  # s
    lead: Lead | None = None  # which learns how long it took
    before: HeldFlight | None = None  # what is held where it does not pass; None where its answer is waited for

    def answer(self, answer: PilotAnswer, now: float) -> PathAnswer:
        """Return the answer to the request, by the pilot's answer to the proposal, which came at `now`, s."""
        request, made = self.request, self.made
        assert request is not None
        if answer.commitment is None:
            late = answer.reason.startswith(Fault.LATE)
            return PathAnswer(request.number, PathVerdict.LATE if late else PathVerdict.REFUSED, answer.reason)
        seconds = 0.0 if made.plan is None else made.plan.seconds
        times = AnswerTimes(self.received, self.begun, seconds, self.sent, now)
        stop = 0 if made.stop is None else made.stop.proposal.checksum
        return replace(answer_accepted(request.number, made, stop), times=times)

    @property
    def simulated(self) -> Pending:
        """Return what raises where a proposal that is held back does not pass."""
        assert self.made.held.simulated.coming is not None
        return self.made.held.simulated.coming


class ProposalChain:
    """What is held, and the proposals that lead to it."""

    def __init__(
        self,
        held: HeldFlight,
        requests: RequestQueue,
        pilot: Connection,
        on_accepted: Callable[[Proposed], None],
        clock: Clock,
    ):
        """Hold a flight; `on_accepted` hears of each proposal that the pilot accepts."""
        self.held, self.begun = held, math.nan  # s, when setpoint 0 was due, once that is known
        self.proposed: Proposed | None = None  # which the pilot has not answered yet
        self.fell_back = False  # whether one fell that another was planned on; until somebody sets it again
        self.settled_at = -math.inf  # s, when the pilot last answered one that nobody waited for
        self._held_back: Proposed | None = None
        self._requests, self._pilot, self._on_accepted = requests, pilot, on_accepted
        self._clock = clock

    @property
    def settled(self) -> bool:
        """Return whether all proposals have been sent and answered."""
        return self.proposed is None and self._held_back is None

    @property
    def stuck(self) -> bool:
        """Return whether a proposal has no answer that somebody has waited for: nobody knows what the pilot flies."""
        return self.proposed is not None and self.proposed.before is None

    def read(self, patience: float = 0.0, *, or_request: bool = False) -> PilotAnswer | None:
        """Take what has come; return the pilot's answer to a proposal if there is one, waiting for it if asked to.

        With `or_request`, wait for that or a request. What the pilot accepts is held from then on, however late that is
        heard of.
        """
        found = None
        until = self._clock.now() + patience
        while ready := wait([self._requests.connection, self._pilot], max(until - self._clock.now(), 0.0)):
            if self._pilot in ready:
                answer = read_answer(self._pilot.recv_bytes())
                if answer.begun is not None:
                    self.begun = answer.begun
                elif self.proposed is not None and answer.proposal == self.proposed.made.proposal.checksum:
                    self._take_answer(self.proposed, answer)
                    found = answer
                    until = 0.0
            if self._requests.connection in ready:
                self._requests.receive()
                until = 0.0 if or_request else until
        return found

    def propose(self, proposed: Proposed) -> PilotAnswer | None:
        """Send a proposal and wait for the pilot's answer; None where that does not come soon."""
        self._send(proposed)
        return self.wait_for_answer()

    def wait_for_answer(self, *, or_request: bool = False) -> PilotAnswer | None:
        """Wait for the pilot's answer to a proposal, or for a request; None where the answer does not come soon."""
        return self.read(PILOT_ANSWER_TIMEOUT, or_request=or_request)

    def propose_meanwhile(self, proposed: Proposed) -> None:
        """Send a proposal, which counts as accepted from now on."""
        self._send(self._foreseen(proposed))

    def hold_back(self, proposed: Proposed) -> None:
        """Send a proposal once it may be, which counts as accepted from now on."""
        self._held_back = self._foreseen(proposed)

    def settle(self, *, or_request: bool = False) -> None:
        """Wait for what is on its way; with `or_request`, no longer than until a request comes."""
        while not self.settled and not self.stuck and not (or_request and self._requests.waiting):
            if self.proposed is not None:
                self._wait_for_foreseen(or_request=or_request)
            elif or_request and self._held_back is not None and not self._held_back.simulated.done():
                self.read(_LOOK_SOON, or_request=True)
            else:
                self.release()

    def release(self) -> None:
        """Send what is held back, if there is something, once it is simulated and the pilot has answered."""
        if self._held_back is None:
            return
        fault = self._held_back.simulated.exception()
        if self.proposed is not None:
            self._wait_for_foreseen()
        if self._held_back is None:  # it fell with what it was planned on
            return
        released, self._held_back = replace(self._held_back, sent=self._clock.now()), None
        if fault is not None:
            self._fall_back(released, PathVerdict.SUPERSEDED, told_of(fault))
            return
        assert released.made.plan is not None
        assert released.lead is not None
        released.lead.note_checks(released.sent - released.begun - released.made.plan.seconds)
        self._send(released)

    def release_if_ready(self) -> None:
        """Send what is held back if nothing need be waited for. Raises UnfoundedError where that is held no more."""
        held = self.held
        if self._held_back is not None:
            self.read()
        if self._held_back is not None and self.proposed is None and self._held_back.simulated.done():
            self.release()
        if self.held is not held:
            raise UnfoundedError

    def _send(self, proposed: Proposed) -> None:
        self._pilot.send_bytes(proposed.made.proposal.to_bytes())
        self.proposed = proposed

    def _foreseen(self, proposed: Proposed) -> Proposed:
        """Take what is to be proposed to be held from now on; return it so."""
        before, self.held = self.held, self._committed_to(proposed.made)
        return replace(proposed, before=before)

    def _wait_for_foreseen(self, *, or_request: bool = False) -> None:
        """Wait for the pilot's answer to what counts as accepted."""
        proposed = self.proposed
        assert proposed is not None
        answer = self.wait_for_answer(or_request=or_request)
        if answer is None and not (or_request and self._requests.waiting):
            self.proposed = replace(proposed, before=None)
            self._fall_back(proposed, PathVerdict.REFUSED, NO_ANSWER)

    def _take_answer(self, proposed: Proposed, answer: PilotAnswer) -> None:
        """Take the pilot's answer to a proposal."""
        self.proposed = None
        if proposed.before is not None:  # nobody waits for it
            self.settled_at = self._clock.now()
            assert proposed.lead is not None
            proposed.lead.note(max(answer.came, proposed.sent) - proposed.begun, proposed.made.equal / RATE)
            told = proposed.answer(answer, self.settled_at)
            if answer.commitment is None:
                self._fall_back(proposed, told.verdict, told.reason)
            else:
                self._requests.tell(replace(told, seconds=self._clock.now() - proposed.received))
        elif answer.commitment is not None:
            self.held = self._committed_to(proposed.made)
        held = self.held if self._held_back is None else self._held_back.before
        assert held is not None
        assert answer.commitment in (None, held.commitment.checksum)
        if answer.commitment is not None:
            self._on_accepted(proposed)

    def _fall_back(self, fallen: Proposed, verdict: PathVerdict, reason: str) -> None:
        """Hold what was held before a proposal that does not pass, and drop what was planned on it.

        The latest request is planned again, so that all that it needs is waited for; of others it is told.
        """
        assert fallen.before is not None
        self.held, self.fell_back = fallen.before, True
        dropped, self._held_back = self._held_back, None
        for each, told, why in ((fallen, verdict, reason), (dropped, PathVerdict.SUPERSEDED, "")):
            if each is None or each.request is None or self._requests.wait_again(each.request, each.received):
                continue
            self._requests.tell(PathAnswer(each.request.number, told, why, seconds=self._clock.now() - each.received))

    def _committed_to(self, made: Replanned) -> HeldFlight:
        """Return what is held once the pilot has accepted a proposal."""
        due = math.floor((self._clock.now() - self.begun) * RATE)  # the pilot looked a little earlier
        now = min(due, made.proposal.splice - LEAST_AHEAD)
        return accepted(made, spliced(self.held.commitment, made.proposal, now))


def told_of(error: BaseException) -> str:
    """Return what is told of an error."""
    return str(error) if isinstance(error, CfplanError) else f"fault in the planner: {error!r}"
