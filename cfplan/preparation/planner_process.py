"""The planner's process, beside the pilot: it makes certified proposals of what is asked for while the vehicle flies.

It may die, hang or be killed; then the vehicle ends on what is committed.
"""

import contextlib
import gc
import multiprocessing
import os
import signal
import sys
from collections.abc import Sequence
from multiprocessing.connection import Connection
from types import TracebackType

from cfplan.flight.telemetry import Triple
from cfplan.preparation.air_planner import PathAnswer, PathRequest, Wish
from cfplan.preparation.beside import BesideByProcess, work_beside
from cfplan.preparation.planner_worker import PlannerWorker
from cfplan.preparation.replan import HeldFlight
from cfplan.safety.limits import Limits

PRIORITY = -10  # niceness of the planner where that is allowed: behind the pilot, before all else
_GARBAGE = 100_000  # objects, after which it is looked through in any case
_SWITCH_INTERVAL = 0.0002  # s; a thread with loops gets the interpreter back after at most this
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


def _run(held: HeldFlight, limits: Limits, requests: Connection, pilot: Connection) -> None:
    """Run the planner's process."""
    with contextlib.suppress(OSError):
        os.setsid()  # the terminal's signals are for the main process
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTSTP):
        signal.signal(number, signal.SIG_IGN)
    sys.setswitchinterval(_SWITCH_INTERVAL)
    work_beside(BesideByProcess(_hasten))
    worker = PlannerWorker(held, limits, requests, pilot)
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
