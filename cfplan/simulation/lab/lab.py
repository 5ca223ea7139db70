"""The virtual lab in its own process: a virtual Crazyflie and a room with motion capture, in real time.

The lab speaks CRTP over UDP on the loopback, one datagram a packet, as cflib's own UDP driver does; poses come from the
room's virtual Vicon. More vehicles may be in the room, each with a port of its own; the air beneath one pushes others
down, but they do not collide. The lab ends with the process that started it.

A lab announces its address in the environment variable CFPLAN_SIM_n, because `sim://n` alone must find it: cflib makes
its link drivers itself, from nothing but the URI, in the pilot's process and in users' scripts.
"""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError, LinkError
from cfplan.simulation.lab.radio import RadioFault
from cfplan.simulation.lab.room import RoomSettings, lab_variable
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.faults import ViconFault
from cfplan.vehicle.airframe import Airframe

TRUTH, LATEST, CLOSE = "truth", "latest", "close"
Fault = VehicleFault | RadioFault | ViconFault
_START_TIMEOUT = 180.0  # s; the first start on a machine compiles
_ANSWER_TIMEOUT = 10.0  # s
_CLOSE_TIMEOUT = 3.0  # s

# Columns of the lab's record of the truth, 100 rows a second.
TIME, STATE, MOTORS, OFF_IN_AIR, SUPERVISOR = 0, slice(1, 18), slice(18, 22), 22, 23
ROW_SIZE = 24


@dataclass(frozen=True, slots=True)
class Truth:
    """The true motion: for tests and reports, never for a pilot. One row every 10 ms."""

    time: NDArray  # (N,) s on the flight's clock
    position: NDArray  # (N, 3) m
    velocity: NDArray  # (N, 3) m/s
    quaternion: NDArray  # (N, 4) body→world x y z w
    body_rate: NDArray  # (N, 3) rad/s
    motor: NDArray  # (N, 4) 16-bit commands
    off_in_air: NDArray  # (N,) ticks of 1 ms, so far, with all motors off well above the floor
    supervisor: NDArray  # (N,) the supervisor's state
    locked: bool  # whether the supervisor was ever locked

    @staticmethod
    def of(rows: NDArray, locked: bool) -> "Truth":
        """Return the truth of rows as the lab records them."""
        state = rows[:, STATE]
        return Truth(
            time=rows[:, TIME],
            position=state[:, 0:3],
            velocity=state[:, 3:6],
            quaternion=state[:, 6:10],
            body_rate=state[:, 10:13],
            motor=rows[:, MOTORS],
            off_in_air=rows[:, OFF_IN_AIR],
            supervisor=rows[:, SUPERVISOR].astype(int),
            locked=locked,
        )


class Lab:
    """A running lab; a context manager. `start_lab` makes it."""

    def __init__(
        self,
        process: subprocess.Popen,
        connection: Connection,
        number: int,
        ports: tuple[int, ...],
        mocap_uri: str = "",
    ):
        self.number = number
        self.uri = f"sim://{number}"
        self.ports = ports  # of the vehicle, and of each other one in its room
        self.port = ports[0]
        self.mocap_uri = mocap_uri  # of the vehicle in the virtual Vicon; "" where poses are on board
        self._process = process
        self._connection = connection
        self._address = f"127.0.0.1:{self.port}"
        self._hidden = os.environ.get(lab_variable(number))
        os.environ[lab_variable(number)] = self._address

    @property
    def process_id(self) -> int:
        return self._process.pid

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def truth(self, vehicle: int = 0) -> Truth:
        """Return the truth of a vehicle so far; for tests and reports. Raises LinkError if the lab has died."""
        return self._ask(TRUTH, vehicle)

    def latest(self, vehicle: int = 0) -> Truth:
        """Return the last row of the truth."""
        return self._ask(LATEST, vehicle)

    def _ask(self, request: str, vehicle: int) -> Truth:
        try:
            self._connection.send((request, vehicle))
            if not self._connection.poll(_ANSWER_TIMEOUT):
                raise LinkError("the lab does not answer", where=self.uri, hint="is the machine overloaded? Try again")
            rows, locked = self._connection.recv()
        except (OSError, EOFError) as why:
            raise LinkError(
                "the lab has died", where=self.uri, hint="try again; a first start compiles for up to a minute"
            ) from why
        return Truth.of(np.frombuffer(rows).reshape(-1, ROW_SIZE), locked)

    def disturb(self, fault: Fault) -> None:
        """Let something go wrong with the vehicle, its radio or the virtual Vicon; its start counts from now."""
        with suppress(OSError):  # the lab has died, which others will notice
            self._connection.send(fault)

    def close(self) -> None:
        """End the lab; may be called twice."""
        with suppress(OSError):  # closed or dead already
            self._connection.send(CLOSE)
        self._connection.close()
        try:
            self._process.wait(_CLOSE_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        name = lab_variable(self.number)
        if os.environ.get(name) == self._address:
            del os.environ[name]
            if self._hidden is not None:
                os.environ[name] = self._hidden

    def __enter__(self) -> "Lab":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class StartingLab:
    """A lab whose process is starting; a context manager that ends it. `launch_lab` makes it."""

    def __init__(self, process: subprocess.Popen, connection: Connection, number: int, room: RoomSettings):
        self._process, self._connection, self._number, self._room = process, connection, number, room
        self._lab: Lab | None = None

    def wait(self) -> Lab:
        """Wait until it runs. Raises LinkError if it does not come up, InputError if its port is taken."""
        try:
            if not self._connection.poll(_START_TIMEOUT):
                raise EOFError
            answer = self._connection.recv()
        except (OSError, EOFError) as why:
            self._process.kill()
            code = self._process.wait()
            raise LinkError(
                f"the virtual lab did not start (exit {code})",
                where=f"sim://{self._number}",
                hint="run `cfplan doctor`",
            ) from why
        if isinstance(answer, CfplanError):
            raise answer
        ports, vicon_port = answer
        mocap_uri = f"vicon://127.0.0.1:{vicon_port}/{self._room.vicon.subject}" if vicon_port is not None else ""
        self._lab = Lab(self._process, self._connection, self._number, ports, mocap_uri)
        return self._lab

    def close(self) -> None:
        """End it, whether it runs or not; may be called twice."""
        if self._lab is not None:
            self._lab.close()
        else:
            self._process.kill()
            self._process.wait()
            self._connection.close()

    def __enter__(self) -> "StartingLab":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def launch_lab(
    airframe: Airframe,
    *,
    vehicle: VehicleSettings | None = None,
    companions: Mapping[str, VehicleSettings] | None = None,
    room: RoomSettings | None = None,
    number: int = 0,
    port: int = 0,
) -> StartingLab:
    """Launch the process of a lab, as for `start_lab`, and return at once."""
    room = room or RoomSettings()
    ours, theirs = socket.socketpair()
    unblocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # Ctrl-C is the pilot's to handle
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-m", "cfplan.simulation.lab.process", str(theirs.fileno())],
            pass_fds=(theirs.fileno(),),
            stdin=subprocess.DEVNULL,
        )
    signal.pthread_sigmask(signal.SIG_SETMASK, unblocked)
    connection = Connection(ours.detach())
    with suppress(OSError):  # it has died, which waiting for it notices
        connection.send((airframe, vehicle or VehicleSettings(), dict(companions or {}), room, port))
    return StartingLab(process, connection, number, room)


def start_lab(
    airframe: Airframe,
    *,
    vehicle: VehicleSettings | None = None,
    companions: Mapping[str, VehicleSettings] | None = None,
    room: RoomSettings | None = None,
    number: int = 0,
    port: int = 0,
) -> Lab:
    """Start a lab with a vehicle of this airframe as `sim://number`, and as `udp://127.0.0.1:port`; 0 takes a free one.

    `companions` are more of them in its room, by their names in its virtual Vicon; their ports follow. Raises LinkError
    if the lab does not start, InputError if a port that it needs is taken.

    A lab that had that number is hidden until this one is closed. A plain child process rather than one of
    multiprocessing's, so that it can be started from a daemonic process and from a script without a main guard.
    """
    starting = launch_lab(airframe, vehicle=vehicle, companions=companions, room=room, number=number, port=port)
    return starting.wait()
