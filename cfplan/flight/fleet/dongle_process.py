"""The process that owns a shared Crazyradio, and the link of each pilot to it.

A socket connects each pilot with the process. If the process dies, its sockets close, and every pilot knows at once
that its link is lost; if it hangs, the pilots stop hearing from it. If a pilot ends, its vehicle is no longer served.
The process ends with the last pilot. It does not need the main process, which may die while vehicles still fly.
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

SCHEME = "shared://"  # replaces radio:// in a pilot's URI
DONGLE_SILENT = Timeouts().motors_off  # s without a message: the link is lost; by then no vehicle flies
_ALIVE_PERIOD = 0.2  # s between ALIVE messages to each pilot
_OPEN_TIMEOUT = 3.0  # s for the process to open the Crazyradio
_END_TIMEOUT = 2.0  # s for the process to end after the last pilot; then it is killed
_MAX_WAIT = 0.1  # s for a pilot's message, so that ALIVE messages are sent in time
_MAX_MESSAGE = 1024  # bytes
_SEND_TIME = struct.Struct("<d")  # s; precedes each packet from a pilot

_ENDED = b"the dongle's process has ended"

OpenRadio = Callable[[str], SharedRadio]


class _MessageKind(IntEnum):
    """The first byte of a message."""

    # From a pilot to the process, except that packets go both ways:
    OPEN = 1
    OPEN_PLAIN = 2  # without safelink
    CLOSE = 3
    PACKET = 4
    # From the process to a pilot:
    OPENED = 5
    ALIVE = 6
    LOST = 7  # followed by the reason


def _send(end: socket.socket, kind: _MessageKind, content: bytes = b"") -> None:
    """Send a message; drop it if the other end does not read or has closed, which each end notices by itself."""
    with contextlib.suppress(OSError):
        end.send(bytes((kind,)) + content, socket.MSG_DONTWAIT)


class SharedLink(CRTPDriver):
    """A cflib link driver for shared:// URIs: one pilot's link to its vehicle."""

    def __init__(self, end: socket.socket) -> None:
        super().__init__()
        self._end = end
        self._on_lost: Callable[[str], None] | None = None
        self._heard_at = 0.0
        self._reading, self._closed = threading.RLock(), False
        self._ended = False  # the process has ended

    def connect(
        self, uri: str, radio_link_statistics_callback: object, link_error_callback: Callable[[str], None] | None
    ) -> None:
        """Open the link. Raises WrongUriType for a URI of another driver, LinkError if the dongle cannot be used."""
        if not uri.startswith(SCHEME):
            raise WrongUriType(f"not a {SCHEME} URI")
        _send(self._end, _MessageKind.OPEN_PLAIN if "safelink=0" in uri else _MessageKind.OPEN)
        until, kind, reason = REAL_CLOCK.now() + _OPEN_TIMEOUT, None, ""
        while kind is not _MessageKind.OPENED:  # messages for an earlier link are discarded
            kind, content = self._receive(0.0 if self._ended else max(until - REAL_CLOCK.now(), 0.0))
            if kind is None or self._ended:
                reason = reason or content.decode() or "the dongle's process does not answer"
                raise LinkError(reason, where=uri, hint="plug the Crazyradio in again")
            if kind is _MessageKind.LOST:  # of an earlier link, unless the process ends now
                reason = content.decode()
        self._on_lost, self._heard_at = link_error_callback, REAL_CLOCK.now()

    def send_packet(self, pk: CRTPPacket) -> None:
        _send(self._end, _MessageKind.PACKET, _SEND_TIME.pack(REAL_CLOCK.now()) + bytes((pk.header, *pk.data)))

    def receive_packet(self, wait: float = 0.0) -> CRTPPacket | None:
        """Return the next packet, or None after `wait`, s. Reports once why the link is lost."""
        with self._reading:
            kind, content = self._receive(wait) if not self._closed else (None, b"")
        if kind is not None:
            self._heard_at = REAL_CLOCK.now()
        elif REAL_CLOCK.now() - self._heard_at > DONGLE_SILENT:
            kind, content = _MessageKind.LOST, f"the dongle's process has been silent for {DONGLE_SILENT:g} s".encode()
        if kind is _MessageKind.LOST and self._on_lost is not None:
            report, self._on_lost = self._on_lost, None
            report(content.decode())
        return CRTPPacket(content[0], bytearray(content[1:])) if kind is _MessageKind.PACKET else None

    def _receive(self, wait: float) -> tuple[_MessageKind | None, bytes]:
        """Return the next message, or None after `wait`, s; once the process has ended, None after `wait`."""
        if self._ended:
            REAL_CLOCK.sleep(wait)
            return None, _ENDED
        if not select.select([self._end], [], [], wait)[0]:
            return None, b""
        try:
            kind, *content = self._end.recv(_MAX_MESSAGE)
        except (OSError, ValueError):  # an empty message, which cannot be unpacked: the other end has closed
            self._ended = True
            return _MessageKind.LOST, _ENDED
        return _MessageKind(kind), bytes(content)

    def close(self) -> None:
        """Close the link, and wait for its reader, which would take packets of the next link; may be called twice."""
        self._on_lost, self._closed = None, True
        _send(self._end, _MessageKind.CLOSE)
        with self._reading:
            pass

    def get_name(self) -> str:
        return "shared dongle"


class SharedDongles:
    """The processes of all dongles that the vehicles of a fleet share; a context manager."""

    def __init__(self, uris: Mapping[str, str], open_radio: OpenRadio = open_inline_radio):
        """Start a process for each dongle; `uris` maps the names of vehicles to their addresses, radio://…."""
        self._ends: dict[str, socket.socket] = {}  # the pilots' sockets, by vehicle name
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
        for name, (pilot_end, dongle_end) in pairs.items():
            self._ends[name] = pilot_end
            dongle_end.close()  # the process has its own copy
        return process

    def drivers(self, name: str) -> list[type]:
        """Return the cflib link drivers of a vehicle's pilot, for `start_pilot`."""
        return [cast("type", partial(SharedLink, self._ends[name]))]  # cflib calls a driver's class to make a link

    def hand_over(self) -> None:
        """Close this process's copies of the pilots' sockets, so that a pilot's socket closes when it ends."""
        for end in self._ends.values():
            end.close()

    def __enter__(self) -> "SharedDongles":
        return self

    def __exit__(self, *_: object) -> None:
        self.hand_over()
        for process in self.processes.values():
            process.join(_END_TIMEOUT)
            if process.is_alive():
                process.kill()


def shared_uri(uri: str) -> str:
    """Return the address of a vehicle, radio://…, with the scheme of shared dongles."""
    return uri.replace("radio://", SCHEME, 1)


def _run(dongle: str, links: Sequence[tuple[str, socket.socket]], open_radio: OpenRadio) -> None:
    """Run the process of a dongle."""
    with contextlib.suppress(OSError):
        os.setsid()  # the terminal's signals are for the main process
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTSTP, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the vehicles must land first
    ends = [end for _, end in links]
    select.select(ends, [], [])  # until a pilot opens its link or ends
    try:
        with _opened(dongle, open_radio) as radio:
            _enter_real_time()
            _serve(radio, links)
    except Exception as error:  # cflib and pyusb raise many types
        reason = error.what if isinstance(error, CfplanError) else f"the Crazyradio failed: {error}"
        for end in ends:
            _send(end, _MessageKind.LOST, reason.encode())
    os._exit(0)


@contextlib.contextmanager
def _opened(dongle: str, open_radio: OpenRadio) -> Iterator[SharedRadio]:
    lock = lock_radio(f"radio://{dongle}")
    radio = open_radio(dongle)
    try:
        yield radio
    finally:
        with contextlib.suppress(OSError):  # an unplugged radio; why it failed is known already
            radio.close()
        if lock is not None:
            lock.close()


def _serve(radio: SharedRadio, links: Sequence[tuple[str, socket.socket]]) -> None:
    """Serve the vehicles until all pilots have ended."""
    vehicles = {end: _vehicle(uri, end) for uri, end in links}
    dongle = SharedDongle(radio, list(vehicles.values()), REAL_CLOCK)
    wait, alive = 0.0, REAL_CLOCK.now()
    while vehicles:
        for end in select.select(list(vehicles), [], [], min(wait, _MAX_WAIT))[0]:
            if not _process_message(end, vehicles[end]):
                vehicles.pop(end).open = False
        wait = dongle.serve()
        if REAL_CLOCK.now() - alive > _ALIVE_PERIOD:
            alive = REAL_CLOCK.now()
            for end, vehicle in vehicles.items():
                if vehicle.open:  # else its pilot notices the silence, even if it did not get the reason
                    _send(end, _MessageKind.ALIVE)


def _vehicle(uri: str, end: socket.socket) -> SharedVehicle:
    from cflib.crtp.radiodriver import RadioDriver

    _, channel, rate, address, _ = RadioDriver.parse_uri(uri)
    return SharedVehicle(
        RadioAddress(channel, rate, tuple(address)),
        hear=lambda packet: _send(end, _MessageKind.PACKET, packet),
        fail=lambda reason: _send(end, _MessageKind.LOST, reason.encode()),
    )


def _process_message(end: socket.socket, vehicle: SharedVehicle) -> bool:
    """Process one message from a pilot; return False if the pilot has ended."""
    try:
        message = end.recv(_MAX_MESSAGE)
    except OSError:
        message = b""
    if not message:
        return False
    kind, content = _MessageKind(message[0]), message[1:]
    if kind in (_MessageKind.OPEN, _MessageKind.OPEN_PLAIN):
        vehicle.begin(REAL_CLOCK.now(), safelink=kind is _MessageKind.OPEN)
        _send(end, _MessageKind.OPENED)
    elif kind is _MessageKind.CLOSE:
        vehicle.open = False
    elif vehicle.open:
        vehicle.put(content[_SEND_TIME.size :], *_SEND_TIME.unpack_from(content))
    return True


def _enter_real_time() -> None:
    """Run in real time, as pilots do: no garbage collection, and scheduled before ordinary programs."""
    gc.collect()
    gc.freeze()
    gc.disable()
    if not use_fifo_scheduling():
        shorten_time_slice()
    lock_memory()
