"""A virtual Vicon: cameras, their faults, and a DataStream server that Vicon's own client accepts.

Nothing here waits or reads a clock, except `serve`: the owner says where the vehicle is at each `next_look`, and calls
`step` every few milliseconds. `serve` does both, beside everything else.
"""

import socket
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from cfplan.errors import InputError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.telemetry import Quaternion
from cfplan.simulation.virtual_vicon.cameras import Cameras, ViconSettings
from cfplan.simulation.virtual_vicon.faults import Seen, ViconFault
from cfplan.simulation.virtual_vicon.server import Connection

_HOST = "127.0.0.1"
_LEVEL: Quaternion = (0.0, 0.0, 0.0, 1.0)
_STEP = 0.001  # s


class VirtualVicon(Cameras):
    """Cameras and server. `start`, s, is on the clock of every other call."""

    def __init__(self, settings: ViconSettings, start: float):
        super().__init__(settings, start)
        self._connections: list[Connection] = []
        self._listener: socket.socket | None = None
        self.port = self._listen(settings.port)

    def step(self, now: float) -> None:
        """Accept clients, read their requests, and send the pictures that are due."""
        if self.cut_off(now):
            self._stop_listening()
        elif self._listener is None:
            self._listen(self.port)
        self._accept()
        for connection in self._connections:
            connection.read()
        for picture in self.due(now):
            for connection in self._connections:
                connection.show(picture)
        for connection in [each for each in self._connections if not each.alive]:
            connection.close()
            self._connections.remove(connection)

    def close(self) -> None:
        """Close all connections; may be called twice."""
        self._stop_listening()

    def _listen(self, port: int) -> int:
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((_HOST, port))
        except OSError as why:
            listener.close()
            raise InputError(
                f"port {port} is not available: {why.strerror}", where="virtual Vicon", hint="port 0 takes a free one"
            ) from why
        listener.listen()
        listener.setblocking(False)
        self._listener = listener
        return listener.getsockname()[1]

    def _accept(self) -> None:
        while self._listener is not None:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            self._connections.append(Connection(client, spare=self._settings.spare))

    def _stop_listening(self) -> None:
        """Accept no new connections, and reset the old ones."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        for connection in self._connections:
            connection.close(reset=True)
        self._connections.clear()


@contextmanager
def serve(
    settings: ViconSettings | None = None,
    pose: Callable[[float], Seen] = lambda _: ((0.0, 0.0, 0.0), _LEVEL),
    clock: Clock = REAL_CLOCK,
) -> Iterator["Served"]:
    """Run a virtual Vicon; `pose` returns the vehicle's pose at a time, s, since the start."""
    served = Served(settings or ViconSettings(), pose, clock)
    running = clock.repeat(served.step, name="virtual vicon")
    try:
        yield served
    finally:
        running.stop()
        served.vicon.close()


class Served:
    """A virtual Vicon that runs."""

    def __init__(self, settings: ViconSettings, pose: Callable[[float], Seen], clock: Clock):
        self._clock, self.start = clock, clock.now()
        self.vicon = VirtualVicon(settings, self.start)
        self.settings, self._pose = settings, pose
        self._wishes: deque[Callable[[float], None]] = deque()

    @property
    def uri(self) -> str:
        """Return the URI of its vehicle."""
        return self.uri_of(self.settings.subject)

    def uri_of(self, subject: str, system: str = "vicon") -> str:
        """Return the URI of any body, through any client."""
        return f"{system}://{_HOST}:{self.vicon.port}/{subject}"

    def inject(self, fault: ViconFault) -> None:
        """Add a fault; its start counts from now."""
        self._wishes.append(lambda now: self.vicon.inject(fault, now))

    def heal(self) -> None:
        """End all faults."""
        self._wishes.append(self.vicon.heal)

    def step(self) -> float:
        """Look, and send what is due; return s until this is needed again."""
        vicon, now = self.vicon, self._clock.now()
        while self._wishes:
            self._wishes.popleft()(now)
        while vicon.next_look <= now:
            at = vicon.next_look
            vicon.look(at, *self._pose(at - self.start))
        vicon.step(now)
        return _STEP
