"""The lab's process: it runs virtual Crazyflies and their room by a clock, against absolute deadlines."""

import gc
import math
import os
import signal
import socket
import struct
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection

import numpy as np

from cfplan.errors import CfplanError, InputError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.radio.crtp import NULL_PACKET, Port, pack
from cfplan.flight.real_time import lock_memory
from cfplan.simulation.lab.downwash import share_air
from cfplan.simulation.lab.lab import CLOSE, LATEST, MOTORS, OFF_IN_AIR, ROW_SIZE, STATE, SUPERVISOR, TIME
from cfplan.simulation.lab.radio import Radio, RadioFault
from cfplan.simulation.virtual_crazyflie.defaults import KALMAN
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.vehicle import VirtualCrazyflie
from cfplan.simulation.virtual_crazyflie.virtual_firmware import COMMANDER_PERIOD, VirtualFirmware
from cfplan.simulation.virtual_vicon.cameras import Cameras
from cfplan.simulation.virtual_vicon.faults import Seen, ViconFault
from cfplan.simulation.virtual_vicon.vicon import VirtualVicon
from cfplan.vehicle.airframe import Airframe

_WARM_UP = 200  # ms
_RECORD_PERIOD = 10  # ms
_LARGEST_LAG = 0.25  # s of a stall that are caught up with; beyond, simulated time is lost
_SILENCE = 2.0  # s after which a client has gone
_LARGEST_DATAGRAM = 64
EXTERNAL_POSE = b"\x08"

_Address = tuple[str, int]


class Recorder:
    """The truth, a row every 10 ms, in an array that doubles."""

    def __init__(self) -> None:
        self._rows = np.empty((6000, ROW_SIZE))
        self._count = 0

    def note(self, time: float, vehicle: VirtualCrazyflie) -> None:
        """Write a row."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
        row = self._rows[self._count]
        row[TIME], row[STATE], row[MOTORS] = time, vehicle.truth, vehicle.motors
        row[OFF_IN_AIR], row[SUPERVISOR] = vehicle.off_in_air, vehicle.supervisor_state
        self._count += 1

    def rows(self, first: int = 0) -> bytes:
        """Return all rows, or those from `first` on; negative numbers count from the end."""
        return self._rows[: self._count][first:].tobytes()


class LabLoop:
    """A vehicle and its socket on one clock; that of the first vehicle has the room's cameras and the other loops."""

    def __init__(
        self,
        airframe: Airframe,
        vehicle: VehicleSettings,
        *,
        on_board: bool = False,
        port: int = 0,
        clock: Clock = REAL_CLOCK,
    ):
        self.companions: Mapping[str, LabLoop] = {}  # by the names that the cameras have for them
        self.cameras: Cameras | None = None  # a VirtualVicon serves their pictures; others go on board
        if on_board:  # the filter that takes poses, as a positioning deck has it chosen at each start
            vehicle = replace(vehicle, stored={"stabilizer.estimator": KALMAN, **vehicle.stored})
        self.vehicle = VirtualCrazyflie(airframe, vehicle)
        # ms between the moments at which it may send by itself; another firmware may do so at any
        self._sends = COMMANDER_PERIOD if isinstance(self.vehicle.firmware, VirtualFirmware) else 1
        self._clock = clock
        self._seed = vehicle.seed
        self._warm_up()
        self.record = Recorder()
        self.link = _socket_at(port)
        self.port: int = self.link.getsockname()[1]
        self._client: _Address | None = None
        self._heard = 0.0
        self._origin = math.nan  # s, when the vehicle's tick 0 was
        self._radio: Radio | None = None  # None while the link is perfect

    def _warm_up(self) -> None:
        """Compile, and let the supervisor pass its checks, before a client connects."""
        self.vehicle.advance(_WARM_UP)
        self.vehicle.sent()

    def run(self, control: Connection) -> None:
        """Run until told to end, or until the parent process has ended."""
        parent, loops = os.getppid(), self.loops
        sources = [*(loop.link.fileno() for loop in loops), control.fileno()]
        self.serve()
        while os.getppid() == parent:
            readable = self._clock.readable(sources, min(loop.until_due() for loop in loops))
            self.serve()
            if control.fileno() in readable and not self._obey(control):
                return

    @property
    def loops(self) -> tuple["LabLoop", ...]:
        """Return the loops of all vehicles in the room, this one first."""
        return self, *self.companions.values()

    def serve(self) -> None:
        """Advance all vehicles in the room to the present, and serve the cameras and sockets."""
        # All advance to the same time: one that is farther would be ahead of the others when the cameras look next.
        now = self._clock.now()
        for loop in self.loops:
            loop._serve_until(now)

    def _serve_until(self, now: float) -> None:
        if math.isnan(self._origin):
            self._origin = now - self.vehicle.tick / 1000
        self._catch_up(now)
        self._read_link()

    def until_due(self) -> float:
        """Return s until this loop must be served again, unless a packet comes sooner."""
        return max(0.0, self._due() - self._clock.now())

    def _due(self) -> float:
        """Return when, s, something visible outside is due next."""
        tick = self.vehicle.tick
        if self._radio is not None and self._radio.busy:
            return self._origin + (tick + 1) / 1000
        boundary = -(-tick // self._sends) * self._sends
        after = min(boundary, self._next_look()) + 1
        return min(self._origin + after / 1000, self.cameras.next_due if self.cameras is not None else math.inf)

    def _next_look(self) -> float:
        """Return the tick at which the cameras look next; infinity without cameras."""
        if self.cameras is None:
            return math.inf
        return max(self.vehicle.tick, math.ceil((self.cameras.next_look - self._origin) * 1000))

    def _catch_up(self, now: float) -> None:
        if now - self._origin - self.vehicle.tick / 1000 > _LARGEST_LAG:
            self._origin = now - self.vehicle.tick / 1000
        self._run_to(int((now - self._origin) * 1000))
        self._send_out(now)

    def pose_at(self, now: float) -> Seen:
        """Return where the vehicle is at a time, s, to which it is advanced where that is due."""
        if not math.isnan(self._origin):
            self._run_to(int((now - self._origin) * 1000))
        truth = self.vehicle.truth.tolist()
        return (truth[0], truth[1], truth[2]), (truth[6], truth[7], truth[8], truth[9])

    def _run_to(self, target: int) -> None:
        while self.vehicle.tick < target:
            tick = self.vehicle.tick
            self._look(self._origin + tick / 1000)
            if tick % _RECORD_PERIOD == 0:
                if self.companions:
                    share_air([loop.vehicle for loop in self.loops])
                self.record.note(self._origin + tick / 1000, self.vehicle)
            stop = min(target, tick + _RECORD_PERIOD - tick % _RECORD_PERIOD, max(self._next_look(), tick + 1))
            self.vehicle.advance(int(stop) - tick)

    def _look(self, now: float) -> None:
        """Let the cameras see the vehicles when it is due."""
        if self.cameras is not None and now >= self.cameras.next_look:
            truth = self.vehicle.truth.tolist()
            others = {name: loop.pose_at(now) for name, loop in self.companions.items()}
            self.cameras.look(now, (truth[0], truth[1], truth[2]), (truth[6], truth[7], truth[8], truth[9]), others)

    def _show_pictures(self, now: float) -> None:
        """Let the virtual Vicon serve, or give each vehicle its pose on board."""
        if isinstance(self.cameras, VirtualVicon):
            self.cameras.step(now)
        elif self.cameras is not None:
            for picture in self.cameras.due(now):
                for loop, body in zip(self.loops, picture.bodies, strict=False):
                    if body.pose is not None:
                        position, quaternion = body.pose
                        pose = EXTERNAL_POSE + struct.pack("<7f", *position, *quaternion)
                        loop.vehicle.receive(pack(Port.LOCALIZATION, 1, pose))

    def _send_out(self, now: float) -> None:
        packets = self.vehicle.sent()
        self._show_pictures(now)
        if self._client is not None and now - self._heard > _SILENCE:
            self._client = None
        if self._radio is not None:
            for packet in packets:
                self._radio.answer(packet)
            up, packets = self._radio.step(now)
            for packet in up:
                self.vehicle.receive(packet)
        if self._client is not None:
            for packet in packets:
                self.link.sendto(packet, self._client)

    def _read_link(self) -> None:
        came = _datagrams(self.link)
        for packet, sender in came:
            if packet == NULL_PACKET:  # a scan, or a driver that checks for a vehicle
                self.link.sendto(pack(Port.LINK, 3, b""), sender)
                continue
            self._client, self._heard = sender, self._clock.now()
            if self._radio is not None:
                self._radio.send(packet)
            else:
                self.vehicle.receive(packet)
        if came:
            self._send_out(self._clock.now())

    def _obey(self, control: Connection) -> bool:
        try:
            request = control.recv()
        except (EOFError, OSError):  # the parent process has ended
            return False
        if isinstance(request, tuple):
            what, number = request
            loop = self.loops[number]
            control.send((loop.record.rows(-1 if what == LATEST else 0), loop.vehicle.locked))
        elif isinstance(request, ViconFault) and self.cameras is not None:
            self.cameras.inject(request, self._clock.now())
        elif isinstance(request, VehicleFault):
            self.vehicle.inject(request)
        elif isinstance(request, RadioFault):
            self._radio = self._radio or Radio(self._clock.now(), self._seed)
            self._radio.inject(request, self._clock.now())
        return request != CLOSE


def _datagrams(source: socket.socket) -> list[tuple[bytes, _Address]]:
    found = []
    while True:
        try:
            found.append(source.recvfrom(_LARGEST_DATAGRAM))
        except BlockingIOError:
            return found


def _socket_at(port: int) -> socket.socket:
    """Return a UDP socket on the loopback, at a free port if that is 0. Raises InputError if it is not available."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.bind(("127.0.0.1", port))
    except (OSError, OverflowError) as why:
        made.close()
        raise InputError(
            f"port {port} is not available: {why}", where="virtual vehicle", hint="choose another with --port"
        ) from why
    made.setblocking(False)
    return made


def serve(control: Connection) -> None:
    """Make the lab that the parent asks for, tell it the port, and run the lab."""
    airframe, vehicle, companions, room, port = control.recv()
    try:
        loop = LabLoop(airframe, vehicle, on_board=room.on_board, port=port)
        loop.companions = {
            name: LabLoop(airframe, settings, on_board=room.on_board, port=port and port + number)
            for number, (name, settings) in enumerate(companions.items(), start=1)
        }
        loop.cameras = (Cameras if room.on_board else VirtualVicon)(room.vicon, REAL_CLOCK.now())
    except CfplanError as error:
        control.send(error)
        return
    gc.collect()
    gc.freeze()
    _take_priority()
    vicon_port = loop.cameras.port if isinstance(loop.cameras, VirtualVicon) else None
    control.send((tuple(each.port for each in loop.loops), vicon_port))
    loop.run(control)


def _take_priority() -> None:
    """Take priority on a busy computer if permitted: the lab stands for hardware, which would not wait either."""
    lock_memory()
    if hasattr(os, "sched_setscheduler"):
        with suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))


def main() -> None:
    """Run `python -m cfplan.simulation.lab.process FD`: the other end of FD is the parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the pilot; the vehicle must still land
    serve(Connection(int(sys.argv[1])))


if __name__ == "__main__":
    main()
