"""The process that owns a shared Crazyradio, and the link of each pilot to it.

Each pilot has a socket to it. If the process dies, all sockets close, and every pilot knows at once that its link is
lost; if it hangs, pings stay without answer. If a pilot ends, its vehicle is no longer served. The process ends with
the last pilot, also without a main process, which may die while vehicles still fly.
"""

import contextlib
import gc
import multiprocessing
import os
import select
import signal
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import IntEnum
from functools import partial
from typing import cast

from cflib.crtp.crtpdriver import CRTPDriver
from cflib.crtp.crtpstack import CRTPPacket
from cflib.crtp.exceptions import WrongUriType

from cfplan.errors import CfplanError, LinkError
from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.firmware import Timeouts
from cfplan.flight.fleet.inline_radio import RadioAddress, open_inline_radio
from cfplan.flight.fleet.shared_dongle import SharedDongle, SharedRadio, SharedVehicle
from cfplan.flight.radio.radio_lock import lock_radio
from cfplan.flight.real_time import lock_memory, shorten_time_slice, use_fifo_scheduling

SCHEME = "shared://"  # of a pilot's URI, in place of radio://
DONGLE_SILENT = Timeouts().motors_off  # s without a message of the process: the link is lost, and no vehicle flies on
_ALIVE_PERIOD = 0.2  # s between messages that say that the process is alive
_OPENS_WITHIN = 3.0  # s, for a Crazyradio to be opened
_ENDS_WITHIN = 2.0  # s, after the last pilot
_LONGEST_WAIT = 0.1  # s
_LONGEST_MESSAGE = 1024
_SENT = struct.Struct("<d")  # s, when a pilot sent a packet

OpenRadio = Callable[[str], SharedRadio]


class _Kind(IntEnum):
    """The first byte of a message."""

    OPEN = 1  # pilot to dongle
    OPEN_PLAIN = 2  # the same, without safelink
    CLOSE = 3
    PACKET = 4  # both ways
    OPENED = 5  # dongle to pilot
    ALIVE = 6
    LOST = 7  # with the reason


def _tell(end: socket.socket, kind: _Kind, content: bytes = b"") -> None:
    """Send a message, or drop it where the other end does not read or has ended, which it notices by itself."""
    with contextlib.suppress(OSError):
        end.send(bytes((kind,)) + content, socket.MSG_DONTWAIT)


class SharedLink(CRTPDriver):
    """A cflib link driver for shared://: the link of one pilot."""

    def __init__(self, end: socket.socket) -> None:
        super().__init__()
        self._end = end
        self._report: Callable[[str], None] | None = None
        self._heard = 0.0
        self._reading, self._closed = threading.RLock(), False

    def connect(
        self, uri: str, radio_link_statistics_callback: object, link_error_callback: Callable[[str], None] | None
    ) -> None:
        """Open the link. Raises WrongUriType for a URI of another driver, LinkError if the dongle cannot be used."""
        if not uri.startswith(SCHEME):
            raise WrongUriType(f"not a {SCHEME} URI")
        _tell(self._end, _Kind.OPEN_PLAIN if "safelink=0" in uri else _Kind.OPEN)
        until = time.monotonic() + _OPENS_WITHIN
        kind = None
        while kind is not _Kind.OPENED:  # what came for an earlier link is discarded
            kind, content = self._receive(max(until - time.monotonic(), 0.0))
            if kind is None:
                content = b"the dongle's process does not answer"
            if kind in (None, _Kind.LOST):
                raise LinkError(content.decode(), where=uri, hint="plug the Crazyradio in again")
        self._report, self._heard = link_error_callback, time.monotonic()

    def send_packet(self, pk: CRTPPacket) -> None:
        _tell(self._end, _Kind.PACKET, _SENT.pack(time.monotonic()) + bytes((pk.header, *pk.data)))

    def receive_packet(self, wait: float = 0.0) -> CRTPPacket | None:
        """Return the next packet, or None after `wait` s; report why the link is lost, once."""
        with self._reading:
            kind, content = self._receive(wait) if not self._closed else (None, b"")
        if kind is not None:
            self._heard = time.monotonic()
        elif time.monotonic() - self._heard > DONGLE_SILENT:
            kind, content = _Kind.LOST, f"the dongle's process has been silent for {DONGLE_SILENT:g} s".encode()
        if kind is _Kind.LOST and self._report is not None:
            report, self._report = self._report, None
            report(content.decode())
        return CRTPPacket(content[0], bytearray(content[1:])) if kind is _Kind.PACKET else None

    def _receive(self, wait: float) -> tuple[_Kind | None, bytes]:
        """Return the next message, or None after `wait`, s."""
        if not select.select([self._end], [], [], wait)[0]:
            return None, b""
        try:
            kind, *content = self._end.recv(_LONGEST_MESSAGE)
        except (OSError, ValueError):  # nothing to unpack: its end has closed
            return _Kind.LOST, b"the dongle's process has ended"
        return _Kind(kind), bytes(content)

    def close(self) -> None:
        """Close the link, and return once nobody reads for it, as another may be opened; may be called twice."""
        self._report, self._closed = None, True
        _tell(self._end, _Kind.CLOSE)
        with self._reading:
            pass

    def get_name(self) -> str:
        return "shared dongle"


class SharedDongles:
    """The processes of all dongles that vehicles of a fleet share; a context manager."""

    def __init__(self, uris: Mapping[str, str], open_radio: OpenRadio = open_inline_radio):
        """Start a process for each dongle; `uris` are the addresses, radio://…, of vehicles by their names."""
        self._ends: dict[str, socket.socket] = {}  # of pilots, by the names of their vehicles
        by_dongle: dict[str, list[str]] = {}
        for name, uri in uris.items():
            by_dongle.setdefault(uri.removeprefix("radio://").partition("/")[0], []).append(name)
        self.processes = {
            dongle: self._start(dongle, {name: uris[name] for name in names}, open_radio)
            for dongle, names in by_dongle.items()
        }

    def _start(
        self, dongle: str, uris: Mapping[str, str], open_radio: OpenRadio
    ) -> multiprocessing.process.BaseProcess:
        pairs = {name: socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for name in uris}
        links = [(uri, pairs[name][1]) for name, uri in uris.items()]
        process = multiprocessing.get_context("spawn").Process(
            target=_run, args=(dongle, links, open_radio), name=f"dongle {dongle}"
        )
        process.start()
        for name, (pilots, own) in pairs.items():
            self._ends[name] = pilots
            own.close()
        return process

    def drivers(self, name: str) -> list[type]:
        """Return the cflib link drivers for the pilot of a vehicle, to be given to `start_pilot`."""
        return [cast("type", partial(SharedLink, self._ends[name]))]  # cflib calls it to make a link

    def hand_over(self) -> None:
        """Close this process's copies of the pilots' sockets, so that the end of a pilot closes its socket."""
        for end in self._ends.values():
            end.close()

    def __enter__(self) -> "SharedDongles":
        return self

    def __exit__(self, *_: object) -> None:
        self.hand_over()
        for process in self.processes.values():
            process.join(_ENDS_WITHIN)
            if process.is_alive():
                process.kill()


def shared_uri(uri: str) -> str:
    """Return the URI by which a pilot reaches a vehicle over a shared dongle, from its address radio://…."""
    return uri.replace("radio://", SCHEME, 1)


def _run(dongle: str, links: Sequence[tuple[str, socket.socket]], open_radio: OpenRadio) -> None:
    """Run the process of a dongle."""
    with contextlib.suppress(OSError):
        os.setsid()  # the terminal's signals are for the main process
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTSTP, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # pilots land first
    ends = [end for _, end in links]
    select.select(ends, [], [])  # until a pilot opens its link, or all have ended
    try:
        with _opened(dongle, open_radio) as radio:
            _enter_real_time()
            _serve(radio, links)
    except Exception as error:  # cflib and pyusb raise many types
        reason = error.what if isinstance(error, CfplanError) else f"the Crazyradio failed: {error}"
        for end in ends:
            _tell(end, _Kind.LOST, reason.encode())
    os._exit(0)


@contextlib.contextmanager
def _opened(dongle: str, open_radio: OpenRadio) -> Iterator[SharedRadio]:
    lock = lock_radio(f"radio://{dongle}")
    radio = open_radio(dongle)
    try:
        yield radio
    finally:
        radio.close()
        if lock is not None:
            lock.close()


def _serve(radio: SharedRadio, links: Sequence[tuple[str, socket.socket]]) -> None:
    """Serve the vehicles until all pilots have ended."""
    vehicles = {end: _vehicle(uri, end) for uri, end in links}
    dongle = SharedDongle(radio, list(vehicles.values()), REAL_CLOCK)
    wait, alive = 0.0, REAL_CLOCK.now()
    while vehicles:
        for end in select.select(list(vehicles), [], [], min(wait, _LONGEST_WAIT))[0]:
            if not _take(end, vehicles[end]):
                vehicles.pop(end).open = False
        wait = dongle.serve()
        if REAL_CLOCK.now() - alive > _ALIVE_PERIOD:
            alive = REAL_CLOCK.now()
            for end in vehicles:
                _tell(end, _Kind.ALIVE)


def _vehicle(uri: str, end: socket.socket) -> SharedVehicle:
    from cflib.crtp.radiodriver import RadioDriver

    _, channel, rate, address, _ = RadioDriver.parse_uri(uri)
    return SharedVehicle(
        RadioAddress(channel, rate, tuple(address)),
        hear=lambda packet: _tell(end, _Kind.PACKET, packet),
        fail=lambda reason: _tell(end, _Kind.LOST, reason.encode()),
    )


def _take(end: socket.socket, vehicle: SharedVehicle) -> bool:
    """Take a message of a pilot; return whether the pilot has not ended."""
    try:
        message = end.recv(_LONGEST_MESSAGE)
    except OSError:
        message = b""
    if not message:
        return False
    kind, content = _Kind(message[0]), message[1:]
    if kind in (_Kind.OPEN, _Kind.OPEN_PLAIN):
        vehicle.begin(REAL_CLOCK.now(), safelink=kind is _Kind.OPEN)
        _tell(end, _Kind.OPENED)
    elif kind is _Kind.CLOSE:
        vehicle.open = False
    elif vehicle.open:
        vehicle.put(content[_SENT.size :], *_SENT.unpack_from(content))
    return True


def _enter_real_time() -> None:
    """Run in real time, ahead of ordinary programs, as pilots do."""
    gc.collect()
    gc.freeze()
    gc.disable()
    if not use_fifo_scheduling():
        shorten_time_slice()
    lock_memory()
