"""A virtual Vicon: cameras, their faults, and a DataStream server that Vicon's own client accepts.

Nothing in it waits and nothing has a clock of its own: whoever owns it tells it where the bodies are at each moment of
`next_look`, and lets it send with `step` every few milliseconds. `serve` does both from a thread.
"""

import math
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from cfplan.errors import InputError
from cfplan.flight.telemetry import Quaternion, Triple
from cfplan.simulation.virtual_vicon_faults import FaultKind, Faults, Seen, ViconFault
from cfplan.simulation.virtual_vicon_server import Connection, Picture, Shown

_HOST = "127.0.0.1"
_LEVEL: Quaternion = (0.0, 0.0, 0.0, 1.0)
_STEP = 0.001  # s


@dataclass(frozen=True, slots=True)
class ViconSettings:
    """What the virtual Vicon is like."""

    subject: str = "cf1"
    # the vehicle's name
    segment: str = ""
    # of the vehicle's root segment; "" for the subject's own name
    others: tuple[tuple[str, Triple], ...] = ()
    # bodies that stand in the room, and where, m
    rate: float = 100.0
    # Hz
    position_noise: float = 0.001
    # m, standard deviation of each axis
    attitude_noise: float = math.radians(0.2)
    # rad, standard deviation about each axis
    latency: float = 0.010
    # s from the moment of a pose to its leaving; also what the server says about itself
    y_up: bool = False
    spare: bool = False
    # what has not changed is not sent again
    port: int = 0
    # 0 takes a free one
    first_frame: int = 1000
    faults: tuple[ViconFault, ...] = ()
    # from the server's start
    seed: int = 7

    def __post_init__(self) -> None:
        for name in ("rate", "position_noise", "attitude_noise", "latency"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0) or (name == "rate" and not 1 <= value <= 1000):
                raise InputError(f"{name} {value} of the virtual Vicon makes no sense", hint="rate 1 to 1000 Hz")


class VirtualVicon:
    """Cameras and server."""

    def __init__(self, settings: ViconSettings, start: float):
        # start in s on the clock that every other call is on
        self._settings, self._start = settings, start
        self._chance = np.random.default_rng(settings.seed)
        self._faults = Faults()
        for fault in settings.faults:
            self._faults.add(fault, start)
        self._looks = 0
        self._last: Picture | None = None
        self._waiting: deque[tuple[float, Picture]] = deque()
        self._connections: list[Connection] = []
        self._listener: socket.socket | None = None
        self.port = self._listen(settings.port)

    @property
    def next_look(self) -> float:
        """When the cameras look next, s."""
        return self._start + self._looks / self._settings.rate

    def inject(self, fault: ViconFault, now: float) -> None:
        """Let something go wrong; its start counts from now."""
        self._faults.add(fault, now)

    def look(self, time: float, position: Triple, quaternion: Quaternion) -> None:
        """The vehicle is here; see it."""
        settings, faults = self._settings, self._faults
        # Frames that nobody had time to take are counted, and missing.
        self._looks = max(self._looks, round((time - self._start) * settings.rate)) + 1
        if self._last is not None and faults.acting(FaultKind.REPEAT, time):
            self._queue(time, self._last)
            return
        truth = {settings.subject: (position, quaternion), **{name: (place, _LEVEL) for name, place in settings.others}}
        seen = faults.seen(time, {name: self._with_noise(*pose) for name, pose in truth.items()})
        self._queue(time, self._picture(seen, truth))

    def step(self, now: float) -> None:
        """Accept clients, hear them, and send what is due."""
        if self._faults.acting(FaultKind.CLOSE, now):
            self._stop_listening()
        elif self._listener is None:
            self._listen(self.port)
        self._accept()
        for connection in self._connections:
            connection.read()
        while self._waiting and self._waiting[0][0] <= now:
            _, picture = self._waiting.popleft()
            for connection in self._connections:
                connection.show(picture)
        for connection in [each for each in self._connections if not each.alive]:
            connection.close()
            self._connections.remove(connection)

    def close(self) -> None:
        """End; may be called twice."""
        self._stop_listening()

    def _queue(self, time: float, picture: Picture) -> None:
        self._last = picture
        if self._faults.acting(FaultKind.STALL, time):
            return
        delay = self._faults.acting(FaultKind.DELAY, time)
        due = time + self._settings.latency + (delay.strength if delay else 0.0)
        if self._waiting:
            due = max(due, self._waiting[-1][0])  # nothing overtakes in a stream
        self._waiting.append((due, picture))

    def _picture(self, seen: Mapping[str, Seen], truth: Mapping[str, Seen]) -> Picture:
        settings = self._settings
        bodies = tuple(
            Shown(name, (settings.segment or name) if name == settings.subject else name, seen.get(name))
            for name in truth
        )
        number = settings.first_frame + self._looks - 1
        return Picture(number, settings.rate, settings.latency, settings.y_up, bodies)

    def _with_noise(self, position: Triple, quaternion: Quaternion) -> Seen:
        settings = self._settings
        if not (settings.position_noise or settings.attitude_noise):
            return position, quaternion
        off = self._chance.normal(0, settings.position_noise, 3)
        a, b, c = self._chance.normal(0, settings.attitude_noise / 2, 3)
        (px, py, pz), (x, y, z, w) = position, quaternion
        turned = (
            x + w * a + y * c - z * b,
            y + w * b - x * c + z * a,
            z + w * c + x * b - y * a,
            w - x * a - y * b - z * c,
        )
        norm = math.hypot(*turned)
        qx, qy, qz, qw = (float(value / norm) for value in turned)
        return (px + float(off[0]), py + float(off[1]), pz + float(off[2])), (qx, qy, qz, qw)

    # The listening socket.

    def _listen(self, port: int) -> int:
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((_HOST, port))
        except OSError as why:
            listener.close()
            raise InputError(
                f"port {port} cannot be had: {why.strerror}", where="virtual Vicon", hint="port 0 takes a free one"
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
        """No new connections, and the old ones reset."""
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
) -> Iterator["Served"]:
    """A virtual Vicon in a thread; `pose` gives the vehicle's at a time in s since the start."""
    served = Served(settings or ViconSettings(), pose)
    thread = threading.Thread(target=served.run, name="virtual vicon", daemon=True)
    thread.start()
    try:
        yield served
    finally:
        served.ended.set()
        thread.join()
        served.vicon.close()


class Served:
    """A virtual Vicon that runs in a thread."""

    def __init__(self, settings: ViconSettings, pose: Callable[[float], Seen]):
        self.start = time.monotonic()
        self.vicon = VirtualVicon(settings, self.start)
        self.settings, self._pose = settings, pose
        self.ended = threading.Event()
        self._injected: deque[ViconFault] = deque()

    @property
    def uri(self) -> str:
        """Of its vehicle."""
        return self.uri_of(self.settings.subject)

    def uri_of(self, subject: str, system: str = "vicon") -> str:
        """Of any body, through any client."""
        return f"{system}://{_HOST}:{self.vicon.port}/{subject}"

    def inject(self, fault: ViconFault) -> None:
        """Let something go wrong; its start counts from now."""
        self._injected.append(fault)

    def run(self) -> None:
        """Until ended."""
        vicon = self.vicon
        while not self.ended.wait(_STEP):
            now = time.monotonic()
            while self._injected:
                vicon.inject(self._injected.popleft(), now)
            while vicon.next_look <= now:
                at = vicon.next_look
                vicon.look(at, *self._pose(at - self.start))
            vicon.step(now)
