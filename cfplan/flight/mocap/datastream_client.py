"""A client of Vicon's DataStream in plain Python.

It reports what the `motioncapture` package hides: frame number, rate, the server's latency, quality, occlusion by name,
and an error as soon as the server goes away.
"""

import socket
import struct

from cfplan.errors import InputError, LinkError
from cfplan.flight.clock import monotonic
from cfplan.flight.mocap.datastream import (
    LARGEST_PACKET,
    OBJECTS,
    PACKET_HEAD,
    WANTED,
    Block,
    Decoder,
    MalformedError,
    kinds,
    packet,
    read_blocks,
    read_kinds,
)
from cfplan.flight.mocap.frames import Frame, Scene

CONNECT_TIMEOUT = 2.0  # s
FRAME_TIMEOUT = 1.0  # s without a frame, after which the stream counts as lost
_NO_VICON = "is Vicon Tracker running there, and is this computer in its network?"


class DataStreamClient:
    """A `Driver` for Vicon's DataStream; `where` names it in errors."""

    def __init__(self, host: str, port: int, where: str, *, frame_timeout: float = FRAME_TIMEOUT):
        self._host, self._port, self._where, self._frame_timeout = host, port, where, frame_timeout
        self._socket: socket.socket | None = None
        self._buffer = bytearray()
        self._decoder = Decoder()

    def connect(self) -> None:
        """Connect and ask for frames. Raises InputError if name or server is wrong, LinkError if nothing answers."""
        self._socket = open_connection(self._host, self._port, self._where, _NO_VICON)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.settimeout(self._frame_timeout)
        self._buffer, self._decoder = bytearray(), Decoder()
        try:
            offered = [read_kinds(data) for kind, data in read_blocks(self._packet()) if kind == Block.OBJECT_ENUMS]
        except MalformedError as why:
            raise self._no_server() from why
        if not offered:
            raise self._no_server()
        wanted = [kind for kind in WANTED if kind in offered[0] or kind == Block.CONTENTS]
        push = struct.pack("<?", True)
        self._socket.sendall(packet((Block.OBJECT_ENUMS, kinds(wanted)), (Block.REQUEST_FRAME, push)))

    def wait(self) -> Frame:
        """Wait for the next frame and return it."""
        while True:
            body = self._packet()
            received = monotonic()
            try:
                frame = self._decoder.frame(body, received)
            except MalformedError as why:
                raise LinkError(f"the stream is damaged: {why}", where=self._where, hint=_NO_VICON) from why
            if frame is not None:
                return frame

    def scene(self) -> Scene | None:
        """Return the subjects and their segments."""
        return self._decoder.scene

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _packet(self) -> memoryview:
        """Return the body of the next packet."""
        head = self._read(PACKET_HEAD.size)
        tag, size = PACKET_HEAD.unpack(head)
        if tag != OBJECTS or size > LARGEST_PACKET:
            raise self._no_server()
        return memoryview(self._read(size))

    def _read(self, size: int) -> bytes:
        if self._socket is None:
            raise LinkError("the stream is closed", where=self._where, hint="connect again")
        while len(self._buffer) < size:
            try:
                data = self._socket.recv(1 << 16)
            except TimeoutError as why:
                raise LinkError(
                    f"connected, but nothing came for {self._frame_timeout:g} s",
                    where=self._where,
                    hint="is the system live, and is nothing else listening on this port?",
                ) from why
            except OSError as why:
                raise LinkError(f"the stream was lost: {why.strerror}", where=self._where, hint=_NO_VICON) from why
            if not data:
                raise LinkError("the server closed the stream", where=self._where, hint=_NO_VICON)
            self._buffer += data
        taken = bytes(self._buffer[:size])
        del self._buffer[:size]
        return taken

    def _no_server(self) -> InputError:
        return InputError(
            "the server there is not a Vicon DataStream server",
            where=self._where,
            hint="the DataStream's port is 801 unless Tracker says otherwise",
        )


def open_connection(host: str, port: int, where: str, hint: str) -> socket.socket:
    """Return a TCP connection. Raises InputError on an unknown name, LinkError if nothing answers in time."""
    try:
        return socket.create_connection((host, port), CONNECT_TIMEOUT)
    except (socket.gaierror, UnicodeError) as why:
        raise unknown_name(host, where) from why
    except TimeoutError as why:
        raise LinkError(f"{host} does not answer on port {port}", where=where, hint=hint) from why
    except OSError as why:
        raise LinkError(f"{host} port {port}: {why.strerror or why}", where=where, hint=hint) from why


def address_of(host: str, port: int, where: str) -> str:
    """Return the numeric address of a computer, IPv4 if it has one. Raises InputError for an unknown name."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (socket.gaierror, UnicodeError) as why:
        raise unknown_name(host, where) from why
    return str(min(found, key=lambda entry: entry[0] != socket.AF_INET)[4][0])


def unknown_name(host: str, where: str) -> InputError:
    """Return the error of an unknown computer."""
    return InputError(
        f"there is no computer named {host!r}", where=where, hint="give its address in numbers, as 192.168.1.2"
    )
