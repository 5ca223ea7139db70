"""Measure how late setpoints are sent, with record, live view and Vicon, and how late this computer wakes a sleeper.

The real pilot flies PATH in the virtual lab; after its end the vehicle hovers. Before and during the flight, a process
that only sleeps until deadlines measures the latency of the computer itself. Everything is measured first with
SCHED_FIFO, if the system permits it, then without, for which this command drops the permission.
"""

import contextlib
import ctypes
import math
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from cfplan.errors import ExitCode, InputError
from cfplan.flight.real_time import may_use_fifo_scheduling
from cfplan.flight.setpoints.encoding import RATE
from cfplan.preparation.plan_flight import FlightOptions
from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.recording.header import RecordHeader
from cfplan.recording.rerun.live import LiveView, live_blueprint
from cfplan.recording.rerun.viewer import APPLICATION, free_port, lay_out, viewer_program
from studies.real_time import Conditions, RealTimeFlight, fly_in_real_time, patient
from studies.runner.limits import limits_for
from studies.runner.options import argument, option
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work
from studies.sleeper import Sleeper

COLUMNS = (
    Column("what", "what"),
    Column("priority", "priority"),
    Column("seconds", "for", "s", ".0f"),
    Column("p50", "p50", "ms", ".3f", meaning="late by, as p99, p99.9 and max"),
    Column("p99", "p99", "ms", ".3f"),
    Column("p999", "p99.9", "ms", ".3f"),
    Column("max", "max", "ms", ".3f"),
    Column("count"),
    Column("above", "above 1 ms", of="count"),
    Column("skipped", "left out", meaning="deadlines that passed altogether"),
    Column(
        "stolen", "stolen", "s", ".2f",
        meaning="what the host of a virtual machine took from all its processors meanwhile",
    ),
    Column("remark", "remark"),
)  # fmt: skip
FIRST, ORDINARY = "SCHED_FIFO", "ordinary"
QUEUED = "stream, of that waiting for a processor"  # time in the run queue per period, as the system counts it
_DROP_CAPABILITY, _NICE_CAPABILITY = 24, 23  # PR_CAPBSET_DROP, CAP_SYS_NICE
_VIEWER_STARTS = 2.0  # s


@dataclass(frozen=True, slots=True)
class Settings:
    """The path to fly, and for how long."""

    path_file: Path = argument()
    seconds: float = option(60.0, "Shortest time of streaming, s; after the end of PATH the vehicle hovers.", least=1)


@dataclass(frozen=True, slots=True)
class WakeUps:
    """Latency of one kind of wake-up."""

    what: str
    priority: str
    reason: str  # why there is no measurement, or why it is short; "" if it is complete
    seconds: float = math.nan
    p50: float = math.nan  # s, median latency; likewise p99, p999 and max
    p99: float = math.nan
    p999: float = math.nan
    max: float = math.nan
    count: int = 0
    above: float = math.nan  # number of wake-ups that were more than 1 ms late
    skipped: int = 0  # deadlines that were missed altogether
    stolen: float = 0.0  # s of steal time, over all processors of this virtual machine
    view_failure: str = ""  # why the live view ended early

    @staticmethod
    def of(what: str, priority: str, late: Sequence[float], reason: str = "", **others: Any) -> "WakeUps":
        """Return the percentiles of these latencies, s."""
        p50, p99, p999 = np.percentile(late, [50, 99, 99.9])
        above = int(np.sum(np.array(late) > 1e-3))
        return WakeUps(
            what, priority, reason, len(late) / RATE, float(p50), float(p99), float(p999), float(np.max(late)),
            len(late), above, **others,
        )  # fmt: skip

    @property
    def remark(self) -> str:
        """Return why the measurement or the live view ended early."""
        return "; ".join(filter(None, (self.reason, self.view_failure)))


def give_up_priority() -> None:
    """Give up the permission to use SCHED_FIFO, for this process and its children."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_DROP_CAPABILITY, _NICE_CAPABILITY, 0, 0, 0)


def work(
    settings: Settings,
    run: Run,
    *,
    fly: Callable[..., RealTimeFlight] = fly_in_real_time,
    sleeper: Callable[..., Any] = Sleeper,
    permitted: Callable[[], bool] = may_use_fifo_scheduling,
    give_up: Callable[[], None] = give_up_priority,
) -> Work:
    """Return a case for the sleeper alone and one for the flight, with SCHED_FIFO and then without.

    Afterwards this process and its children may no longer use SCHED_FIFO. Tests pass their own callables.
    """
    options = FlightOptions(stream_for=settings.seconds)
    mission = prepare_mission(settings.path_file, limits_for(settings.path_file), options)
    patiently = replace(mission, limits=patient(mission.limits))

    def measure(case: tuple[str, bool]) -> list[WakeUps]:
        priority, streaming = case
        if priority == ORDINARY:
            give_up()
        elif not permitted():
            return [WakeUps("stream", priority, "not permitted here")] if streaming else []
        with sleeper(RATE, first=priority == FIRST) as asleep:
            if streaming:
                return _streaming(priority, asleep, partial(fly, patiently, Conditions()))
            stolen = _stolen()
            time.sleep(settings.seconds)
            late = asleep.late()
            return [WakeUps.of("asleep, nothing else", priority, late, stolen=_stolen() - stolen)]

    cases = {f"{priority}, {name}": (priority, name == "stream") for priority in (FIRST, ORDINARY)
             for name in ("asleep", "stream")}  # fmt: skip
    return Work(cases, measure, WakeUps)


def tables(settings: Settings, rows: list[WakeUps]) -> Iterator[Table]:
    """Yield a table with one row per kind of wake-up and priority."""
    yield table("lateness", f"Lateness at {RATE:.0f} Hz", COLUMNS, rows)


def _streaming(priority: str, sleeper: Sleeper, fly: Callable[..., RealTimeFlight]) -> list[WakeUps]:
    """Measure the stream of a flight, and a sleeper over the same period."""
    stolen = _stolen()
    flight = fly(name="lateness", view=open_view, on_stream=sleeper.watch)
    if flight.outcome is not None and flight.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR:
        raise KeyboardInterrupt  # the operator's stop ends the study too
    if not flight.sent or flight.outcome is None:
        return [WakeUps("stream", priority, flight.reason)]
    begin, end = flight.sent[0].due, flight.sent[-1].due
    queued, asleep = sleeper.queued(begin, end), sleeper.late(begin, end)
    late, stolen = [message.time - message.due for message in flight.sent], _stolen() - stolen
    stream = WakeUps.of(
        "stream", priority, late, "" if flight.landed else flight.reason, skipped=flight.outcome.lateness.skipped,
        stolen=stolen, view_failure=flight.view_failure,
    )  # fmt: skip
    waiting = [WakeUps.of(QUEUED, priority, queued, stolen=stolen)] if queued else []
    return [stream, *waiting, WakeUps.of("asleep meanwhile", priority, asleep, stolen=stolen)]


@contextlib.contextmanager
def open_view(header: RecordHeader, program: str | None = None) -> Iterator[LiveView]:
    """Open the live view with its own viewer, which ends with it; without a screen the viewer has no window.

    Raises InputError if the viewer does not run.
    """
    port, screen = free_port(), os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    with tempfile.TemporaryDirectory(prefix="cfplan-") as folder:
        command = [
            "nice", "-n", "10", program or str(viewer_program()), "--port", str(port), "--bind", "127.0.0.1",
            "--hide-welcome-screen", *([] if screen else ["--headless"]),
        ]  # fmt: skip
        viewer = subprocess.Popen(
            command,
            env={"XDG_RUNTIME_DIR": folder, **os.environ, "RERUN_ANALYTICS": "false"},
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            time.sleep(_VIEWER_STARTS)
            if viewer.poll() is not None:
                raise InputError(
                    "rerun's viewer ended as soon as it was started, so nothing would be shown meanwhile",
                    hint="it needs a graphics driver, also without a window; Debian's is mesa-vulkan-drivers",
                )
            stream = rr.RecordingStream(APPLICATION)
            stream.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy")
            lay_out(stream, live_blueprint(header))
            with LiveView(stream, header) as view:
                yield view
        finally:
            viewer.kill()
            viewer.wait()


def _stolen() -> float:
    """Return the steal time of this virtual machine so far, s; 0 if the system does not report it."""
    try:
        fields = Path("/proc/stat").read_text(encoding="ascii").splitlines()[0].split()
        return int(fields[8]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return 0.0


STUDY = Study(Settings, work, tables, "flights/figure8.yaml -o results/lateness.json", one_at_a_time=True)
