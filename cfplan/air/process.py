"""The core of planning in the air in real time: a process beside the pilot's.

It may die, hang or be killed; then the vehicle ends on what is committed.
"""

import contextlib
import gc
import math
import multiprocessing
import os
import signal
import sys
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from types import TracebackType

import numpy as np

from cfplan.air.background import ChecksByProcess, do_checks_by
from cfplan.air.core import FIRST_PART, Answered, Asked, Begun, Event, Make, Propose, Tell, first_state, step
from cfplan.air.replanning import next_part, replan
from cfplan.air.requests import PathAnswer, PathRequest, Wish
from cfplan.air.stopping import halt
from cfplan.air.timeline import Timeline
from cfplan.errors import CfplanError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.pilot.proposals import read_answer
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.telemetry import Triple
from cfplan.safety.limits import Limits

PRIORITY = -10  # niceness of the planner where that is allowed: behind the pilot, before all else
_GARBAGE = 100_000  # objects, after which it is looked through in any case
_SWITCH_INTERVAL = 0.0002  # s; a thread with loops gets the interpreter back after at most this
_CLOSE_WITHIN = 1.0  # s
_FIRST_JOBS = 1.0, 0.1  # s that a plan, and a stop, are taken to need where warming up made none
_MIDDLE = 0.4, 0.6  # fractions of the space's size, where warming up flies to


class AirPlanner:
    """The planner's process as the main process sees it; a context manager."""

    def __init__(self, timeline: Timeline, limits: Limits, pilot: Connection):
        """Start it; `timeline` is what the pilot's mission was made from, `pilot` the end of its proposals."""
        context = multiprocessing.get_context("spawn")
        self._requests, requests_end = context.Pipe()
        self._process = context.Process(target=_run, args=(timeline, limits, requests_end, pilot), name="planner")
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


class PlannerWorker:
    """The core in its process: it takes events from pipes, and does jobs between them."""

    def __init__(
        self, timeline: Timeline, limits: Limits, requests: Connection, pilot: Connection, clock: Clock = REAL_CLOCK
    ):
        self._limits, self._requests, self._pilot, self._clock = limits, requests, pilot, clock
        self.state = first_state(timeline, *_FIRST_JOBS)
        self._idle = True  # garbage was looked for since the last job

    def warm_up(self) -> None:
        """Do jobs and discard what they make, so that all code is loaded, and it is known how long they take."""
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
        """Plan until the main process or the pilot has ended."""
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
        """Return what the pilot has sent."""
        answer = read_answer(self._pilot.recv_bytes())
        if answer.begun is not None:
            return Begun(answer.begun)
        return Answered(answer.proposal, answer.commitment, answer.came, answer.reason)

    def _take(self, events: list[Event]) -> None:
        """Take events, and do what follows from them; jobs are done here, while pipes keep what comes."""
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
    """Let this process be held up by as little as may be: what it has already is no garbage, and others have time."""
    gc.collect()
    gc.freeze()  # what was imported is not looked through again in flight
    gc.set_threshold(_GARBAGE)  # the worker looks when nothing is asked for
    with contextlib.suppress(OSError, AttributeError):  # not everybody may; other systems have other ways
        for thread in map(int, os.listdir("/proc/self/task")):
            os.setpriority(os.PRIO_PROCESS, thread, PRIORITY)
