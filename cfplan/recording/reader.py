"""Read a record, complete or as far as it is readable."""

import io
import json
import struct
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Header, McapRecord, Metadata, Statistics
from mcap.stream_reader import get_chunk_data_stream

from cfplan.errors import InputError
from cfplan.files.json_values import replace_surrogates
from cfplan.recording.commitments import check_commitments
from cfplan.recording.header import RecordHeader, header_from_json
from cfplan.recording.plausible import check_places, check_times, check_values
from cfplan.recording.record import FLIGHT_FILE, SUMMARY_FILE, Record
from cfplan.recording.topics import FORMAT, METADATA, PROFILE, TOPICS, columns_from_json

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE_HEAD = 22  # bytes: channel, sequence, log time, publish time
_READERS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.HEADER: Header.read,
    Opcode.METADATA: Metadata.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.FOOTER: Footer.read,
}
_DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    EOFError,
    MemoryError,
    OverflowError,
    RecursionError,
)


def read_record(place: Path) -> Record:
    """Read the record in a folder, or in the MCAP file itself.

    Parts that were cut off or damaged are left out, and `truncated` is set. Raises InputError if the place holds no
    record of cfplan, or not even its header.
    """
    file = _find(Path(place))
    data = _read(file)
    header: RecordHeader | None = None
    topics: dict[int, str] = {}
    payloads: dict[int, list[bytes]] = defaultdict(list)
    whole, written = False, None
    for entry in _entries(data, len(MAGIC), payloads):
        match entry:
            case Header(profile=profile) if profile != PROFILE:
                raise _foreign_file(file, f"its profile is {profile[:40]!r}")
            case Metadata(name=name, metadata=values) if name == METADATA:
                header = _header(values, file)
            case Channel(id=number, topic=name):
                topics[number] = name
            case Statistics(message_count=count):
                written = count
            case Footer():  # a chunk whose own kind is damaged is passed over, and then messages are missing
                whole = data.endswith(MAGIC) and written in (None, sum(map(len, payloads.values())))
    if header is None:
        raise InputError(
            "the record ends before its header; nothing of it can be read",
            where=str(file),
            hint="the flight ended as the record was opened, or copying it failed",
        )
    streams = {}
    for topic in TOPICS:
        own = [payload for number, name in topics.items() if name == topic.name for payload in payloads[number]]
        streams[topic.stream] = _columns(topic, own, file)
    record = Record(folder=file.parent, header=header, summary=_summary(file.parent), truncated=not whole, **streams)
    _check_plausible(record, file)
    return record


def _check_plausible(record: Record, file: Path) -> None:
    """Raise InputError if a message has an implausible time or place."""
    for topic in TOPICS:
        stream = getattr(record, topic.stream)
        check_times(stream.time, topic.name, where=str(file))
        if hasattr(stream, "position"):
            check_places(stream.position, topic.name, where=str(file))
        for column in fields(stream):
            check_values(getattr(stream, column.name), f"{topic.name} {column.name}", where=str(file))
    check_commitments(record.commitments, where=str(file))
    check_times(record.setpoints.due, "the setpoints' deadlines", where=str(file))
    check_times(record.poses.received, "the poses' arrivals", where=str(file))
    ends = [record.start, record.start + record.duration]
    check_times(np.r_[ends, record.setpoints.due, record.poses.received], "the record", where=str(file))
    header = record.header
    figures = [*astuple(header.bounds), header.travel_time, header.thrust_at_full_command]
    check_values(np.array(figures), "the header", where=str(file))
    if not np.isfinite(record.header.fence).all():
        raise InputError("the header's fence is not finite", where=str(file), hint="the record was changed since")
    prisms = np.array([each.prism for each in header.obstacles]).reshape(-1, 8)
    check_values(prisms.ravel(), "the header's obstacles", where=str(file))
    check_places(prisms[:, :3], "the header's obstacles", where=str(file))
    check_values(header.shift.ravel(), "the header's shift", where=str(file))
    check_places(np.vstack([header.path, header.fence, header.shift]), "the header", where=str(file))


def is_record(place: Path) -> bool:
    """Return whether a folder or a file is a record of cfplan, damaged or not; other MCAP files and logs are not."""
    if place.is_fifo():
        return False
    if place.name == FLIGHT_FILE or (place / FLIGHT_FILE).exists():
        return True
    try:
        with place.open("rb") as stream:
            head = stream.read(len(MAGIC) + _RECORD.size + 4 + len(PROFILE))
    except OSError:
        return False
    return head.startswith(MAGIC) and head.endswith(PROFILE.encode())


def _find(place: Path) -> Path:
    if place.is_dir():
        file = place / FLIGHT_FILE
        if not file.is_file():
            raise InputError(
                f"the folder holds no {FLIGHT_FILE}",
                where=str(place),
                hint="name the folder of one flight; `cfplan replay records` lists those in records/",
            )
        return file
    if place.is_fifo():
        raise InputError("a pipe, not a record", where=str(place), hint="name the folder of one flight")
    if not place.exists():
        raise InputError("no such record", where=str(place), hint="`cfplan fly` prints the folder of each record")
    return place


def _read(file: Path) -> bytes:
    try:
        data = file.read_bytes()
    except OSError as error:
        raise InputError(
            f"cannot be read ({error.strerror or error})", where=str(file), hint="look at the file's permissions"
        ) from error
    if not data:
        raise InputError("the record is empty", where=str(file), hint="the flight ended as the record was opened")
    if not data.startswith(MAGIC):
        if MAGIC.startswith(data):
            raise InputError(
                "the record ends before its header; nothing of it can be read",
                where=str(file),
                hint="the flight ended before anything was recorded",
            )
        raise _foreign_file(file, "it is no MCAP file")
    return data


def _foreign_file(file: Path, reason: str) -> InputError:
    return InputError(
        f"not a record of cfplan: {reason}", where=str(file), hint=f"name a flight's folder or its {FLIGHT_FILE}"
    )


def _header(values: Mapping[str, str], file: Path) -> RecordHeader:
    if values.get("format") != FORMAT:
        raise InputError(
            f"the record has format {values.get('format', '')[:20]!r}, this version reads {FORMAT!r}",
            where=str(file),
            hint="use the version of cfplan that wrote it, or a newer one",
        )
    return header_from_json(values.get("header", ""), where=str(file))


def _entries(data: bytes, place: int, payloads: dict[int, list[bytes]]) -> Iterator[McapRecord]:
    """Yield the relevant MCAP records from `place` on, also those in chunks, up to the first cut off or damaged.

    Messages are too many to be objects: their contents are put into `payloads` by their channel.
    """
    message, head, size = int(Opcode.MESSAGE), _RECORD.unpack_from, _RECORD.size
    try:
        while True:
            opcode, length = head(data, place)
            begin = place + size
            place = begin + length
            if place > len(data):
                return
            if opcode == message:
                payloads[int.from_bytes(data[begin : begin + 2], "little")].append(data[begin + _MESSAGE_HEAD : place])
            elif opcode in _READERS:
                entry = _READERS[opcode](ReadDataStream(io.BytesIO(data[begin:place])))
                if isinstance(entry, Chunk):
                    stream, unpacked = get_chunk_data_stream(entry, validate_crc=True)
                    yield from _entries(stream.read(unpacked), 0, payloads)
                else:
                    yield entry
    except _DAMAGE:
        return


def _columns(topic: Any, payloads: list[bytes], file: Path) -> Any:
    try:
        return columns_from_json(topic, payloads)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"the messages of {topic.name} cannot be read ({type(error).__name__}: {error})".replace("\n", " "),
            where=str(file),
            hint="the record was written by another version of cfplan, or changed since",
        ) from error


def _summary(folder: Path) -> Mapping[str, Any]:
    if not (folder / SUMMARY_FILE).is_file():
        return {}
    try:
        summary = replace_surrogates(json.loads((folder / SUMMARY_FILE).read_text(encoding="utf-8")))
    except (OSError, ValueError, RecursionError):
        return {}
    return summary if isinstance(summary, dict) else {}
