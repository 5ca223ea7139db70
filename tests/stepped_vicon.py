"""A client of the virtual Vicon on a stepped clock: what the driver's process does, without the process."""

import os
import socket

from cfplan.errors import CfplanError
from cfplan.flight.clock import SteppedClock
from cfplan.flight.mocap.child import Message, Outlet, decoded
from cfplan.flight.mocap.datastream import PACKET_HEAD, WANTED, Block, Decoder, kinds, packet
from cfplan.flight.mocap.uri import MocapUri

_STEP = 0.001  # s


class SteppedFeed:
    """Frames of a virtual Vicon on the same clock, through TCP, the decoder and the pipe of a real feed."""

    stage, child_id = "streaming", None

    def __init__(self, uri: MocapUri, clock: SteppedClock):
        self._uri, self._clock = uri, clock
        self._received, self._piped = bytearray(), bytearray()
        self._decoder, self._scene = Decoder(), None

    def start(self) -> None:
        self._reader, writer = os.pipe()
        self._writer = writer
        os.set_blocking(self._reader, False)
        self._outlet = Outlet(writer, self._uri.subject)
        self._socket = socket.create_connection((self._uri.host, self._uri.port))
        self._socket.setblocking(False)
        self._clock.sleep(3 * _STEP)
        self._socket.recv(1 << 16)  # what the server offers
        self._socket.sendall(packet((Block.OBJECT_ENUMS, kinds(WANTED)), (Block.REQUEST_FRAME, b"\1")))
        self._reading = self._clock.repeat(self._read, name="feed")

    def __enter__(self) -> "SteppedFeed":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def keep(self) -> None:
        pass

    def failure(self) -> CfplanError | None:
        return None

    def messages(self) -> list[Message]:
        try:
            while data := os.read(self._reader, 1 << 16):
                self._piped += data
        except BlockingIOError:
            pass
        return decoded(self._piped)

    def close(self) -> None:
        self._reading.stop()
        self._socket.close()
        os.close(self._reader)
        os.close(self._writer)

    def _read(self) -> float:
        try:
            self._received += self._socket.recv(1 << 16)
        except BlockingIOError:
            return _STEP
        while len(self._received) >= PACKET_HEAD.size:
            end = PACKET_HEAD.size + PACKET_HEAD.unpack_from(self._received)[1]
            if len(self._received) < end:
                break
            frame = self._decoder.frame(memoryview(bytes(self._received[PACKET_HEAD.size : end])), self._clock.now())
            del self._received[:end]
            if self._decoder.scene is not self._scene:
                self._scene = self._decoder.scene
                self._outlet.send(self._scene)
            if frame is not None:
                self._outlet.send_frame(frame)
        return _STEP
