"""The process in which a motion capture driver runs; its messages go through a pipe.

A driver may hang without ever releasing the interpreter, so neither a thread nor a Python signal handler can end it.
The kernel's alarm does, which is set again before every step.
"""

import marshal
import os
import pickle
import signal
import struct
import sys
import time
from contextlib import suppress

from cfplan.errors import CfplanError, InputError, LinkError
from cfplan.flight.mocap.datastream_client import DataStreamClient
from cfplan.flight.mocap.frames import Driver, DriverStage, Frame, Scene, TrackedBody
from cfplan.flight.mocap.sdk import SdkDriver
from cfplan.flight.mocap.uri import MocapUri, parse_uri
from cfplan.flight.real_time import lock_memory

HEAD = struct.Struct("<I?")  # length of the message in bytes, and whether it is a frame
CONNECT_ALARM = 2.5  # s to resolve the name, connect, and ask for frames
FRAME_ALARM = 1.5  # s between frames
_TRY_AGAIN = 0.1  # s
_PRIORITY = 10  # of SCHED_FIFO; the setpoint stream's is higher

Message = Frame | Scene | DriverStage | CfplanError


def encoded(message: Message) -> bytes:
    """Return a message as bytes. Frames are frequent and time-critical, so they are sent as plain tuples."""
    if isinstance(message, Frame):
        bodies = tuple((body.name, body.position, body.quaternion, body.quality) for body in message.bodies)
        plain = (message.received, bodies, message.hidden, message.number, message.rate, message.latency)
        data = marshal.dumps(plain)
    else:
        data = pickle.dumps(message)
    return HEAD.pack(len(data), isinstance(message, Frame)) + data


def decoded(buffer: bytearray) -> list[Message]:
    """Take the complete messages from the start of a buffer and return them."""
    found: list[Message] = []
    while len(buffer) >= HEAD.size:
        size, is_frame = HEAD.unpack_from(buffer)
        end = HEAD.size + size
        if len(buffer) < end:
            break
        data = bytes(buffer[HEAD.size : end])
        del buffer[:end]
        if is_frame:
            received, bodies, *rest = marshal.loads(data)
            found.append(Frame(received, tuple(TrackedBody(*body) for body in bodies), *rest))
        else:
            found.append(pickle.loads(data))
    return found


def driver_of(uri: MocapUri) -> Driver:
    """Return the driver of a system."""
    if uri.system == "vicon":
        return DataStreamClient(uri.host, uri.port, str(uri))
    return SdkDriver(uri)


class Outlet:
    """The writing end of the pipe; with a `subject`, only that body's poses are sent."""

    def __init__(self, descriptor: int, subject: str):
        self._descriptor, self._subject = descriptor, subject

    def send(self, message: Message) -> None:
        """Send a message. Raises BrokenPipeError if the pipe has lost its reader."""
        data = encoded(message)
        while data:
            data = data[os.write(self._descriptor, data) :]

    def send_frame(self, frame: Frame) -> None:
        """Send a frame, reduced to the requested body if there is one."""
        if self._subject:
            bodies = tuple(body for body in frame.bodies if body.name == self._subject)
            hidden = () if bodies else (self._subject,)
            frame = Frame(frame.received, bodies, hidden, frame.number, frame.rate, frame.latency)
        self.send(frame)


def run(uri: MocapUri, outlet: Outlet, *, again: bool) -> None:
    """Connect and send frames forever; reconnect if the stream is lost.

    `again`: an earlier process had a stream. Otherwise a failure to connect ends the run.
    """
    while True:
        driver = driver_of(uri)
        try:
            again = _stream(driver, uri, outlet) or again
        except LinkError as lost:
            if not again:
                outlet.send(lost)
                return
            outlet.send(DriverStage(f"trying again: {lost.what}"))
        except CfplanError as error:
            outlet.send(error)
            return
        finally:
            driver.close()
        time.sleep(_TRY_AGAIN)


def _stream(driver: Driver, uri: MocapUri, outlet: Outlet) -> bool:
    """Send frames until the stream is lost; return whether there was one. Raises LinkError if there was none."""
    _alarm(CONNECT_ALARM)
    outlet.send(DriverStage(f"connecting to {uri.address}"))
    driver.connect()
    _alarm(FRAME_ALARM)
    outlet.send(DriverStage("connected, waiting for a frame"))
    sent: Scene | None = None
    frames = 0
    while True:
        try:
            frame = driver.wait()
        except LinkError as lost:
            if not frames:
                raise
            outlet.send(DriverStage(lost.what))
            return True
        _alarm(FRAME_ALARM)
        frames += 1
        scene = driver.scene()
        if scene is not None and scene is not sent:
            sent = scene
            outlet.send(scene)
        outlet.send_frame(frame)


def _alarm(seconds: float) -> None:
    """Have the kernel end this process after `seconds`, unless called again."""
    signal.setitimer(signal.ITIMER_REAL, seconds)


def _take_priority() -> None:
    """Take real-time priority if permitted; not for the vendors' clients, which may spin forever."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(_PRIORITY))


def main() -> None:
    """Run `python -m cfplan.flight.mocap.child FD URI SUBJECT AGAIN`: frames go to FD; SUBJECT "" means every body."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent process
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the parent process lands first, and then ends this one
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    descriptor, text, subject, again = sys.argv[1:]
    outlet = Outlet(int(descriptor), subject)
    try:
        uri = parse_uri(text, subject_needed=False)
        if uri.system == "vicon":
            _take_priority()
        lock_memory()
        run(uri, outlet, again=again == "again")
    except BrokenPipeError:
        return
    except Exception as error:  # the parent must learn of every error
        outlet.send(
            InputError(
                f"fault in the driver: {error!r}",
                where=text,
                hint="try another system in the URI, as vicon-sdk:// for vicon://; please report this",
            )
        )


if __name__ == "__main__":
    main()
