"""Write a record's MCAP file while the flight goes on, without ever delaying the flight.

`write` only puts a message into a queue. Four times a second a thread writes the queued messages as one chunk, so
a killed process loses only the last moments.
"""

import contextlib
import io
import json
import logging
import re
import time
from collections import deque
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import IO, Any, Protocol, cast

from mcap.writer import CompressionType, Writer

from cfplan.errors import InputError
from cfplan.files.atomic import atomic_write
from cfplan.flight.clock import REAL_CLOCK, Clock, monotonic
from cfplan.flight.telemetry import Telemetry
from cfplan.recording.header import RecordHeader, header_to_json
from cfplan.recording.public_topics import PublicTopics
from cfplan.recording.record import FLIGHT_FILE, SUMMARY_FILE
from cfplan.recording.topics import FORMAT, METADATA, PROFILE, TOPICS, json_schema, message_to_json

FLUSH_PERIOD = 0.25  # s, largest loss if the process is killed, plus the time for writing
_LOG = logging.getLogger(__name__)


class RawFile(Protocol):
    """An unbuffered binary file."""

    def write(self, data: bytes, /) -> int | None: ...
    def truncate(self, size: int, /) -> int: ...
    def close(self) -> None: ...


def new_file(path: Path) -> RawFile:
    """Open a file that must not exist yet. Raises OSError."""
    return io.FileIO(path, "x")


def wall_time_at_zero() -> float:
    """Return s since 1970 when the flight's clock was at zero, for the header."""
    return time.time() - monotonic()


def new_record_folder(root: Path, name: str, *, now: datetime | None = None) -> Path:
    """Make `root/<stamp>-<name>`, numbered if that exists. Raises InputError if it cannot be made."""
    stamp = (now or datetime.now()).strftime("%Y%m%d-%H%M%S")
    plain = re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-")[:60] or "flight"
    folder, number = root / f"{stamp}-{plain}", 1
    while True:
        try:
            root.mkdir(parents=True, exist_ok=True)
            folder.mkdir()
        except FileExistsError as error:
            if not root.is_dir():
                raise _cannot_write(root, error) from error
            number += 1
            folder = root / f"{stamp}-{plain}-{number}"
        except OSError as error:
            raise _cannot_write(folder, error) from error
        else:
            return folder


def write_summary(folder: Path, summary: Mapping[str, Any]) -> None:
    """Write summary.json atomically. Raises OSError, or ValueError if a number is not finite."""
    text = json.dumps(dict(summary), indent=2, allow_nan=False)
    with atomic_write(folder / SUMMARY_FILE) as unfinished:
        unfinished.write_text(text + "\n", encoding="utf-8")


class RecordWriter:
    """Writes flight.mcap into a folder that has none yet.

    Raises InputError on opening, before anything flies; never afterwards. From then on the first failure goes to
    `warn`, once, and stays in `failure`; what was written before it stays readable.
    """

    def __init__(
        self,
        folder: Path,
        header: RecordHeader,
        *,
        warn: Callable[[str], None] = _LOG.warning,
        open_file: Callable[[Path], RawFile] = new_file,
        clock: Clock = REAL_CLOCK,
    ):
        self.folder = folder
        self.failure = ""
        self._warn = warn
        self._zero = header.wall_time_at_zero
        self._waiting: deque[Telemetry] = deque()
        path = folder / FLIGHT_FILE
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._sink = _Sink(open_file(path))
            self._mcap = Writer(cast(IO[bytes], self._sink), chunk_size=1 << 24, compression=CompressionType.ZSTD)
            self._channels = _begin(self._mcap, header)
            self._public = PublicTopics(self._mcap, header, self._nanoseconds)
        except FileExistsError as error:
            raise InputError(
                "the folder holds a record already", where=str(path), hint="name another folder"
            ) from error
        except OSError as error:
            path.unlink(missing_ok=True)
            raise _cannot_write(path, error) from error
        self._writing = clock.repeat(self._write_chunk, name="record writer", last=self._end)

    def __enter__(self) -> "RecordWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, message: Telemetry) -> None:
        """Take a message; returns at once and never raises."""
        self._waiting.append(message)

    def close(self, summary: Mapping[str, Any] | None = None) -> None:
        """Write what is left and the summary, if there is one. May be called twice; never raises."""
        self._writing.stop()
        if summary is not None:
            self._try(lambda: write_summary(self.folder, summary), "the summary")

    def _write_chunk(self) -> float:
        self._gather()
        self._try(self._mcap.flush, "the record")
        return FLUSH_PERIOD

    def _end(self) -> None:
        self._gather()
        self._try(self._finish, "the record")
        self._sink.close()

    def _gather(self) -> None:
        """Add the waiting messages to the chunk."""
        while self._waiting:
            self._try(self._add, "a message", self._waiting.popleft())

    def _add(self, message: Telemetry) -> None:
        if self._sink.broken:
            return
        received = getattr(message, "received", message.time)
        self._mcap.add_message(
            channel_id=self._channels[type(message)],
            log_time=self._nanoseconds(received),
            publish_time=self._nanoseconds(message.time),
            data=message_to_json(message),
        )
        self._public.add(message)

    def _nanoseconds(self, monotonic: float) -> int:
        return max(0, int((self._zero + monotonic) * 1e9))

    def _finish(self) -> None:
        if not self._sink.broken:
            self._mcap.finish()
            self._sink.flush()

    def _try(self, action: Callable[..., None], what: str, *arguments: Any) -> None:
        """Run the action; warn of the first failure of all. No exception may reach the flight."""
        try:
            action(*arguments)
        except Exception as error:
            if not self.failure:
                self.failure = f"{what} could not be written to {self.folder}: {error}"
                with contextlib.suppress(Exception):
                    self._warn(self.failure)


def _begin(mcap: Writer, header: RecordHeader) -> dict[type, int]:
    """Put the header on disk, and make a channel for each kind of message."""
    mcap.start(profile=PROFILE, library=f"cfplan {header.version}")
    mcap.add_metadata(METADATA, {"format": FORMAT, "header": header_to_json(header)})
    mcap.flush()
    channels = {}
    for topic in TOPICS:
        schema = json.dumps(json_schema(topic.message)).encode()
        schema_id = mcap.register_schema(f"cfplan.{topic.message.__name__}", "jsonschema", schema)
        channels[topic.message] = mcap.register_channel(topic.name, "json", schema_id)
    return channels


def _cannot_write(path: Path, error: OSError) -> InputError:
    return InputError(
        f"cannot be written ({error.strerror or error})", where=str(path), hint="choose a folder that can be written"
    )


class _Sink:
    """A file for the MCAP writer: a flush writes all or, on failure, leaves the file as it was before."""

    def __init__(self, file: RawFile):
        self.broken = False
        self._file = file
        self._pending = bytearray()
        self._written = 0

    def write(self, data: bytes) -> int:
        if not self.broken:
            self._pending += data
        return len(data)

    def tell(self) -> int:
        return self._written + len(self._pending)

    def flush(self) -> None:
        done = 0
        try:
            while not self.broken and done < len(self._pending):
                done += self._file.write(bytes(self._pending[done:])) or 0
        except OSError:
            self.broken = True
            self._file.truncate(self._written)
            raise
        finally:
            self._written += len(self._pending)
            self._pending.clear()

    def close(self) -> None:
        self._file.close()
