"""The pilot's link and poses in a stepped lab: the real code, without threads, sockets or processes."""

from collections.abc import Callable
from typing import Any

from cfplan.flight.mocap.frames import Frame, TrackedBody
from cfplan.flight.mocap.source import MocapSource
from cfplan.flight.mocap.uri import parse_uri
from cfplan.flight.radio.connection import FIRST_ANSWER_TIMEOUT
from cfplan.flight.radio.crtp import Port, pack
from cfplan.flight.radio.dongle import PATIENCE
from cfplan.flight.radio.link import Link
from cfplan.flight.radio.parameter_tables import TableCache
from cfplan.flight.radio.restart import BOOT, POWER, POWER_CHANNEL, SYSTEM_OFF, SYSTEM_ON
from cfplan.flight.radio.session import Session
from cfplan.flight.radio.transport import Fail, Hear
from cfplan.flight.telemetry import Telemetry
from cfplan.safety.limits import PoseLimits
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.virtual_crazyflie.virtual_firmware import tables as virtual_tables

URI = "stepped://0"
_STEP = 0.001  # s
_POWER_OFF = 1.0  # s, as long as cflib leaves it off


class SteppedTransport:
    """A transport by a stepped lab's radio, which waits by advancing the lab's clock."""

    def __init__(self, lab: SteppedLab):
        self._lab = lab

    def listen(self, hear: Hear, fail: Fail) -> None:
        self._lab.heard = hear

    def send(self, packet: bytes) -> None:
        until = self._lab.now + PATIENCE
        while self._lab.radio.full and self._lab.now < until:
            self._lab.clock.sleep(_STEP)
        self._lab.radio.send(packet)

    def close(self) -> None:
        self._lab.heard = lambda _: None

    def restart(self) -> None:
        """Restart the vehicle's main processor, as cflib's power switch does."""
        for command, wait in ((SYSTEM_OFF, _POWER_OFF), (SYSTEM_ON, BOOT)):
            self.send(pack(Port.LINK, POWER_CHANNEL, bytes((POWER, command))))
            self._lab.clock.sleep(wait)


def connect(lab: SteppedLab, report: Callable[[Telemetry], None], tables: TableCache | None = None) -> Link:
    """Connect, as `cfplan.flight.radio.connection.connect` does.

    `tables` are those known beforehand; by default those of cfplan's own firmware, so that each connection to it takes
    the same time.
    """
    transport = SteppedTransport(lab)
    session = Session(transport, URI, lab.clock)
    session.open(FIRST_ANSWER_TIMEOUT, _known_tables(lab) if tables is None else tables)
    link = Link(session, report, transport.restart)
    link.release_priority()
    return link


def _known_tables(lab: SteppedLab) -> TableCache:
    tables = TableCache()
    for port, toc in virtual_tables(lab.vehicle.settings).items():
        entries = enumerate(toc.variables)
        tables.add(port, toc.checksum, {entry.full_name: (number, entry.code) for number, entry in entries})
    return tables


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
