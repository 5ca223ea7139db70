"""The pilot's link and poses in a stepped lab: the real code, without threads, sockets or processes."""

import struct
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

from cfplan.errors import LinkError
from cfplan.flight.mocap.frames import Frame, TrackedBody
from cfplan.flight.mocap.source import MocapSource
from cfplan.flight.mocap.uri import parse_uri
from cfplan.flight.radio.connection import PATIENCE
from cfplan.flight.radio.link import PLATFORM_PORT, Link
from cfplan.flight.radio.log_block import LogBlock
from cfplan.flight.radio.restart import BOOT, POWER, POWER_CHANNEL, SYSTEM_OFF, SYSTEM_ON
from cfplan.flight.telemetry import Telemetry
from cfplan.safety.limits import PoseLimits
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.virtual_crazyflie.wire import Port, pack

URI = "stepped://0"
_STEP = 0.001  # s
_ASK_AGAIN = 0.1  # s
_PATIENCE = 3.0  # s for an answer
_ROUND_TRIP_MS = 2.0
_POWER_OFF = 1.0  # s, as long as cflib leaves it off
_READ, _WRITE, _DATA = 1, 2, 2
_INFO, _MEMORY_READ, _MEMORY_WRITE = range(3)
_MEMORY_PART, _TRAJECTORY_MEMORY = 24, 0x12  # bytes in a packet; the type of memory, as cflib has it
_RESET_LOG, _STOP_BLOCK = 5, 4
_LOG_LAYOUTS = {"uint8_t": "B", "int16_t": "h", "uint16_t": "H", "uint32_t": "I", "float": "f"}


class SteppedLink(Link):
    """A link that sends and receives by the real link's functions, and waits by advancing the lab's clock."""

    def __init__(self, lab: SteppedLab, report: Callable[[Telemetry], None]):
        self._lab = lab
        self._callbacks: dict[int, list[Callable[[Any], None]]] = {}
        self._blocks: dict[int, tuple[list[str], str, Callable[..., None]]] = {}
        self._answers: list[tuple[int, int, bytes]] = []
        self._parameters, self._variables = lab.vehicle.parameters.toc.index(), lab.vehicle.log.toc.index()
        lab.heard = self._hear
        endpoint = SimpleNamespace(
            link=self,
            platform=SimpleNamespace(get_protocol_version=lambda: lab.vehicle.settings.protocol),
            link_statistics=SimpleNamespace(
                latency=SimpleNamespace(latency=_ROUND_TRIP_MS),
                latency_updated=SimpleNamespace(add_callback=lambda _: None),  # the radio reports acknowledgements
            ),
            add_port_callback=self.add_port_callback,
        )
        super().__init__(endpoint, URI, report, clock=lab.clock)
        lab.radio.acknowledged = self.note_acknowledgement

    def add_port_callback(self, port: int, note: Callable[[Any], None]) -> None:
        """Call `note` with each packet that comes from a port, as cflib does."""
        self._callbacks.setdefault(port, []).append(note)

    def send_soon(self, packet: Any) -> None:
        """Send a packet as the radio's driver does: wait briefly for its queue, then drop the packet."""
        until = self._lab.now + PATIENCE
        while self._lab.radio.full and not self._lab.radio.stuck and self._lab.now < until:
            self._lab.clock.sleep(_STEP)
        self._lab.radio.send(bytes((packet.header,)) + bytes(packet.data))

    def parameter_number(self, name: str) -> int | None:
        return self._parameters.get(name)

    def has_log_variable(self, name: str) -> bool:
        return name in self._variables

    def read_parameters(self, names: Sequence[str], patience: float = 2.0) -> dict[str, float]:
        return {name: self._read(name, patience) for name in names if self.has_parameter(name)}

    def set_parameter(self, name: str, value: float, patience: float = 2.0) -> float:
        number = self._parameters.get(name)
        if number is None:
            raise LinkError(f"the vehicle has no parameter {name}", where=URI, hint="update its firmware")
        layout = self._lab.vehicle.parameters.toc.variables[number].format
        head = struct.pack("<H", number)
        number_of_kind = value if layout == "<f" else int(value)
        self._ask(Port.PARAMETERS, _WRITE, head + struct.pack(layout, number_of_kind), head, patience)
        return self._read(name, patience)

    def _read(self, name: str, patience: float) -> float:
        number = self._parameters[name]
        head = struct.pack("<H", number)
        answer = self._ask(Port.PARAMETERS, _READ, head, head, patience)
        return float(struct.unpack_from(self._lab.vehicle.parameters.toc.variables[number].format, answer, 3)[0])

    def upload_trajectory(self, content: bytes, patience: float = 30.0) -> bytes:
        (count,) = self._ask(Port.MEMORY, _INFO, b"\x01", b"\x01", _PATIENCE)[1:2]
        details = (self._ask(Port.MEMORY, _INFO, bytes((2, k)), bytes((2, k)), _PATIENCE) for k in range(count))
        number = next(found[1] for found in details if found[2] == _TRAJECTORY_MEMORY)
        held = b""
        for address in range(0, len(content), _MEMORY_PART):
            part = content[address : address + _MEMORY_PART]
            head = struct.pack("<BI", number, address)
            if self._ask(Port.MEMORY, _MEMORY_WRITE, head + part, head, patience)[5]:
                raise LinkError("the vehicle refuses it: writing its trajectory memory", where=URI, hint="restart it")
            answer = self._ask(Port.MEMORY, _MEMORY_READ, head + bytes((len(part),)), head, patience)
            held += answer[6:]
        return held

    def _log(self, name: str, variables: tuple[list[tuple[str, str]], int], note: Callable[..., None]) -> Any:
        entries, period = variables
        block = len(self._blocks)
        layout = "<" + "".join(_LOG_LAYOUTS[kind] for _, kind in entries)
        self._blocks[block] = [entry for entry, _ in entries], layout, note
        made = LogBlock(block, period, tuple((kind, self._variables[entry]) for entry, kind in entries))
        for payload in made.creation():
            self._ask(Port.LOG, 1, payload, payload[:2], _PATIENCE)
        self._revivals[name] = made.revival()
        stop = bytes((_STOP_BLOCK, block))
        return SimpleNamespace(stop=lambda: self._lab.radio.send(pack(Port.LOG, 1, stop)))

    def start_logs(self) -> None:
        self._ask(Port.LOG, 1, bytes((_RESET_LOG,)), bytes((_RESET_LOG,)), _PATIENCE)
        super().start_logs()

    def close(self) -> None:
        self._lab.heard = lambda _: None

    def restart(self) -> None:
        for command, wait in ((SYSTEM_OFF, _POWER_OFF), (SYSTEM_ON, BOOT)):
            self._lab.radio.send(pack(Port.LINK, POWER_CHANNEL, bytes((POWER, command))))
            self._lab.clock.sleep(wait)

    def _ask(self, port: Port, channel: int, payload: bytes, head: bytes, patience: float) -> bytes:
        """Send until an answer comes, and return it. Raises LinkError if none comes."""
        end = self._lab.now + patience
        self._answers.clear()
        while self._lab.now < end:
            self._lab.radio.send(pack(port, channel, payload))
            again = self._lab.now + max(_ASK_AGAIN, self._lab.vehicle.settings.parameter_delay)
            while self._lab.now < min(again, end):
                self._lab.clock.sleep(_STEP)
                for came in self._answers:
                    if came[:2] == (port, channel) and came[2].startswith(head):
                        return came[2]
        raise LinkError(f"no answer to {port.name.lower()}", where=URI, hint="check the radio link")

    def _hear(self, datagram: bytes) -> None:
        port, channel, data = datagram[0] >> 4, datagram[0] & 3, datagram[1:]
        if port == Port.LOG and channel == _DATA:
            names, layout, note = self._blocks[data[0]]
            if len(data) == 4 + struct.calcsize(layout):  # else the block is partly created; cflib drops that too
                values = dict(zip(names, struct.unpack(layout, data[4:]), strict=True))
                note(int.from_bytes(data[1:4], "little"), values, None)
            return
        for callback in self._callbacks.get(port, ()):
            callback(SimpleNamespace(port=port, channel=channel, data=data))
        self._answers.append((port, channel, data))


def connect(lab: SteppedLab, report: Callable[[Telemetry], None]) -> SteppedLink:
    """Connect, as `cfplan.flight.radio.connection.connect` does."""
    lab.clock.sleep(0.1)
    link = SteppedLink(lab, report)
    link.release_priority()
    link.ask_firmware()
    end = lab.now + _PATIENCE
    while not link.firmware and lab.now < end:
        lab.clock.sleep(_STEP)
    if not link.firmware:
        raise LinkError("nothing answers", where=URI, hint=f"port {PLATFORM_PORT} is silent")
    return link


class SteppedPoses(MocapSource):
    """The pilot's source of poses from the lab's cameras, dated and classified as in a real flight."""

    def __init__(self, lab: SteppedLab, limits: PoseLimits, subject: str = "cf1"):
        super().__init__(parse_uri(f"vicon://lab/{subject}", subject_needed=True), limits, clock=lab.clock)
        self._lab = lab

    def open(self) -> None:
        self._begin()
        self._lab.pictures()

    def poses(self) -> list[Any]:
        found = []
        for received, picture in self._lab.pictures():
            bodies, hidden = [], []
            for shown in picture.bodies:
                if shown.pose is None:
                    hidden.append(shown.name)
                else:
                    bodies.append(TrackedBody(shown.name, *shown.pose))
            frame = Frame(received, tuple(bodies), tuple(hidden), picture.number, picture.rate, picture.latency)
            pose = self._pose(frame)
            if pose is not None:
                found.append(pose)
        return found

    def close(self) -> None:
        pass
