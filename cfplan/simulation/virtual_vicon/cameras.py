"""The cameras of the virtual Vicon: they turn the bodies' poses into frames, with noise, latency and faults.

Nothing here waits or reads a clock: the owner says where the vehicle is at each `next_look`.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.flight.telemetry import Quaternion, Triple
from cfplan.simulation.virtual_vicon.faults import FaultKind, Faults, Seen, ViconFault
from cfplan.simulation.virtual_vicon.server import Picture, Shown

_LEVEL: Quaternion = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class ViconSettings:
    """Settings of the virtual Vicon."""

    subject: str = "cf1"  # the vehicle's name
    segment: str = ""  # of the vehicle's root segment; "" for the subject's own name
    others: tuple[tuple[str, Triple], ...] = ()  # bodies that stand in the room, and where, m
    rate: float = 100.0  # Hz
    position_noise: float = 0.001  # m, standard deviation of each axis
    attitude_noise: float = math.radians(0.2)  # rad, standard deviation about each axis
    latency: float = 0.010  # s from the moment of a pose to its transmission
    announced_latency: float | None = None  # s, as reported by the server; None: the true one
    origin: Triple = (0.0, 0.0, 0.0)  # m, of the markers' body, from the vehicle's centre of mass in body axes
    mounting: Triple = (0.0, 0.0, 0.0)  # rad, rotation vector that turns the vehicle's axes into the markers' body's
    y_up: bool = False
    spare: bool = False  # omit data that has not changed
    port: int = 0  # 0 takes a free one
    first_frame: int = 1000
    faults: tuple[ViconFault, ...] = ()  # from the server's start
    seed: int = 7

    def __post_init__(self) -> None:
        announced = self.latency if self.announced_latency is None else self.announced_latency
        for name, value in (
            ("rate", self.rate),
            ("position_noise", self.position_noise),
            ("attitude_noise", self.attitude_noise),
            ("latency", self.latency),
            ("announced_latency", announced),
        ):
            if not (math.isfinite(value) and value >= 0) or (name == "rate" and not 1 <= value <= 1000):
                raise InputError(
                    f"{name} {value} of the virtual Vicon is out of range",
                    hint="rate 1 to 1000 Hz, the others at least 0",
                )


class Cameras:
    """See the bodies, and hold each picture back until it is due.

    `start`, s, is on the clock of every other call.
    """

    def __init__(self, settings: ViconSettings, start: float):
        self._settings, self._start = settings, start
        self._chance = np.random.default_rng(settings.seed)
        self._mounting = Rotation.from_rotvec(settings.mounting) if any(settings.mounting) else None
        self._faults = Faults()
        for fault in settings.faults:
            self._faults.add(fault, start)
        self._looks = 0
        self.next_look = start  # s, when the cameras look next
        self._last: Picture | None = None
        self._waiting: deque[tuple[float, Picture]] = deque()

    @property
    def next_due(self) -> float:
        """When the next picture leaves, s; infinity if none waits."""
        return self._waiting[0][0] if self._waiting else math.inf

    @property
    def disturbed(self) -> bool:
        """Return whether there ever was a fault, or one is to come."""
        return bool(self._faults.all)

    def inject(self, fault: ViconFault, now: float) -> None:
        """Add a fault; its start counts from now."""
        self._faults.add(fault, now)

    def heal(self, now: float) -> None:
        """End all faults."""
        self._faults.end(now)

    def look(
        self, time: float, position: Triple, quaternion: Quaternion, moving: Mapping[str, Seen] | None = None
    ) -> None:
        """See the vehicle, and other bodies that move, where they are at a time, s."""
        settings, faults = self._settings, self._faults
        # Frames that the owner had no time to take are counted, and missing.
        self._looks = max(self._looks, round((time - self._start) * settings.rate)) + 1
        self.next_look = self._start + self._looks / settings.rate
        if self._last is not None and faults.acting(FaultKind.REPEAT, time):
            self._queue(time, self._last)
            return
        markers = self._markers(position, quaternion)
        standing = {name: (place, _LEVEL) for name, place in settings.others}
        truth = {settings.subject: markers, **(moving or {}), **standing}
        seen = faults.seen(time, {name: self._with_noise(*pose) for name, pose in truth.items()})
        self._queue(time, self._picture(seen, truth))

    def cut_off(self, now: float) -> bool:
        """Return whether no connection is possible now."""
        return self._faults.acting(FaultKind.CLOSE, now) is not None

    def due(self, now: float) -> list[Picture]:
        """Return the pictures that leave by now."""
        found = []
        while self._waiting and self._waiting[0][0] <= now:
            found.append(self._waiting.popleft()[1])
        return found

    def _markers(self, position: Triple, quaternion: Quaternion) -> Seen:
        """Return the pose of the markers' body on a vehicle with this pose."""
        if self._mounting is None and not any(self._settings.origin):
            return position, quaternion
        attitude = Rotation.from_quat(quaternion)
        x, y, z = (np.array(position) + attitude.apply(self._settings.origin)).tolist()
        qx, qy, qz, qw = (attitude * self._mounting if self._mounting is not None else attitude).as_quat().tolist()
        return (x, y, z), (qx, qy, qz, qw)

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
        announced = settings.latency if settings.announced_latency is None else settings.announced_latency
        return Picture(number, settings.rate, announced, settings.y_up, bodies)

    def _with_noise(self, position: Triple, quaternion: Quaternion) -> Seen:
        settings = self._settings
        if not (settings.position_noise or settings.attitude_noise):
            return position, quaternion
        drawn = self._chance.standard_normal(6).tolist()
        east, north, up = (settings.position_noise * share for share in drawn[:3])
        a, b, c = (settings.attitude_noise / 2 * share for share in drawn[3:])
        (px, py, pz), (x, y, z, w) = position, quaternion
        turned = (
            x + w * a + y * c - z * b,
            y + w * b - x * c + z * a,
            z + w * c + x * b - y * a,
            w - x * a - y * b - z * c,
        )
        norm = math.hypot(*turned)
        qx, qy, qz, qw = (value / norm for value in turned)
        return (px + east, py + north, pz + up), (qx, qy, qz, qw)
