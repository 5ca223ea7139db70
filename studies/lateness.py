"""Measure how late setpoints are sent while everything else runs, and how late this computer wakes a sleeper.

Each flight is one of the real pilot in the virtual lab, with Vicon's protocol, a record and a live view, all on this
computer. Before it and meanwhile, a process that only sleeps until deadlines shows what the computer itself adds.
"""

import contextlib
import ctypes
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from cfplan.errors import ExitCode, InputError
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.real_time import may_use_fifo_scheduling
from cfplan.flight.setpoints.encoding import RATE
from cfplan.preparation.plan_flight import FlightOptions
from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.recording.header import RecordHeader
from cfplan.recording.rerun.live import LiveView, live_blueprint
from cfplan.recording.rerun.viewer import APPLICATION, free_port, lay_out, viewer_program
from cfplan.safety.limits_file import load_limits
from studies.real_time import Conditions, fly_in_real_time
from studies.runner.result import Column, StudyResult, Table
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
    Column("reason"),
    Column("refusals"),
    Column("view_failure"),
)  # fmt: skip
FIRST, ORDINARY = "SCHED_FIFO", "ordinary"
QUEUED = "stream, of that waiting for a processor"  # behind other programs, per period, as the system counts it
_DROP_CAPABILITY, _NICE_CAPABILITY = 24, 23  # PR_CAPBSET_DROP, CAP_SYS_NICE
_VIEWER_STARTS = 2.0  # s


@dataclass(frozen=True, slots=True)
class WakeUps:
    """How late one kind of waking was."""

    what: str
    priority: str
    reason: str  # why there is no measurement, or why it is short; "" where all went well
    seconds: float = 0.0
    p50: float = 0.0  # s, as p99, p999 and max
    p99: float = 0.0
    p999: float = 0.0
    max: float = 0.0
    count: int = 0
    above: int = 0  # by more than 1 ms
    skipped: int = 0  # deadlines that passed altogether
    stolen: float = 0.0  # s that the host took from this virtual machine meanwhile, over all its processors
    refusals: int = 0  # tries before it that preflight refused for lateness
    view_failure: str = ""  # why the live view ended early

    @staticmethod
    def of(what: str, priority: str, late: Sequence[float], reason: str = "", **others: Any) -> "WakeUps":
        """Return the percentiles of the s by which each was late."""
        p50, p99, p999 = np.percentile(late, [50, 99, 99.9])
        above = int(np.sum(np.array(late) > 1e-3))
        return WakeUps(
            what, priority, reason, len(late) / RATE, float(p50), float(p99), float(p999), float(np.max(late)),
            len(late), above, **others,
        )  # fmt: skip

    def row(self) -> dict[str, Any]:
        """Return it by the keys of COLUMNS, with the fields that those are made of."""
        row = asdict(self) | {"remark": "; ".join(filter(None, (self.reason, self.view_failure)))}
        return row if self.count else row | dict.fromkeys(("seconds", "p50", "p99", "p999", "max", "above"), np.nan)


def lateness_study(
    path_file: Path,
    safety_file: Path,
    seconds: float,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Measure with and without SCHED_FIFO. Afterwards this process and its children may not use it any more."""
    options = FlightOptions(stream_for=seconds)
    mission = _patient(prepare_mission(path_file, load_limits(safety_file), options))
    rows: list[WakeUps] = []
    with contextlib.suppress(KeyboardInterrupt):
        for step, priority in enumerate((FIRST, ORDINARY)):
            if priority == ORDINARY:
                give_up_priority()
            elif not may_use_fifo_scheduling():
                rows.append(WakeUps("stream", priority, "not permitted here"))
                continue
            progress(2 * step, 4)
            rows.append(_asleep(priority, seconds))
            progress(2 * step + 1, 4)
            rows += _streaming(priority, mission)
        progress(4, 4)
    settings = {"path": path_file.stem, "seconds": seconds, "window": _has_screen()}
    return StudyResult("lateness", settings, (lateness_table(rows),))


def lateness_table(measured: Sequence[WakeUps]) -> Table:
    """Return one row for each kind of waking and each priority."""
    return Table("lateness", f"Lateness at {RATE:.0f} Hz", COLUMNS, tuple(one.row() for one in measured))


def give_up_priority() -> None:
    """Give up the permission to use SCHED_FIFO, for this process and its children."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_DROP_CAPABILITY, _NICE_CAPABILITY, 0, 0, 0)


def _patient(mission: Mission) -> Mission:
    """Return the same mission, not refused or ended by the lateness that is measured."""
    pose = replace(mission.limits.pose, age_warning=0.15, age_brake=0.5, age_land=1.5)
    return replace(mission, limits=replace(mission.limits, pose=pose, lateness=1.0))


def _asleep(priority: str, seconds: float) -> WakeUps:
    """Measure a sleeper alone."""
    stolen = _stolen()
    with Sleeper(RATE, first=priority == FIRST) as sleeper:
        time.sleep(seconds)
        return WakeUps.of("asleep, nothing else", priority, sleeper.late(), stolen=_stolen() - stolen)


def _streaming(priority: str, mission: Mission) -> list[WakeUps]:
    """Measure the stream of a flight, and a sleeper over the same seconds."""
    stolen = _stolen()
    with Sleeper(RATE, first=priority == FIRST) as sleeper:
        flight = fly_in_real_time(mission, Conditions(vicon=True), name="lateness", view=_view, on_stream=sleeper.watch)
        if flight.outcome is not None and flight.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR:
            raise KeyboardInterrupt  # who ends the flight ends the study
        if not flight.sent or flight.outcome is None:
            return [WakeUps("stream", priority, flight.reason, refusals=flight.refusals)]
        begin, end = flight.sent[0].due, flight.sent[-1].due
        queued, asleep = sleeper.queued(begin, end), sleeper.late(begin, end)
    late = [message.time - message.due for message in flight.sent]
    reason, stolen = "" if flight.landed else flight.reason, _stolen() - stolen
    return [
        WakeUps.of(
            "stream",
            priority,
            late,
            reason,
            skipped=flight.outcome.lateness.skipped,
            stolen=stolen,
            refusals=flight.refusals,
            view_failure=flight.view_failure,
        ),
        *([WakeUps.of(QUEUED, priority, queued, stolen=stolen)] if queued else []),
        WakeUps.of("asleep meanwhile", priority, asleep, stolen=stolen),
    ]


@contextlib.contextmanager
def _view(header: RecordHeader) -> Iterator[LiveView]:
    """Open the live view with its own viewer, which ends with it; without a screen, one without a window."""
    port = free_port()
    with tempfile.TemporaryDirectory(prefix="cfplan-") as folder:
        command = [
            "nice", "-n", "10", str(viewer_program()), "--port", str(port), "--bind", "127.0.0.1",
            "--hide-welcome-screen", *([] if _has_screen() else ["--headless"]),
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


def _has_screen() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _stolen() -> float:
    """Return s so far in which the host of this virtual machine ran something else; 0 where the system does not say."""
    try:
        fields = Path("/proc/stat").read_text(encoding="ascii").splitlines()[0].split()
        return int(fields[8]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return 0.0
