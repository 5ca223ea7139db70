"""Frames of a motion capture system, read from a child process without ever waiting for it."""

import os
import select
import signal
import subprocess
import sys
import threading
from typing import Self

from cfplan.errors import CfplanError, LinkError
from cfplan.flight.clock import monotonic
from cfplan.flight.mocap.child import CONNECT_ALARM, FRAME_ALARM, Message, decoded
from cfplan.flight.mocap.frames import DriverStage
from cfplan.flight.mocap.uri import MocapUri
from cfplan.flight.real_time import use_ordinary_scheduling

_CHUNK = 1 << 16  # bytes
_CHECK_PERIOD = 0.05  # s between checks of the child
_LONGEST_SILENCE = CONNECT_ALARM + 1.0  # s until the child is killed, if the kernel's alarm failed
RESTART_BACKOFF = 0.2  # s before a new child


class Feed:
    """Frames of one system, with the body that the URI names or with all. A context manager."""

    def __init__(self, uri: MocapUri):
        self._uri = uri
        self._process: subprocess.Popen | None = None
        self._descriptor = -1
        self._buffer = bytearray()
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._keeper: threading.Thread | None = None
        self._heard = 0.0
        self.stage = "starting"  # what the driver last said it was doing
        self.restarts = 0

    def start(self) -> None:
        """Start the child; `failure` returns its error."""
        self._spawn("first")

    def keep(self) -> None:
        """Replace a child that dies or hangs, in the background, while the feed is open."""
        self._keeper = threading.Thread(target=self._keep, name="mocap keeper", daemon=True)
        self._keeper.start()

    def messages(self) -> list[Message]:
        """Return the messages since the last call; never waits."""
        with self._lock:
            if self._descriptor < 0:
                return []
            try:
                while data := os.read(self._descriptor, _CHUNK):
                    self._buffer += data
                    self._heard = monotonic()
            except BlockingIOError:
                pass
            found = decoded(self._buffer)
        for message in found:
            if isinstance(message, DriverStage):
                self.stage = message.text
            elif not isinstance(message, CfplanError):
                self.stage = "streaming"
        return found

    def failure(self) -> CfplanError | None:
        """Return why the child died without a message; None while it lives."""
        code = self._process.poll() if self._process is not None else 0
        if code is None:
            return None
        if code == -signal.SIGALRM:
            if self.stage.startswith("connecting") and not _is_address(self._uri.host) and self._uri.system != "vrpn":
                hint = f"is {self._uri.host!r} the right name, and is the system running there?"
            elif self.stage.startswith("connecting"):
                hint = "is the system running there, and is this computer in its network?"
            else:
                hint = "is the system live and streaming?"
            limit = CONNECT_ALARM if self.stage.startswith("connecting") else FRAME_ALARM
            return LinkError(f"no answer within {limit:g} s ({self.stage})", where=str(self._uri), hint=hint)
        return LinkError(
            f"the driver's process died (exit code {code}, {self.stage})",
            where=str(self._uri),
            hint="connect again; try another system in the URI, as vicon:// for vicon-sdk://",
        )

    def close(self) -> None:
        """End the child; may be called twice."""
        self._closed.set()
        if self._keeper is not None:
            self._keeper.join()
            self._keeper = None
        self._end_child()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def child_id(self) -> int | None:
        """Return the child's process id, None where there is none."""
        return self._process.pid if self._process is not None else None

    def _spawn(self, again: str) -> None:
        reading, writing = os.pipe()
        os.set_blocking(reading, False)
        command = [sys.executable, "-m", "cfplan.flight.mocap.child", str(writing), str(self._uri)]
        try:
            process = subprocess.Popen(
                [*command, self._uri.subject, again],
                pass_fds=(writing,),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,  # the vendors' libraries print
            )
            use_ordinary_scheduling(process.pid)  # a driver that needs priority asks for it itself
        except BaseException:
            os.close(reading)
            raise
        finally:
            os.close(writing)
        with self._lock:
            self._process, self._descriptor, self._buffer = process, reading, bytearray()
            self._heard = monotonic()

    def _end_child(self) -> None:
        with self._lock:
            if self._descriptor >= 0:
                os.close(self._descriptor)
                self._descriptor = -1
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _keep(self) -> None:
        while not self._closed.wait(_CHECK_PERIOD):
            if self._process is not None and self._process.poll() is None and not self._is_silent():
                continue
            self._end_child()
            if self._closed.wait(RESTART_BACKOFF):
                return
            self.restarts += 1
            try:
                self._spawn("again")
            except OSError:  # no memory or processes left: retry later
                continue

    def _is_silent(self) -> bool:
        """Return whether the child has sent nothing for long; what has not been read yet counts as sent."""
        if monotonic() - self._heard < _LONGEST_SILENCE:
            return False
        return not select.select([self._descriptor], [], [], 0)[0]


def _is_address(host: str) -> bool:
    return ":" in host or host.replace(".", "").isdigit()
