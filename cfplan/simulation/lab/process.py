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
from cfplan.simulation.lab.lab import CLOSE, LATEST, MOTORS, OFF_IN_AIR, PORTS, ROW_SIZE, STATE, SUPERVISOR, TIME
from cfplan.simulation.lab.radio import Radio, RadioFault
from cfplan.simulation.lab.room import SUBSCRIBE, SUBSCRIPTION_LASTS, MotionCapture, RoomSettings
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.stabilizer import OFF_IN_AIR_TICKS
from cfplan.simulation.virtual_crazyflie.vehicle import COMMANDER_PERIOD, VirtualCrazyflie
from cfplan.simulation.virtual_vicon.faults import Seen, ViconFault
from cfplan.simulation.virtual_vicon.vicon import VirtualVicon
from cfplan.vehicle.airframe import Airframe

_WARM_UP = 200  # ms
_VICON_STEP = 2  # ms between wakes for the virtual Vicon
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
        row, loop = self._rows[self._count], vehicle.stabilizer.loop
        row[TIME], row[STATE], row[MOTORS] = time, loop.truth, loop.motors
        row[OFF_IN_AIR], row[SUPERVISOR] = loop.counts[OFF_IN_AIR_TICKS], vehicle.supervisor.state
        self._count += 1

    def rows(self, first: int = 0) -> bytes:
        """Return all rows, or those from `first` on; negative numbers count from the end."""
        return self._rows[: self._count][first:].tobytes()


class LabLoop:
    """Vehicle, room and sockets on one clock; and the loops of other vehicles in that room."""

    def __init__(
        self,
        airframe: Airframe,
        vehicle: VehicleSettings,
        room: RoomSettings,
        port: int = 0,
        clock: Clock = REAL_CLOCK,
    ):
        self.companions: Mapping[str, LabLoop] = {}  # by the names that the virtual Vicon has for them
        self.vehicle = VirtualCrazyflie(airframe, vehicle)
        self._clock = clock
        self._seed = vehicle.seed
        self._on_board = room.on_board
        if room.on_board:
            self.vehicle.use_kalman()
        self._warm_up()
        self.capture = MotionCapture(room, begin=self.vehicle.tick)
        self.vicon: VirtualVicon | None = None
        self.record = Recorder()
        self.link, self.poses = _sockets_at(port) if port else _adjacent_sockets()
        self.port: int = self.link.getsockname()[1]
        self._client: _Address | None = None
        self._heard = 0.0
        self._subscribers: dict[_Address, float] = {}
        self._origin = math.nan  # s, when the vehicle's tick 0 was
        self._radio: Radio | None = None  # None while the link is perfect

    def _warm_up(self) -> None:
        """Compile, and let the supervisor pass its checks, before a client connects."""
        self.vehicle.advance(_WARM_UP)
        self.vehicle.sent()

    def run(self, control: Connection) -> None:
        """Run until told to end, or until the parent process has ended."""
        parent, loops = os.getppid(), self.loops
        sources: list[int] = [each.fileno() for loop in loops for each in (loop.link, loop.poses)]
        sources.append(control.fileno())
        for loop in loops:
            loop.serve()
        while os.getppid() == parent:
            readable = self._clock.readable(sources, min(loop.until_due() for loop in loops))
            for loop in loops:
                loop.serve()
            if control.fileno() in readable and not self._obey(control):
                return

    @property
    def loops(self) -> tuple["LabLoop", ...]:
        """Return the loops of all vehicles in the room, this one first."""
        return self, *self.companions.values()

    def serve(self) -> None:
        """Do what is due by now, for the vehicle, the room and the sockets."""
        if math.isnan(self._origin):
            self._origin = self._clock.now() - self.vehicle.tick / 1000
        self._catch_up()
        self._read_link()
        self._read_subscriptions()

    def until_due(self) -> float:
        """Return s until `serve` is needed again, unless a packet comes sooner."""
        return max(0.0, self._due() - self._clock.now())

    def _due(self) -> float:
        """Return when, s, something visible outside is due next."""
        tick = self.vehicle.tick
        if self._radio is not None and self._radio.busy:
            return self._origin + (tick + 1) / 1000
        if self.vicon is not None:
            return min(self._origin + (tick + _VICON_STEP) / 1000, self.capture.next_due)
        boundary = -(-tick // COMMANDER_PERIOD) * COMMANDER_PERIOD
        after = min(boundary, self.capture.next_tick) + 1
        return min(self._origin + after / 1000, self.capture.next_due)

    def _catch_up(self) -> None:
        now = self._clock.now()
        if now - self._origin - self.vehicle.tick / 1000 > _LARGEST_LAG:
            self._origin = now - self.vehicle.tick / 1000
        self._run_to(int((now - self._origin) * 1000))
        self._send_out(now)

    def pose_at(self, now: float) -> Seen:
        """Return where the vehicle is at a time, s, to which it is advanced where that is due."""
        if not math.isnan(self._origin):
            self._run_to(int((now - self._origin) * 1000))
        truth = self.vehicle.stabilizer.loop.truth.tolist()
        return (truth[0], truth[1], truth[2]), (truth[6], truth[7], truth[8], truth[9])

    def _run_to(self, target: int) -> None:
        while self.vehicle.tick < target:
            tick = self.vehicle.tick
            if tick >= self.capture.next_tick:
                self.capture.look(self._origin + tick / 1000, self.vehicle.stabilizer.loop.truth)
            self._look(self._origin + tick / 1000)
            if tick % _RECORD_PERIOD == 0:
                self.record.note(self._origin + tick / 1000, self.vehicle)
            stop = min(target, self.capture.next_tick, tick + _RECORD_PERIOD - tick % _RECORD_PERIOD)
            if self.vicon is not None:
                stop = min(stop, max(tick + 1, math.ceil((self.vicon.next_look - self._origin) * 1000)))
            self.vehicle.advance(stop - tick)

    def _look(self, now: float) -> None:
        """Let the virtual Vicon see the vehicles when it is due."""
        if self.vicon is not None and now >= self.vicon.next_look:
            truth = self.vehicle.stabilizer.loop.truth.tolist()
            others = {name: loop.pose_at(now) for name, loop in self.companions.items()}
            self.vicon.look(now, (truth[0], truth[1], truth[2]), (truth[6], truth[7], truth[8], truth[9]), others)

    def _send_out(self, now: float) -> None:
        packets = self.vehicle.sent()
        if self.vicon is not None:
            self.vicon.step(now)
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
        for packet in self.capture.ready(now):
            if self._on_board:
                pose = EXTERNAL_POSE + struct.pack("<7f", *self.capture.measured(packet))
                self.vehicle.receive(pack(Port.LOCALIZATION, 1, pose))
            for address, renewed in list(self._subscribers.items()):
                if now - renewed > SUBSCRIPTION_LASTS:
                    del self._subscribers[address]
                else:
                    self.poses.sendto(packet, address)

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

    def _read_subscriptions(self) -> None:
        for packet, sender in _datagrams(self.poses):
            if packet == SUBSCRIBE:
                self._subscribers[sender] = self._clock.now()
            else:
                self._subscribers.pop(sender, None)

    def _obey(self, control: Connection) -> bool:
        try:
            request = control.recv()
        except (EOFError, OSError):  # the parent process has ended
            return False
        if isinstance(request, tuple):
            what, number = request
            loop = self.loops[number]
            control.send((loop.record.rows(-1 if what == LATEST else 0), loop.vehicle.supervisor.ever_locked))
        elif isinstance(request, ViconFault) and self.vicon is not None:
            self.vicon.inject(request, self._clock.now())
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


def _adjacent_sockets() -> tuple[socket.socket, socket.socket]:
    """Return two UDP sockets on the loopback, the second one port above the first."""
    while True:
        first = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        first.bind(("127.0.0.1", 0))
        second = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            second.bind(("127.0.0.1", first.getsockname()[1] + 1))
        except (OSError, OverflowError):
            first.close()
            second.close()
            continue
        first.setblocking(False)
        second.setblocking(False)
        return first, second


def _sockets_at(port: int) -> tuple[socket.socket, socket.socket]:
    """Return the same two sockets at a port. Raises InputError if it is not available."""
    found = []
    for number in (port, port + 1):
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            made.bind(("127.0.0.1", number))
        except (OSError, OverflowError) as why:
            raise InputError(
                f"port {number} is not available: {why}", where="virtual vehicle", hint="choose another with --port"
            ) from why
        made.setblocking(False)
        found.append(made)
    return found[0], found[1]


def serve(control: Connection) -> None:
    """Make the lab that the parent asks for, tell it the port, and run the lab."""
    airframe, vehicle, companions, room, port = control.recv()
    try:
        loop = LabLoop(airframe, vehicle, room, port)
        loop.companions = {
            name: LabLoop(airframe, settings, replace(room, seed=room.seed + number), port and port + PORTS * number)
            for number, (name, settings) in enumerate(companions.items(), start=1)
        }
        if room.vicon is not None:
            loop.vicon = VirtualVicon(room.vicon, REAL_CLOCK.now())
    except CfplanError as error:
        control.send(error)
        return
    gc.collect()
    gc.freeze()
    _take_priority()
    control.send((tuple(each.port for each in loop.loops), loop.vicon.port if loop.vicon is not None else None))
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
