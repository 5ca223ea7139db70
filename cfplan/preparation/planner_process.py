"""The planner's process, beside the pilot: it makes certified proposals of what is asked for while the vehicle flies.

It plans from the earliest setpoint that it can make, by how long its last plans took. The latest request wins: one that
waits is dropped when another comes. What a plan leads to far ahead is looked at once its beginning is committed, and
flown slower where it must be. The planner may die, hang or be killed; then the vehicle ends on what is committed.
"""

import contextlib
import gc
import math
import multiprocessing
import os
import signal
import sys
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from types import TracebackType

import numpy as np

from cfplan.errors import CfplanError
from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.pilot.proposals import LOOKS_UNTIL, PilotAnswer, read_answer
from cfplan.flight.setpoints.commitment import LEAST_AHEAD, Fault, spliced
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.telemetry import Triple
from cfplan.planning.continuation import TooLateError, Ways
from cfplan.preparation.air_planner import (
    NEXT_PART,
    SLACK,
    AnswerTimes,
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
from cfplan.preparation.beside import BesideByProcess, beside, work_beside
from cfplan.preparation.replan import (
    AnswerAttempt,
    HeldFlight,
    Replanned,
    accepted,
    after_failure,
    following,
    go_on,
    halt,
    replan,
)
from cfplan.safety.limits import Limits

FIRST_TIME = 1.0  # s that a plan is taken to need before any was made
FIRST_STOP = 0.1  # s that a stop is taken to need before any was made
LEARNED_FROM = 15  # plans, by which one knows how long the next may take
IN_TIME = 0.6  # share of them for which what is taken to be needed was enough: one that comes late is planned again
AGAIN = 1.15  # by how much longer each time a request is taken to need that came late, and has a known way
UNHURRIED = 3.0  # times what a plan needs, that one lies ahead which nobody waits for
TRIES = 4  # of a request whose proposal comes late
ON_THE_WAY = 0.001  # s that a proposal takes to the pilot, at least
_GARBAGE = 100_000  # objects, after which it is looked through in any case
_SWITCH_INTERVAL = 0.0002  # s; a thread with loops gets the interpreter back after at most this
PRIORITY = -10  # niceness of the planner where that is allowed: behind the pilot, before all else
_LOOK_AGAIN = 0.05  # s, until the planner sees whether more of a plan is to be made
_ANSWER_WITHIN = 1.0  # s in which a pilot answers; what comes later counts as well
NO_ANSWER = "the pilot does not answer; where it still accepts what was proposed last, that is flown"
_CLOSE_WITHIN = 1.0  # s


class AirPlanner:
    """The planner's process as the main process sees it; a context manager."""

    def __init__(self, held: HeldFlight, limits: Limits, pilot: Connection):
        """Start it; `held` is what the pilot's mission was made from, `pilot` the end of its proposals."""
        context = multiprocessing.get_context("spawn")
        self._requests, requests_end = context.Pipe()
        self._process = context.Process(target=_run, args=(held, limits, requests_end, pilot), name="planner")
        self._process.start()
        requests_end.close()
        self._number = 0
        self.ready = False  # whether it has said that it can plan

    def request(self, wish: Wish, waypoints: Sequence[Triple] = ()) -> int:
        """Ask for a change; return the number of its answer. A planner that has ended answers nothing."""
        self._number += 1
        points = tuple((float(x), float(y), float(z)) for x, y, z in waypoints)
        with contextlib.suppress(OSError):
            self._requests.send(PathRequest(self._number, wish, points))
        return self._number

    def answers(self, patience: float = 0.0) -> list[PathAnswer]:
        """Return the answers since the last call; wait for one for `patience`, s."""
        found: list[PathAnswer] = []
        with contextlib.suppress(EOFError, OSError):
            while self._requests.poll(0.0 if found else patience):
                message = self._requests.recv()
                if isinstance(message, PathAnswer):
                    found.append(message)
                else:
                    self.ready, patience = True, 0.0
        return found

    @property
    def process_id(self) -> int | None:
        """Return the number of the process."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Return whether it runs."""
        return self._process.is_alive()

    def close(self) -> None:
        """End it. May be called twice."""
        self._requests.close()
        self._process.join(_CLOSE_WITHIN)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def __enter__(self) -> "AirPlanner":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _Lead:
    """How far ahead of the clock to plan, by how long plans took lately: most, not all, are to be in time."""

    def __init__(self, first: float):
        """Begin with what a plan is taken to need before any was made, s."""
        self._took: deque[tuple[float, float]] = deque([(first, 0.0)], maxlen=LEARNED_FROM)

    def note(self, seconds: float, left_out: float = 0.0, *, only: bool = False) -> None:
        """Learn how long a plan took, s; with `only`, forget what was known before.

        `left_out`, s, is by how much later it began than where it was planned from.
        """
        if only:
            self._took.clear()
        self._took.append((seconds, left_out))

    def ahead(self, in_time: float = IN_TIME) -> float:
        """Return what the next plan is taken to need, s, with its way to the pilot: so much that this share has it."""
        return float(np.quantile([took - left_out for took, left_out in self._took], in_time)) + SLACK


@dataclass(frozen=True, slots=True, eq=False)
class _Proposed:
    """A proposal that the pilot has not answered yet."""

    made: Replanned
    request: PathRequest | None  # None where it is the next part of the plan that is flown
    received: float = math.nan  # s, when that came
    begun: float = math.nan  # s, when it was begun to be planned
    proposed: float = math.nan  # s, when it was sent
    before: HeldFlight | None = None  # what is held where it is refused, where another is planned on it meanwhile


class _Worker:
    """The planner in its own process."""

    def __init__(self, held: HeldFlight, limits: Limits, requests: Connection, pilot: Connection):
        self._held, self._limits, self._requests, self._pilot = held, limits, requests, pilot
        self._begun: float | None = None  # s, when setpoint 0 was due
        self._plans, self._stops, self._parts = _Lead(FIRST_TIME), _Lead(FIRST_STOP), _Lead(FIRST_STOP)
        self._planned_in: deque[float] = deque([0.0], maxlen=LEARNED_FROM)  # s of plans, once a way was known
        self._checks: deque[float] = deque([0.0], maxlen=LEARNED_FROM)  # s from a plan to its proposal
        self._equal: deque[int] = deque([0], maxlen=LEARNED_FROM)  # setpoints that proposals left out as equal
        # When last asked whether something comes too late, s: what was to be done still, by how much later than where
        # it might it begins, as setpoints before are equal.
        self._to_do = self._left_out = 0.0
        self._waiting: tuple[PathRequest, float] | None = None
        self._asked = -math.inf  # s, when the last request came
        self._pressed = False  # whether requests come faster than they can be planned
        self._done = -math.inf  # s, when the last one was planned
        self._busy = False  # whether something was done since garbage was looked for
        self._proposed: _Proposed | None = None
        self._accepted = 0  # number of the request whose plan is flown
        self._unforeseen = 0  # how often it may be tried still to look far ahead on that

    @property
    def _middle(self) -> list[tuple[float, ...]]:
        """Return two places in the middle of the space, m, apart."""
        space = self._limits.space
        shares = (0.4, 0.6)
        return [
            tuple(low + share * (high - low) for low, high in zip(space.low, space.high, strict=True))
            for share in shares
        ]

    def warm_up(self) -> None:
        """Make two plans and stops for nobody: what a first call compiles or loads is there before the flight."""
        held = self._held
        for _ in range(2):
            begun = REAL_CLOCK.now()
            with contextlib.suppress(CfplanError):
                places = [held.flown.at(held.ends / 2).position, *map(np.array, self._middle)]
                away = max(places, key=lambda place: float(np.linalg.norm(place - held.ahead[-1])))
                first, part = max(round(held.ends / 4 * RATE), 1), part_within(0.0)
                made = replan(held, first, [away, held.ahead[-1]], self._limits, part=part)
                self._plans.note(REAL_CLOCK.now() - begun, only=True)
                go_on(made.held, made.proposal.splice + part // 2, self._limits, part)
                halt(made.held, made.proposal.splice + part // 2, self._limits)

    def serve(self) -> None:
        """Plan until the main process or the pilot has ended."""
        while True:
            meanwhile = self._proposed is None or (self._proposed.before is not None and self._waiting is not None)
            answer = self._serve_next() if meanwhile else self._settle()
            if answer is not None:
                self._requests.send(answer)

    def _serve_next(self) -> PathAnswer | None:
        """Wait for something to do, and do it; return what there is to tell."""
        if self._waiting is None and not self._wants_more() and not self._unforeseen:
            if self._busy:
                gc.collect()
            self._busy = False
            wait([self._requests, self._pilot], _LOOK_AGAIN if self._held.unfinished else None)
        self._read(0.0)
        self._busy = self._busy or self._waiting is not None or self._wants_more()
        if self._wants_more() and (self._waiting is None or presses(self._held, *self._next(self._plans))):
            return self._go_on() if self._proposed is None else self._settle()
        if self._waiting is None:
            return self._foresee() if self._unforeseen and self._proposed is None else None
        (request, since), self._waiting = self._waiting, None
        self._pressed = since < self._done
        answer = self._answer(request, since)
        self._done = REAL_CLOCK.now()
        return None if answer is None else replace(answer, seconds=REAL_CLOCK.now() - since)

    def _wants_more(self) -> bool:
        quiet = REAL_CLOCK.now() - self._asked
        return self._held.unfinished and wants_more(self._held, self._next(self._parts)[0], quiet)

    def _next(self, lead: _Lead, least: float = 0.0) -> tuple[int, float]:
        """Return the setpoint from which on one may plan now, and how far ahead it is, s, `least` at least."""
        ahead = max(lead.ahead(1.0 if self._pressed else IN_TIME), least)
        return self._in_time_for(ahead), ahead

    def _in_time_for(self, ahead: float) -> int:
        """Return the setpoint from which on one may plan who needs so long, s."""
        assert self._begun is not None
        arrives = REAL_CLOCK.now() - self._begun + ahead
        return max(math.ceil((arrives + LOOKS_UNTIL) * RATE) - 1 + LEAST_AHEAD, self._held.begin)

    def _read(self, patience: float) -> PilotAnswer | None:
        """Take what has come; return the pilot's answer to a proposal if there is one, waiting for it if asked to.

        What it accepts is held from then on, however late that is heard of.
        """
        found = None
        until = REAL_CLOCK.now() + patience
        while ready := wait([self._requests, self._pilot], max(until - REAL_CLOCK.now(), 0.0)):
            if self._pilot in ready:
                answer = read_answer(self._pilot.recv_bytes())
                if answer.begun is not None:
                    self._begun = answer.begun
                elif self._proposed is not None and answer.proposal == self._proposed.made.proposal.checksum:
                    self._hold(self._proposed.made, answer)
                    found = answer
                    until = 0.0
            if self._requests in ready:
                request = self._requests.recv()
                if self._waiting is not None:
                    self._requests.send(PathAnswer(self._waiting[0].number, PathVerdict.SUPERSEDED))
                self._asked = REAL_CLOCK.now()
                self._waiting = request, self._asked
        return found

    def _answer(self, request: PathRequest, received: float) -> PathAnswer | None:
        """Plan what is asked for, and propose it; it was `received` at that time, s.

        Where another request waits by then, the pilot's answer is not waited for, but taken to be good, and there is
        nothing to tell yet. Before the next proposal is sent, the answer has come.
        """
        if self._begun is None:
            return PathAnswer(request.number, PathVerdict.REFUSED, "the plan is not flown yet")
        if not self._pressed:
            beside().wake()
        in_time = None if self._pressed else self._in_time  # where others wait they are worth more than joints nearby
        reason, took, attempt = "", 0.0, AnswerAttempt(self._too_late, Ways(), in_time, foresee=False)
        lead = self._stops if request.wish is Wish.STOP else self._plans
        for tried in range(TRIES):
            begun, held = REAL_CLOCK.now(), self._held
            along = AGAIN**tried * (self._planning + self._checking)
            if attempt.ways.found is not None:  # it needs less time than it took to find it
                ahead = along + SLACK
                first = self._in_time_for(ahead)
            else:
                first, ahead = self._next(lead, AGAIN * took)
            made: Replanned | HeldFlight | None
            try:
                made = self._planned(request, first, part_within(ahead), attempt)
            except TooLateError as error:
                took = REAL_CLOCK.now() - begun + self._to_do
                lead.note(took, self._left_out)
                reason = str(error)
                continue
            except CfplanError as error:
                made, reason = None, str(error)
            except Exception as error:  # a fault here must not leave the rest of the flight without a planner
                made, reason = None, f"fault in the planner: {error!r}"
            if not self._as_foreseen(held):
                if self._proposed is None:
                    continue
                made, reason = None, NO_ANSWER
            if made is None:
                return PathAnswer(request.number, PathVerdict.REFUSED, reason)
            proposed = REAL_CLOCK.now()
            took = proposed - begun
            if isinstance(made, HeldFlight):
                self._held = made
                return answer_held(request, made)
            if made.plan is not None:
                self._planned_in.append(made.plan.seconds - attempt.ways.searched)
                self._checks.append(took - made.plan.seconds)
            sent = _Proposed(made, request, received, begun, proposed)
            if made.stop is not None:
                answer = self._propose(replace(sent, made=made.stop))
                if answer is not None and answer.commitment is not None:
                    answer = self._propose(replace(sent, made=following(made, self._held.commitment)))
            elif self._late_by(made.proposal.splice) > 0.0:
                reason = Fault.LATE.value
                lead.note(took, made.equal / RATE)
                continue
            elif made.plan is not None and self._another_waits():
                self._send(replace(sent, before=self._held))
                return None
            else:
                answer = self._propose(sent)
            if answer is None:
                return PathAnswer(request.number, PathVerdict.REFUSED, NO_ANSWER)
            lead.note(max(answer.came, proposed) - begun, made.equal / RATE)
            reason = answer.reason
            if not reason.startswith(Fault.LATE):
                return self._outcome(sent, answer)
        return PathAnswer(request.number, PathVerdict.LATE, reason)

    def _outcome(self, sent: _Proposed, answer: PilotAnswer) -> PathAnswer:
        """Return the answer to a request by the pilot's to its proposal."""
        request, made = sent.request, sent.made
        assert request is not None
        if answer.commitment is None:
            late = answer.reason.startswith(Fault.LATE)
            return PathAnswer(request.number, PathVerdict.LATE if late else PathVerdict.REFUSED, answer.reason)
        self._accepted = request.number
        seconds = 0.0 if made.plan is None else made.plan.seconds
        times = AnswerTimes(sent.received, sent.begun, seconds, sent.proposed, REAL_CLOCK.now())
        stop = 0 if made.stop is None else made.stop.proposal.checksum
        return replace(answer_accepted(request.number, made, stop), times=times)

    def _another_waits(self) -> bool:
        self._read(0.0)
        return self._waiting is not None

    def _as_foreseen(self, held: HeldFlight) -> bool:
        """Return whether the pilot is bound to what something was planned on; wait for its answer if need be."""
        if self._proposed is not None and (told := self._settle()) is not None:
            self._requests.send(told)
        return self._held is held

    def _too_late(self, splice: int, equal: int | None) -> bool:
        """Return whether what is planned from a setpoint on, and must be checked still, comes to the pilot too late.

        So many setpoints stay `equal`, which is learned; None where that is not known, as it must be planned still.
        """
        self._to_do = self._checking
        if equal is None:
            self._to_do += self._planning
            self._left_out = float(np.median(self._equal)) / RATE
        else:
            self._equal.append(equal)
            self._left_out = equal / RATE
        return self._late_by(splice) + self._to_do > self._left_out

    def _in_time(self) -> int:
        """Return the number of the first setpoint that is in time for a plan that is made and must be checked."""
        return self._in_time_for(AGAIN * self._checking + SLACK)

    def _late_by(self, splice: int) -> float:
        """Return how much too late, s, what is sent now comes to the pilot, where it begins at a setpoint."""
        assert self._begun is not None
        looks_until = self._begun + (splice - LEAST_AHEAD + 1) / RATE - LOOKS_UNTIL
        return REAL_CLOCK.now() + ON_THE_WAY - looks_until

    @property
    def _planning(self) -> float:
        """Return how long the plan along a way takes, s."""
        return float(np.median(self._planned_in))

    @property
    def _checking(self) -> float:
        """Return how long the checks of a plan take, s."""
        return float(np.median(self._checks))

    def _planned(self, request: PathRequest, first: int, part: int, attempt: AnswerAttempt) -> Replanned | HeldFlight:
        """Return what is to be proposed, from rest where no plan leads there from the motion."""
        try:
            return plan_request(self._held, request, first, self._limits, part, attempt)
        except TooLateError:
            raise
        except CfplanError as error:
            later, _ = self._next(self._plans)
            return plan_behind_stop(self._held, request, later, self._limits, part, error)

    def _go_on(self) -> PathAnswer | None:
        """Propose the next part of the plan that is flown; return what there is to tell."""
        begun, (first, ahead) = REAL_CLOCK.now(), self._next(self._parts)
        try:
            made = plan_next_part(self._held, first, self._limits, part_within(ahead, NEXT_PART))
        except Exception as error:  # as in _answer
            return self._interrupt(str(error) if isinstance(error, CfplanError) else f"fault in the planner: {error!r}")
        self._parts.note(REAL_CLOCK.now() - begun)
        if isinstance(made, HeldFlight):
            self._held = made
            return None
        answer = self._propose(_Proposed(made, None))
        return None if answer is None else self._gone_on(made, answer)

    def _foresee(self) -> PathAnswer | None:
        """Look far ahead on the plan that is flown, and propose to fly slower where it must be; as _go_on()."""
        self._unforeseen -= 1
        first, ahead = self._next(self._plans, UNHURRIED * (self._planning + self._checking))
        try:
            made = plan_slower(
                self._held, first, self._limits, part_within(ahead), AnswerAttempt(self._too_late, Ways())
            )
        except TooLateError:
            return None
        except Exception:  # what is committed stays; its next part is certified in any case, and says so if it fails
            made = None
        if made is None:
            self._unforeseen = 0
        if made is None or self._another_waits():
            return None
        answer = self._propose(_Proposed(made, None))
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
        self._held = after_failure(self._held, self._limits)
        return None if self._held.unfinished else answer_cut_short(self._accepted, self._held, reason)

    def _propose(self, proposed: _Proposed) -> PilotAnswer | None:
        """Send a proposal and wait for the pilot's answer; None where that does not come soon."""
        self._send(proposed)
        return self._read(_ANSWER_WITHIN)

    def _send(self, proposed: _Proposed) -> None:
        self._pilot.send_bytes(proposed.made.proposal.to_bytes())
        self._proposed = proposed
        if proposed.before is not None:
            self._held = self._committed_to(proposed.made)

    def _settle(self) -> PathAnswer | None:
        """Wait for the answer to a proposal that was not waited for, or not long enough; return what there is to tell.

        Until it has come nothing can be proposed: nobody knows what the pilot is bound to.
        """
        proposed = self._proposed
        assert proposed is not None
        answer = self._read(_ANSWER_WITHIN)
        if proposed.before is not None:
            if answer is not None:
                return None  # as was told when it came
            self._held, self._proposed = proposed.before, replace(proposed, before=None)
            assert proposed.request is not None
            return PathAnswer(proposed.request.number, PathVerdict.REFUSED, NO_ANSWER)
        if answer is None:
            if self._waiting is None:
                return None
            (request, since), self._waiting = self._waiting, None
            return PathAnswer(request.number, PathVerdict.REFUSED, NO_ANSWER, seconds=REAL_CLOCK.now() - since)
        if proposed.request is None:
            return self._gone_on(proposed.made, answer)
        if answer.commitment is None:
            return None  # as it was told to be
        self._accepted = proposed.request.number
        return answer_accepted(self._accepted, proposed.made)

    def _hold(self, made: Replanned, answer: PilotAnswer) -> None:
        """Take the pilot's answer to a proposal."""
        proposed, self._proposed = self._proposed, None
        assert proposed is not None
        if answer.commitment is not None and made.plan is not None:
            self._unforeseen = TRIES if proposed.request is not None else 0
        if proposed.before is not None:  # nobody waits for it
            self._plans.note(max(answer.came, proposed.proposed) - proposed.begun, made.equal / RATE)
            told = self._outcome(proposed, answer)
            self._requests.send(replace(told, seconds=REAL_CLOCK.now() - proposed.received))
            if answer.commitment is None:
                self._held = proposed.before
        elif answer.commitment is not None:
            self._held = self._committed_to(made)
        assert answer.commitment in (None, self._held.commitment.checksum)

    def _committed_to(self, made: Replanned) -> HeldFlight:
        """Return what is held once the pilot has accepted a proposal."""
        assert self._begun is not None
        due = math.floor((REAL_CLOCK.now() - self._begun) * RATE)  # the pilot looked a little earlier
        now = min(due, made.proposal.splice - LEAST_AHEAD)
        return accepted(made, spliced(self._held.commitment, made.proposal, now))


def _run(held: HeldFlight, limits: Limits, requests: Connection, pilot: Connection) -> None:
    """Run the planner's process."""
    with contextlib.suppress(OSError):
        os.setsid()  # the terminal's signals are for the main process
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTSTP):
        signal.signal(number, signal.SIG_IGN)
    sys.setswitchinterval(_SWITCH_INTERVAL)
    work_beside(BesideByProcess(_hasten))
    worker = _Worker(held, limits, requests, pilot)
    worker.warm_up()
    _hasten()
    with contextlib.suppress(EOFError, OSError):
        requests.send("ready")
        worker.serve()


def _hasten() -> None:
    """Let this process be held up by as little as may be: what it has already is no garbage, and others have time."""
    gc.collect()
    gc.freeze()  # what was imported is not looked through again in flight
    gc.set_threshold(_GARBAGE)  # the worker looks when nothing is asked for
    with contextlib.suppress(OSError, AttributeError):  # not everybody may; other systems have other ways
        for thread in map(int, os.listdir("/proc/self/task")):
            os.setpriority(os.PRIO_PROCESS, thread, PRIORITY)
