"""The topics of a record's MCAP file: for each kind of message its JSON Schema, and the way to JSON and back."""

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import json as pa_json

from cfplan.files.json_values import json_value
from cfplan.flight import telemetry
from cfplan.recording import record

PROFILE = "cfplan"  # the profile that our MCAP files name; a file with another is not a record
METADATA = "cfplan"  # the metadata entry that holds format and header
_BLOCK = 1 << 21  # bytes of JSON that one core reads at a time
FORMAT = "1"  # raised when older versions can no longer read a record


@dataclass(frozen=True, slots=True)
class Topic:
    """One kind of message and the columns that it is read back into."""

    name: str
    message: type
    columns: type
    stream: str  # its field in Record


TOPICS = (
    Topic("/setpoint", telemetry.SetpointSent, record.Setpoints, "setpoints"),
    Topic("/pose", telemetry.PoseReceived, record.Poses, "poses"),
    Topic("/estimate", telemetry.Estimate, record.Estimates, "estimates"),
    Topic("/status", telemetry.VehicleStatus, record.StatusReports, "status"),
    Topic("/phase", telemetry.PhaseEntered, record.Phases, "phases"),
    Topic("/event", telemetry.Event, record.Events, "events"),
    Topic("/committed", telemetry.PlanCommitted, record.Commitments, "commitments"),
    Topic("/request", telemetry.PathRequested, record.Requests, "requests"),
    Topic("/answer", telemetry.PathAnswered, record.Answers, "answers"),
)
_NAMES = {topic.message: tuple(field.name for field in fields(topic.message)) for topic in TOPICS}


def json_schema(message: type) -> dict[str, Any]:
    """Return the JSON Schema of a message type, from its fields."""
    hints = get_type_hints(message)
    return {
        "title": message.__name__,
        "description": f"{message.__doc__} A number that is not finite is null.",
        "type": "object",
        "properties": {f.name: _schema(hints[f.name]) for f in fields(message)},
        "required": [f.name for f in fields(message)],
    }


def _schema(kind: Any) -> dict[str, Any]:
    if get_origin(kind) is tuple:
        items = get_args(kind)
        return {"type": "array", "items": _schema(items[0]), "minItems": len(items), "maxItems": len(items)}
    if issubclass(kind, StrEnum):
        return {"type": "string", "enum": [item.value for item in kind]}
    if kind is bytes:
        return {"type": "string", "contentEncoding": "base64"}
    return {"type": {float: "number", int: "integer", str: "string"}[kind]}


def message_to_json(message: telemetry.Telemetry) -> bytes:
    """Return the message as JSON. Exact: a float reads back as the same float."""
    values = {name: getattr(message, name) for name in _NAMES[type(message)]}
    try:
        return _to_json(values).encode()
    except ValueError:
        values = {name: _from_numpy(v) if isinstance(v, bytes) else v for name, v in values.items()}
        return json.dumps(json_value(values), separators=(",", ":"), allow_nan=False).encode()


def _from_numpy(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    raise TypeError(f"a {type(value).__name__} does not belong into a message")


_to_json = json.JSONEncoder(separators=(",", ":"), allow_nan=False, default=_from_numpy).encode


def columns_from_json(topic: Topic, payloads: list[bytes]) -> Any:
    """Return the messages of one topic as arrays. Raises ValueError, KeyError or TypeError for other messages."""
    hints = get_type_hints(topic.message)
    names = [f.name for f in fields(topic.columns)]
    if not payloads:
        return topic.columns(**{name: _column([], hints[name]) for name in names})
    for name in names:
        json.loads(payloads[0])[name]  # Arrow reads a missing field as null
    schema = pa.schema([(name, _arrow_type(hints[name])) for name in names])
    lines = b"\n".join(payloads)
    if lines.count(b"\n") >= len(payloads):  # other writers may spread a message over lines
        lines = b"\n".join(payload.replace(b"\n", b" ") for payload in payloads)
    table = pa_json.read_json(
        pa.BufferReader(lines),
        pa_json.ReadOptions(block_size=max(_BLOCK, 1 + max(map(len, payloads)))),
        pa_json.ParseOptions(explicit_schema=schema, unexpected_field_behavior="ignore"),
    )
    if len(table) != len(payloads):
        raise ValueError(f"{len(table)} messages in {len(payloads)} entries")
    return topic.columns(**{name: _array(table.column(name).combine_chunks(), hints[name]) for name in names})


def _arrow_type(kind: Any) -> pa.DataType:
    items = get_args(kind)
    if items:
        return pa.list_(_arrow_type(items[0]))
    return pa.string() if issubclass(kind, str | bytes) else pa.int64() if kind is int else pa.float64()


def _array(values: Any, kind: Any) -> NDArray:
    """Return an Arrow column as an array: null becomes NaN, and is an error where that cannot be."""
    items = get_args(kind)
    if items:
        lengths = values.value_lengths()
        if values.null_count or set(lengths.unique().to_pylist()) != {len(items)}:
            raise ValueError(f"not {len(items)} numbers each")
        return _array(values.flatten(), items[0]).reshape(-1, len(items))
    if values.null_count and kind is not float:
        raise ValueError("a value is missing")
    if kind is bytes:
        return _objects([base64.b64decode(value, validate=True) for value in values.to_pylist()])
    if issubclass(kind, str):
        return np.array(values.to_pylist(), dtype=np.str_)
    return values.to_numpy(zero_copy_only=False)


def columns_of(topic: Topic, messages: Sequence[telemetry.Telemetry]) -> Any:
    """Return messages of one topic as arrays, as they would be read back from a record."""
    hints = get_type_hints(topic.message)
    return topic.columns(
        **{f.name: _column([getattr(m, f.name) for m in messages], hints[f.name]) for f in fields(topic.columns)}
    )


def _column(values: list[Any], kind: Any) -> NDArray:
    items = get_args(kind)
    item = items[0] if items else kind
    if kind is bytes:
        return _objects(values)
    if not items and issubclass(item, str):
        return np.array([str(value) for value in values], dtype=np.str_)
    shape = (len(values), len(items)) if items else (len(values),)
    return np.array(values, dtype=np.int64 if item is int else np.float64).reshape(shape)


def _objects(values: list[Any]) -> NDArray:
    """Return (N,) objects of any lengths."""
    out = np.empty(len(values), dtype=object)
    out[:] = values
    return out
