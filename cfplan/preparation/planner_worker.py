"""What the planner's process does: from what is asked for while the vehicle flies to certified proposals.

It plans from the earliest setpoint that it can make, by how long its last plans took. The latest request wins: one that
waits is dropped when another comes. While requests come faster than they can be planned, the next one is planned on a
proposal that is simulated or looked at by the pilot still. What a plan leads to far ahead is looked at once its
beginning is committed, and flown slower where it must be.
"""

import contextlib
import gc
import math
from collections import deque
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection, wait

import numpy as np

from cfplan.errors import CfplanError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.pilot.proposals import LOOKS_UNTIL, PilotAnswer
from cfplan.flight.setpoints.commitment import LEAST_AHEAD, Fault
from cfplan.flight.setpoints.encoding import RATE
from cfplan.planning.continuation import ON_PATH_LEFT, TooLateError, Ways
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
    part_within,
    plan_behind_stop,
    plan_next_part,
    plan_request,
    plan_slower,
    presses,
    wants_more,
)
from cfplan.preparation.beside import beside
from cfplan.preparation.certified_flight import UnfoundedError
from cfplan.preparation.lead import IN_TIME, LEARNED_FROM, Lead
from cfplan.preparation.proposal_chain import NO_ANSWER, ProposalChain, Proposed, told_of
from cfplan.preparation.replan import (
    AnswerAttempt,
    HeldFlight,
    Manner,
    Replanned,
    after_failure,
    following,
    go_on,
    halt,
    replan,
)
from cfplan.preparation.request_queue import RequestQueue
from cfplan.safety.limits import Limits

FIRST_TIME = 1.0  # s that a plan is taken to need before any was made
FIRST_STOP = 0.1  # s that a stop is taken to need before any was made
AGAIN = 1.15  # by how much longer each time a request is taken to need that came late, and has a known way
UNHURRIED = 3.0  # times what a plan needs, that one lies ahead which nobody waits for
TRIES = 4  # of a request whose proposal comes late
HASTE = 0.05  # s without a request, until which others are about to come where they came faster than plans
ON_THE_WAY = 0.001  # s that a proposal takes to the pilot, at least
_LOOK_AGAIN = 0.05  # s, until the planner sees whether more of a plan is to be made


class PlannerWorker:
    """The planner in its own process."""

    def __init__(
        self, held: HeldFlight, limits: Limits, requests: Connection, pilot: Connection, clock: Clock = REAL_CLOCK
    ):
        self._limits, self._clock = limits, clock
        self._requests = RequestQueue(requests, clock)
        self._chain = ProposalChain(held, self._requests, pilot, self._note_accepted, clock)
        self._inputs = [requests, pilot]
        self._plans, self._stops, self._parts = Lead(FIRST_TIME), Lead(FIRST_STOP), Lead(FIRST_STOP)
        self._meanwhile = Lead(FIRST_TIME)  # of plans that are simulated while the next one is planned
        self._planned_in: deque[float] = deque([0.0], maxlen=LEARNED_FROM)  # s of plans, once a way was known
        # Setpoints that proposals left out as equal, by whether plans first go on along the path left.
        self._equal = {along: deque([0], maxlen=LEARNED_FROM) for along in (False, True)}
        # When last asked whether something comes too late, s: what was to be done still, by how much later than where
        # it might it begins, as setpoints before are equal.
        self._to_do = self._left_out = 0.0
        self._pressed = False  # whether requests come faster than they can be planned
        self._made = -math.inf  # s, when the last plan was made, and its checks began
        self._done = -math.inf  # s, when the last one was planned
        self._busy = False  # whether something was done since garbage was looked for
        self._accepted = 0  # number of the request whose plan is flown
        self._unforeseen = 0  # how often it may be tried still to look far ahead on that

    @property
    def _middle(self) -> list[tuple[float, ...]]:
        """Return two separate places in the middle of the space, m, without those too near to obstacles."""
        space = self._limits.space
        shares = (0.4, 0.6)
        places = [
            tuple(low + share * (high - low) for low, high in zip(space.low, space.high, strict=True))
            for share in shares
        ]
        return [place for place in places if space.holds(place)]

    def warm_up(self) -> None:
        """Make two plans and stops for nobody: what a first call compiles or loads is there before the flight."""
        held = self._chain.held
        for _ in range(2):
            begun = self._clock.now()
            with contextlib.suppress(CfplanError):
                places = [held.flown.at(held.ends / 2).position, *map(np.array, self._middle)]
                away = max(places, key=lambda place: float(np.linalg.norm(place - held.ahead[-1])))
                first, part = max(round(held.ends / 4 * RATE), 1), part_within(0.0)
                meanwhile = AnswerAttempt(lambda splice, equal: False, Ways(), foresee=False, meanwhile=True)
                waits = replan(held, first, [away, held.ahead[-1]], self._limits, part=part, attempt=meanwhile)
                assert len(waits.held.snapshots)
                self._meanwhile.note(2.0 * (self._clock.now() - begun), only=True)
                begun = self._clock.now()
                made = replan(held, first, [away, held.ahead[-1]], self._limits, part=part)
                self._plans.note(self._clock.now() - begun, only=True)
                go_on(made.held, made.proposal.splice + part // 2, self._limits, part)
                halt(made.held, made.proposal.splice + part // 2, self._limits)

    def serve(self) -> None:
        """Plan until the main process or the pilot has ended."""
        while True:
            answer = None
            if self._chain.stuck:
                answer = self._wait_for_pilot()
            elif self._chain.settled or self._requests.waiting is not None:
                answer = self._serve_next()
            else:
                self._chain.settle(or_request=True)
            if answer is not None:
                self._requests.tell(answer)

    def _serve_next(self) -> PathAnswer | None:
        """Wait for something to do, and do it; return what there is to tell."""
        requests, chain = self._requests, self._chain
        if requests.waiting is None and not self._wants_more() and not self._unforeseen:
            if self._busy:
                gc.collect()
            self._busy = False
            wait(self._inputs, _LOOK_AGAIN if chain.held.unfinished else None)
        chain.read()
        self._busy = self._busy or requests.waiting is not None or self._wants_more()
        if self._wants_more() and (requests.waiting is None or presses(chain.held, *self._next(self._plans))):
            if chain.settled:
                return self._go_on()
            chain.settle()
            return None
        if requests.waiting is None:
            return self._foresee() if self._unforeseen else None
        request, came = requests.take()
        self._pressed = came < max(self._done, chain.settled_at)
        answer, chain.fell_back = self._answer(request, came), False
        chain.read()  # what has come by now has waited
        self._done = self._clock.now()
        return None if answer is None else replace(answer, seconds=self._clock.now() - came)

    def _wants_more(self) -> bool:
        held, quiet = self._chain.held, self._clock.now() - self._requests.asked
        if not held.unfinished:
            return False
        if self._pressed and quiet < HASTE:
            return presses(held, *self._next(self._plans))
        return wants_more(held, self._next(self._parts)[0], quiet)

    def _next(self, lead: Lead, least: float = 0.0) -> tuple[int, float]:
        """Return the setpoint from which on one may plan now, and how far ahead it is, s, `least` at least."""
        ahead = max(lead.ahead(1.0 if self._pressed else IN_TIME), least)
        return self._in_time_for(ahead), ahead

    def _in_time_for(self, ahead: float) -> int:
        """Return the setpoint from which on one may plan who needs so long, s."""
        arrives = self._clock.now() - self._chain.begun + ahead
        return max(math.ceil((arrives + LOOKS_UNTIL) * RATE) - 1 + LEAST_AHEAD, self._chain.held.begin)

    def _answer(self, request: PathRequest, received: float) -> PathAnswer | None:
        """Plan what is asked for, and propose it; it was `received` at that time, s.

        Where others wait, neither what is simulated of the plan nor the pilot's answer is waited for, but taken to be
        good, and there is nothing to tell yet. Before the next proposal is sent, both have come.
        """
        if math.isnan(self._chain.begun):
            return PathAnswer(request.number, PathVerdict.REFUSED, "the plan is not flown yet")
        if not self._pressed:
            beside().wake()
        ways, bad = Ways(), set[Manner]()
        chain, reason, took, solved, checked = self._chain, "", 0.0, 0.0, 0.0
        for tried in range(TRIES):
            begun = self._made = self._clock.now()
            held = chain.held
            meanwhile = self._pressed and not chain.fell_back
            lead = self._stops if request.wish is Wish.STOP else self._meanwhile if meanwhile else self._plans
            checking = max(lead.checking, checked)
            # Where others wait, they are worth more than joints nearby.
            in_time = None if self._pressed else partial(self._in_time, checking)
            too_late = partial(self._too_late, checking, ways)
            attempt = AnswerAttempt(too_late, ways, in_time, foresee=False, meanwhile=meanwhile, bad=bad)
            badly = len(bad)
            if ways.found is not None:  # it needs less time than it took to find it
                needed = max(self._planning, solved) + checking
                ahead = max(AGAIN**tried * (self._planning + lead.checking), needed) + SLACK
                first = self._in_time_for(ahead)
            else:
                first, ahead = self._next(lead, AGAIN * took)
            try:
                made = self._planned(request, first, part_within(ahead), attempt)
            except TooLateError as error:
                solved = self._clock.now() - begun - ways.searched
                took = self._clock.now() - begun + self._to_do
                lead.note(took, self._left_out)
                if len(bad) > badly:  # it was not for want of a way
                    took = 0.0
                reason = str(error)
                continue
            except UnfoundedError:
                made = None
            except Exception as error:  # a fault here must not leave the rest of the flight without a planner
                made, reason = None, told_of(error)
            simulated_still = isinstance(made, Replanned) and made.held.simulated.coming is not None
            chain.release()
            if not simulated_still:
                chain.settle()
            if chain.held is not held and not chain.stuck:
                continue
            if made is None or chain.stuck:
                return PathAnswer(request.number, PathVerdict.REFUSED, NO_ANSWER if chain.stuck else reason)
            done = self._clock.now()
            took = done - begun
            if isinstance(made, HeldFlight):
                chain.held = made
                return answer_held(request, made)
            if made.plan is not None:
                self._planned_in.append(made.plan.seconds - ways.searched)
            proposed = Proposed(made, request, received, begun, done, lead)
            if simulated_still:
                chain.hold_back(proposed)
                return None
            if made.plan is not None:
                lead.note_checks(done - self._made)
            if made.stop is not None:
                answer = chain.propose(replace(proposed, made=made.stop))
                if answer is not None and answer.commitment is not None:
                    answer = chain.propose(replace(proposed, made=following(made, chain.held.commitment)))
            elif self._late_by(made.proposal.splice) > 0.0:
                reason, checked = Fault.LATE.value, done - self._made
                lead.note(took, made.equal / RATE)
                continue
            elif made.plan is not None and self._another_waits():
                chain.propose_meanwhile(proposed)
                return None
            else:
                answer = chain.propose(proposed)
            if answer is None:
                return PathAnswer(request.number, PathVerdict.REFUSED, NO_ANSWER)
            lead.note(max(answer.came, done) - begun, made.equal / RATE)
            reason = answer.reason
            if not reason.startswith(Fault.LATE):
                return proposed.answer(answer, self._clock.now())
        return PathAnswer(request.number, PathVerdict.LATE, reason)

    def _another_waits(self) -> bool:
        self._chain.read()
        return self._requests.waiting is not None

    def _too_late(self, checking: float, ways: Ways, splice: int, equal: int | None) -> bool:
        """Return whether what is planned from a setpoint on comes to the pilot too late, as `checking`, s, comes first.

        So many setpoints stay `equal`, which is learned; None where that is not known, as it must be planned still,
        along what was found of the `ways`.
        """
        self._chain.release_if_ready()
        of_kind = self._equal[ways.found is not None and ways.found[0] in ON_PATH_LEFT]
        self._to_do = checking
        if equal is None:
            self._to_do += self._planning
            self._left_out = float(np.median(of_kind)) / RATE
        else:
            self._made = self._clock.now()
            of_kind.append(equal)
            self._left_out = equal / RATE
        return self._late_by(splice) + self._to_do > self._left_out

    def _in_time(self, checking: float) -> int:
        """Return the number of the first setpoint in time for a plan that is made, as `checking`, s, comes first."""
        self._made = self._clock.now()
        return self._in_time_for(AGAIN * checking + SLACK)

    def _late_by(self, splice: int) -> float:
        """Return how much too late, s, what is sent now comes to the pilot, where it begins at a setpoint."""
        looks_until = self._chain.begun + (splice - LEAST_AHEAD + 1) / RATE - LOOKS_UNTIL
        return self._clock.now() + ON_THE_WAY - looks_until

    @property
    def _planning(self) -> float:
        """Return how long the plan along a way takes, s."""
        return float(np.median(self._planned_in))

    def _planned(self, request: PathRequest, first: int, part: int, attempt: AnswerAttempt) -> Replanned | HeldFlight:
        """Return what is to be proposed, from rest where no plan leads there from the motion."""
        try:
            return plan_request(self._chain.held, request, first, self._limits, part, attempt)
        except TooLateError:
            raise
        except CfplanError as error:
            later, _ = self._next(self._plans)
            return plan_behind_stop(self._chain.held, request, later, self._limits, part, error)

    def _go_on(self) -> PathAnswer | None:
        """Propose the next part of the plan that is flown; return what there is to tell."""
        begun, (first, ahead) = self._clock.now(), self._next(self._parts)
        try:
            made = plan_next_part(self._chain.held, first, self._limits, part_within(ahead, NEXT_PART))
        except Exception as error:  # as in _answer
            return self._interrupt(told_of(error))
        self._parts.note(self._clock.now() - begun)
        if isinstance(made, HeldFlight):
            self._chain.held = made
            return None
        answer = self._chain.propose(Proposed(made))
        return None if answer is None else self._gone_on(made, answer)

    def _foresee(self) -> PathAnswer | None:
        """Look far ahead on the plan that is flown, and propose to fly slower where it must be; as _go_on()."""
        self._unforeseen -= 1
        first, ahead = self._next(self._plans, UNHURRIED * (self._planning + self._plans.checking))
        ways = Ways()
        attempt = AnswerAttempt(partial(self._too_late, self._plans.checking, ways), ways)
        try:
            made = plan_slower(self._chain.held, first, self._limits, part_within(ahead), attempt)
        except TooLateError:
            return None
        except Exception:  # what is committed stays; its next part is certified in any case, and says so if it fails
            made = None
        if made is None:
            self._unforeseen = 0
        if made is None or self._another_waits():
            return None
        answer = self._chain.propose(Proposed(made))
        return None if answer is None or answer.commitment is None else answer_changed(self._accepted, made)

    def _gone_on(self, made: Replanned, answer: PilotAnswer) -> PathAnswer | None:
        """Return what there is to tell of the next part of a plan that the pilot has answered."""
        if answer.commitment is not None:
            return None if made.plan is None else answer_changed(self._accepted, made)
        return None if answer.reason.startswith(Fault.LATE) else self._interrupt(answer.reason)

    def _interrupt(self, reason: str) -> PathAnswer | None:
        """Let the vehicle rest behind what is committed, as more does not pass; return what there is to tell.

        From there it goes on, unless that is what does not pass.
        """
        self._chain.held = after_failure(self._chain.held, self._limits)
        return None if self._chain.held.unfinished else answer_cut_short(self._accepted, self._chain.held, reason)

    def _wait_for_pilot(self) -> PathAnswer | None:
        """Wait for the answer to a proposal that did not come soon; return what there is to tell.

        Until it has come nothing can be proposed: nobody knows what the pilot is bound to.
        """
        proposed = self._chain.proposed
        assert proposed is not None
        answer = self._chain.wait_for_answer()
        if answer is None:
            if self._requests.waiting is None:
                return None
            request, came = self._requests.take()
            return PathAnswer(request.number, PathVerdict.REFUSED, NO_ANSWER, seconds=self._clock.now() - came)
        if proposed.request is None:
            return self._gone_on(proposed.made, answer)
        if answer.commitment is None:
            return None  # as it was told to be
        return answer_accepted(proposed.request.number, proposed.made)

    def _note_accepted(self, proposed: Proposed) -> None:
        """Note that the pilot has accepted a proposal."""
        if proposed.request is not None:
            self._accepted = proposed.request.number
        if proposed.made.plan is not None:
            self._unforeseen = TRIES if proposed.request is not None else 0
