"""Show a flight in rerun as it happens, from the main process's telemetry; the pilot's process takes no part.

Messages are only put into a queue; ten times a second a thread sends the queued ones as columns. The viewer is a
separate process at a low priority: the setpoints come first.
"""

import contextlib
import subprocess
from collections import deque
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import rerun as rr
import rerun.blueprint as rrb

from cfplan.flight.clock import REAL_CLOCK, Clock, Repeated
from cfplan.flight.telemetry import PoseReceived, SetpointSent, Telemetry, VehicleStatus
from cfplan.recording.header import RecordHeader
from cfplan.recording.plots import FLOWN, WANTED, plots
from cfplan.recording.record import Record
from cfplan.recording.rerun import layout
from cfplan.recording.rerun.plan_view import log_plan
from cfplan.recording.rerun.record_view import (
    TRACK_RADIUS,
    log_columns,
    log_limits,
    log_outline,
    log_room,
    log_styles,
    log_tail,
)
from cfplan.recording.rerun.viewer import APPLICATION, free_port, lay_out, require_screen, viewer_program
from cfplan.recording.summary import reference_times
from cfplan.recording.topics import TOPICS, columns_of

PERIOD = 0.1  # s between batches
CAPACITY = 50_000  # messages that wait at most; more are left out of the view, never of the record
# Of these the last of a batch begins the next, so that lines have no gaps.
_CARRIED = (SetpointSent, PoseReceived, VehicleStatus)
_CLOSE_TIMEOUT = 3.0  # s


def open_live(header: RecordHeader, folder: Path) -> "LiveView":
    """Open a viewer's window on a flight whose plan lies in the record's folder.

    Raises InputError where there is no screen.
    """
    require_screen("leave out --live; `cfplan replay` shows the record afterwards")
    port = free_port()
    subprocess.Popen(
        [
            "nice", "-n", "10", str(viewer_program()), "--port", str(port), "--bind", "127.0.0.1",
            "--hide-welcome-screen",
        ],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    stream = rr.RecordingStream(APPLICATION)
    stream.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy")
    lay_out(stream, live_blueprint(header))
    return LiveView(stream, header, folder)


def live_blueprint(header: RecordHeader) -> rrb.Blueprint:
    """Return a replay's layout, with the time following."""
    return layout.blueprint(header, play_state="following")


class LiveView:
    """Sends a flight to a stream while it is entered; `show` takes a message and returns at once."""

    def __init__(
        self, stream: rr.RecordingStream, header: RecordHeader, folder: Path = Path(), clock: Clock = REAL_CLOCK
    ):
        self._stream, self._header, self._folder, self._clock = stream, header, folder, clock
        self._waiting: deque[Telemetry] = deque(maxlen=CAPACITY)
        self._start: float | None = None  # s, of the first message: 0 on the timeline
        self._carried: dict[type, Telemetry] = {}
        self._drawn: set[str] = set()  # outlines drawn so far
        self.failure = ""  # why the view ends early, one line
        self._laid_out = False
        self._sending: Repeated | None = None

    def __enter__(self) -> "LiveView":
        self._sending = self._clock.repeat(self._show_waiting, name="live view", last=self._end)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._sending is not None:
            self._sending.stop(_CLOSE_TIMEOUT)

    def show(self, message: Telemetry) -> None:
        """Take a message."""
        self._waiting.append(message)

    def _show_waiting(self) -> float | None:
        try:
            if not self._laid_out:
                self._lay_out()
            self._send()
        except Exception as error:  # a closed viewer must not affect the flight
            self.failure = f"the live view ended: {error}"
            return None
        return PERIOD

    def _end(self) -> None:
        if not self.failure and self._show_waiting() is not None:
            with contextlib.suppress(Exception):
                self._stream.flush(timeout_sec=_CLOSE_TIMEOUT / 2)
        with contextlib.suppress(Exception):
            self._stream.disconnect()

    def _lay_out(self) -> None:
        """Send the entities that do not change during the flight."""
        empty = _part(self._header, [])
        self._stream.send_recording_name(self._header.name)
        log_room(self._stream, self._header)
        log_styles(self._stream, plots(empty))
        log_plan(self._stream, replace(empty, folder=self._folder))
        self._laid_out = True

    def _send(self) -> None:
        fresh: list[Telemetry] = []
        while self._waiting:
            fresh.append(self._waiting.popleft())
        if not fresh:
            return
        ends = [max(message.time for message in fresh)]
        if self._start is None:
            self._start = min(message.time for message in fresh)
            ends.insert(0, self._start)
        part = _part(self._header, [*self._carried.values(), *fresh])
        self._carried |= {type(message): message for message in fresh if isinstance(message, _CARRIED)}
        shown = plots(part)
        log_columns(self._stream, part, shown, self._start)
        log_limits(self._stream, shown, [end - self._start for end in ends])
        poses = part.poses
        log_tail(self._stream, layout.FLOWN, poses.time - self._start, poses.position, FLOWN, TRACK_RADIUS)
        wanted = reference_times(part.setpoints)
        for entity, times, colour in ((layout.BODY, poses.time, FLOWN), (layout.GHOST, wanted, WANTED)):
            if len(times) and entity not in self._drawn:
                self._drawn.add(entity)
                log_outline(self._stream, entity, self._header.vehicle.arm, times[:1] - self._start, colour)


def _part(header: RecordHeader, messages: list[Telemetry]) -> Record:
    """Return some messages of a flight as a record."""
    streams = {
        topic.stream: columns_of(topic, [message for message in messages if type(message) is topic.message])
        for topic in TOPICS
    }
    return Record(folder=Path(), header=header, summary={}, truncated=False, **streams)
