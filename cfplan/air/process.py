"""Drives the core of planning in the air in real time, in a process beside the pilot's.

If that process dies, hangs or is killed, the vehicle flies its commitment to the end.
"""

import contextlib
import gc
import math
import multiprocessing
import os
import select
import signal
import sys
import threading
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from types import TracebackType

import numpy as np

from cfplan.air.background import ChecksByProcess, do_checks_by
from cfplan.air.core import FIRST_PART, Answered, Asked, Begun, Event, Make, Propose, Tell, first_state, step
from cfplan.air.replanning import next_part, replan
from cfplan.air.requests import PathAnswer, PathRequest, PathVerdict, Wish
from cfplan.air.stopping import halt
from cfplan.air.timeline import Timeline
from cfplan.errors import CfplanError, RequestRefusedError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.pilot.proposals import read_answer
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.telemetry import Triple
from cfplan.safety.limits import Limits

PLANNER_ANSWER_TIMEOUT = 15.0  # s without reading or answering a request, after which the planner counts as hung
PLANNER_GONE = "the planner's process has ended; the vehicle flies what is committed, and then hovers"
PRIORITY = -10  # niceness of the planner, if allowed: below the pilot, above all else
_GARBAGE = 100_000  # allocations after which garbage is collected in any case
_SWITCH_INTERVAL = 0.0002  # s, after which a thread that waits for the interpreter gets it
_CLOSE_WITHIN = 1.0  # s
_FIRST_JOBS = 1.0, 0.1  # s to assume for a plan and for a stop if warming up made none
_MIDDLE = 0.4, 0.6  # fractions of the space's size: the places that plans of the warm-up lead to


class AirPlanner:
    """The main process's handle of the planner process; a context manager.

    Any thread may send requests. One thread reads the answers, and must keep reading: a planner that cannot send its
    answers stops reading requests.
    """

    def __init__(self, timeline: Timeline, limits: Limits, pilot: Connection):
        """Start the process; the pilot's mission was made from `timeline`, `pilot` is the pipe for proposals."""
        context = multiprocessing.get_context("spawn")
        self._requests, requests_end = context.Pipe()
        self._process = context.Process(target=_run, args=(timeline, limits, requests_end, pilot), name="planner")
        self._process.start()
        requests_end.close()
        self._asking = threading.Lock()
        self._number = 0
        self._unanswered: set[int] = set()
        self.ready = False  # whether it has reported that it can plan

    def request(self, wish: Wish, waypoints: Sequence[Triple] = ()) -> int:
        """Send a request; return its number, which its answer names.

        Waits while the pipe is full of requests that the planner has not read. Raises RequestRefusedError if it reads
        none within PLANNER_ANSWER_TIMEOUT.
        """
        points = tuple((float(x), float(y), float(z)) for x, y, z in waypoints)
        with self._asking:
            self._number += 1
            number = self._number
            self._unanswered.add(number)
            with contextlib.suppress(OSError):  # the process has ended: `answers` refuses the request
                if not select.select([], [self._requests], [], PLANNER_ANSWER_TIMEOUT)[1]:
                    self._unanswered.discard(number)
                    raise RequestRefusedError(
                        f"the planner has read no request for {PLANNER_ANSWER_TIMEOUT:g} s",
                        where="planner",
                        hint="land; until then the vehicle flies its committed path and hovers at its end",
                    )
                self._requests.send(PathRequest(number, wish, points))
        return number

    def answers(self, patience: float = 0.0) -> list[PathAnswer]:
        """Return the answers since the last call; wait up to `patience`, s, for the first.

        Once the process has ended, every request that it left unanswered is refused.
        """
        gone = not self.alive
        found: list[PathAnswer] = []
        with contextlib.suppress(EOFError, OSError):
            while self._requests.poll(0.0 if found else patience):
                message = self._requests.recv()
                if isinstance(message, PathAnswer):
                    found.append(message)
                else:
                    self.ready, patience = True, 0.0
        self._unanswered.difference_update(answer.number for answer in found)
        if gone:
            left = sorted(self._unanswered)
            self._unanswered.difference_update(left)
            found += [PathAnswer(number, PathVerdict.REFUSED, PLANNER_GONE) for number in left]
        return found

    @property
    def process_id(self) -> int | None:
        """Return the process id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Return whether the process runs."""
        return self._process.is_alive()

    def close(self) -> None:
        """End the process. May be called twice."""
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


class PlannerWorker:
    """Runs the core in the planner process: reads events from pipes, and does jobs in between."""

    def __init__(
        self, timeline: Timeline, limits: Limits, requests: Connection, pilot: Connection, clock: Clock = REAL_CLOCK
    ):
        self._limits, self._requests, self._pilot, self._clock = limits, requests, pilot, clock
        self.state = first_state(timeline, *_FIRST_JOBS)
        self._idle = True  # whether garbage was collected since the last job

    def warm_up(self) -> None:
        """Do jobs and discard their results, to load all code and to learn how long jobs take."""
        timeline, limits = self.state.timeline, self._limits
        end = timeline.ahead[-1]
        space = limits.space
        places = [np.array(space.low) + fraction * (np.array(space.high) - np.array(space.low)) for fraction in _MIDDLE]
        away = max(
            (place for place in places if space.holds(place)), key=lambda place: math.dist(place, end), default=end
        )
        first, part = max(round(timeline.ends / 4 * RATE), 1), round(FIRST_PART * RATE)
        for _ in range(2):
            begun = self._clock.now()
            with contextlib.suppress(CfplanError):
                made = replan(timeline, first, [away, end], limits, part=part)
                planned = self._clock.now()
                next_part(made.timeline, made.proposal.splice + part // 2, limits, part)
                halt(made.timeline, made.proposal.splice + part // 2, limits)
                self.state = first_state(timeline, planned - begun, self._clock.now() - planned)

    def serve(self) -> None:
        """Handle events until the main process or the pilot has ended."""
        while True:
            if self.state.job is None and not self._idle and self.state.wakes is None:
                gc.collect()
                self._idle = True
            ready = wait([self._requests, self._pilot], self.state.wakes)
            events = [self._heard()] if self._pilot in ready else []
            while self._requests.poll():  # of several requests the latest wins
                events.append(Asked(self._requests.recv()))
            self._take(events)

    def _heard(self) -> Event:
        """Read an event from the pilot."""
        answer = read_answer(self._pilot.recv_bytes())
        if answer.begun is not None:
            return Begun(answer.begun)
        return Answered(answer.proposal, answer.commitment, answer.came, answer.reason)

    def _take(self, events: list[Event]) -> None:
        """Step the core and carry out its effects; jobs run here, while the pipes buffer further events."""
        while True:
            self.state, effects = step(self.state, events, self._clock.now(), self._limits)
            events = []
            for effect in effects:
                match effect:
                    case Make(job):
                        events.append(job.outcome(self.state.timeline, self._limits))
                        self._idle = False
                    case Propose(proposal):
                        self._pilot.send_bytes(proposal.to_bytes())
                    case Tell(answer):
                        self._requests.send(answer)
            if not events:
                return


def _run(timeline: Timeline, limits: Limits, requests: Connection, pilot: Connection) -> None:
    """Run the planner's process."""
    with contextlib.suppress(OSError):
        os.setsid()  # the terminal's signals are for the main process
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTSTP):
        signal.signal(number, signal.SIG_IGN)
    sys.setswitchinterval(_SWITCH_INTERVAL)
    do_checks_by(ChecksByProcess(_hasten))
    worker = PlannerWorker(timeline, limits, requests, pilot)
    worker.warm_up()
    _hasten()
    with contextlib.suppress(EOFError, OSError):
        requests.send("ready")
        worker.serve()


def _hasten() -> None:
    """Reduce pauses in this process: exempt present objects from garbage collection, and raise its priority."""
    gc.collect()
    gc.freeze()  # collections in flight skip all that was imported
    gc.set_threshold(_GARBAGE)  # the worker collects when it is idle
    with contextlib.suppress(OSError, AttributeError):  # needs permission, and Linux
        for thread in map(int, os.listdir("/proc/self/task")):
            os.setpriority(os.PRIO_PROCESS, thread, PRIORITY)
