"""The watchers of a flight besides its record: a live view in rerun and a ground station."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cfplan.flight.pilot.keys import Order
    from cfplan.flight.telemetry import Telemetry
    from cfplan.recording.header import RecordHeader
    from cfplan.recording.mavlink.bridge import GroundStation
    from cfplan.recording.rerun.live import LiveView

TLOG_FILE = "telemetry.tlog"


@dataclass(frozen=True, slots=True)
class Watching:
    """The open watchers of a flight."""

    view: "LiveView | None"
    station: "GroundStation | None"

    @property
    def listeners(self) -> "list[Callable[[Telemetry], None]]":
        """Return the listeners for every message."""
        return [watcher.show for watcher in (self.view, self.station) if watcher is not None]

    def orders(self) -> "Sequence[Order]":
        """Return the ground station's commands since the last call."""
        return self.station.orders() if self.station is not None else ()

    def failures(self) -> list[str]:
        """Return the failures of watchers; none of them affects the flight."""
        return [watcher.failure for watcher in (self.view, self.station) if watcher is not None and watcher.failure]


@dataclass(frozen=True, slots=True)
class Watched:
    """The requested watchers."""

    live: bool  # a live view in rerun
    mavlink: str | None  # address of a ground station, e.g. udp:127.0.0.1:14550


def check_watchers(watched: Watched) -> None:
    """Raise InputError, before anything is planned, if a watcher is not available."""
    if watched.live:
        from cfplan.recording.rerun.viewer import require_screen

        require_screen("leave out --live; `cfplan replay` shows the record afterwards")
    if watched.mavlink is not None:
        from cfplan.recording.mavlink.bridge import check_place

        check_place(watched.mavlink)


@contextlib.contextmanager
def watchers(header: "RecordHeader", folder: Path, watched: Watched) -> Iterator[Watching]:
    """Open the requested watchers while the block lasts; the .tlog is written to the record's folder."""
    with contextlib.ExitStack() as stack:
        view = station = None
        if watched.live:
            from cfplan.recording.rerun.live import open_live

            view = stack.enter_context(open_live(header, folder))
        if watched.mavlink is not None:
            from cfplan.recording.mavlink.bridge import GroundStation, parse_place

            station = stack.enter_context(GroundStation(parse_place(watched.mavlink), folder / TLOG_FILE))
        yield Watching(view, station)
