"""A simulated room with motion capture: poses of the vehicle with noise, rate and latency, and their PoseSource.

The poses come over a separate UDP port, next to that of the radio, so that a pilot in another process gets them as it
would from a real system: late and noisy.
"""

import os
import socket
import struct
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError, LinkError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.mocap.poses import Pose
from cfplan.simulation.virtual_vicon.cameras import ViconSettings

SUBSCRIBE, UNSUBSCRIBE = b"\1", b"\0"
SUBSCRIPTION_LASTS = 2.0  # s without a renewal
_RENEW_AFTER = 0.5  # s
_OPEN_TIMEOUT = 4.0  # s
_POSE = struct.Struct("<dI7d")  # time s, number, position m, quaternion x y z w


@dataclass(frozen=True, slots=True)
class RoomSettings:
    """Settings of the room's motion capture."""

    rate: float = 100.0  # Hz
    position_noise: float = 0.001  # m, standard deviation of each axis
    attitude_noise: float = float(np.radians(0.2))  # rad, standard deviation about each axis
    latency: float = 0.010  # s from the moment of a pose to its leaving the room
    seed: int = 7
    on_board: bool = False  # the vehicle has the poses too, as from a positioning deck
    vicon: ViconSettings | None = None  # a virtual Vicon that sees the vehicle too, with its own rate, noise and faults

    def __post_init__(self) -> None:
        for name in ("rate", "position_noise", "attitude_noise", "latency"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0) or (name == "rate" and not 1 <= value <= 1000):
                raise InputError(
                    f"{name} {value} of the simulated room is out of range",
                    hint="rate 1 to 1000 Hz, the others at least 0",
                )


class MotionCapture:
    """Sees the vehicle `rate` times a second, from the tick `begin` on; each pose comes out `latency` later."""

    def __init__(self, settings: RoomSettings, begin: int = 0):
        self._settings = settings
        self._begin = begin
        self._chance = np.random.default_rng(settings.seed)
        self._number = 0
        self._waiting: list[tuple[float, bytes]] = []

    @property
    def next_tick(self) -> int:
        """Return the tick of 1 ms at which the cameras look next."""
        return self._begin + round(self._number * 1000 / self._settings.rate)

    def look(self, time: float, truth: NDArray) -> None:
        """See the vehicle, whose state begins with position and has its quaternion at 6:10."""
        position = truth[0:3] + self._chance.normal(0, self._settings.position_noise, 3)
        quaternion = _turned(truth[6:10], self._chance.normal(0, self._settings.attitude_noise, 3))
        packet = _POSE.pack(time, self._number, *position, *quaternion)
        self._waiting.append((time + self._settings.latency, packet))
        self._number += 1

    @staticmethod
    def measured(packet: bytes) -> tuple[float, ...]:
        """Return position and quaternion of a packet."""
        return _POSE.unpack(packet)[2:]

    def ready(self, time: float) -> list[bytes]:
        """Return the packets that leave the room by now."""
        count = sum(1 for due, _ in self._waiting if due <= time)
        out = [packet for _, packet in self._waiting[:count]]
        del self._waiting[:count]
        return out

    @property
    def next_due(self) -> float:
        """Return when the next packet leaves, s; infinity if none waits."""
        return self._waiting[0][0] if self._waiting else np.inf


def _turned(quaternion: NDArray, angle: NDArray) -> NDArray:
    a, b, c = angle / 2
    x, y, z, w = quaternion
    turned = np.array(
        [x + w * a + y * c - z * b, y + w * b - x * c + z * a, z + w * c + x * b - y * a, w - x * a - y * b - z * c]
    )
    return turned / np.sqrt(turned @ turned)


def lab_address(number: int) -> tuple[str, int] | None:
    """Return the address of the lab of that number, None if there is none. Raises InputError if it is malformed."""
    name = lab_variable(number)
    text = os.environ.get(name)
    if text is None:
        return None
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit():
        raise InputError(f"{text!r} is not host:port", where=name, hint="let a lab set this variable")
    return host, int(port)


def lab_variable(number: int) -> str:
    """Return the environment variable with the address of a lab."""
    return f"CFPLAN_SIM_{number}"


@dataclass(slots=True)
class RoomPoseSource:
    """The poses of the simulated room of a lab; a PoseSource. Can go to another process before it is opened."""

    number: int = 0  # of the lab, as in sim://0
    clock: Clock = REAL_CLOCK
    fault: str = ""
    _socket: socket.socket | None = None
    _first: list[Pose] | None = None
    _renewed: float = 0.0

    def open(self) -> None:
        address = lab_address(self.number)
        if address is None:
            raise LinkError(f"there is no simulated room {self.number}", hint="start a lab first")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((address[0], address[1] + 1))
        self._socket.setblocking(False)
        give_up = self.clock.now() + _OPEN_TIMEOUT
        while self.clock.now() < give_up:
            self._first = self.poses()
            if self._first:
                return
            self.clock.sleep(0.005)
        self.close()
        raise LinkError(f"no pose from the simulated room {self.number}", hint="its lab has ended; start it again")

    def poses(self) -> list[Pose]:
        if self._socket is None:
            return []
        found, self._first = self._first or [], None
        now = self.clock.now()
        try:
            if now - self._renewed > _RENEW_AFTER:
                self._renewed = now
                self._socket.send(SUBSCRIBE)
            while True:
                stamp, _, *pose = _POSE.unpack(self._socket.recv(256))
                found.append(Pose(stamp, now, (pose[0], pose[1], pose[2]), (pose[3], pose[4], pose[5], pose[6])))
        except (BlockingIOError, ConnectionRefusedError):  # nothing more; or the lab has ended
            return found

    def close(self) -> None:
        if self._socket is not None:
            with suppress(OSError):  # the lab has gone before us
                self._socket.send(UNSUBSCRIBE)
            self._socket.close()
            self._socket = None
