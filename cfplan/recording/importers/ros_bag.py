"""Read poses from ROS 1 and ROS 2 bags, as recorded from crazyswarm2, motion_capture_tracking and vicon_bridge."""

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from cfplan.errors import InputError
from cfplan.recording.importers.mocap_log import PLACE, QUATERNION, MocapLog, Table, in_order, subject

FORMAT, EXTRA = "ROS bag", "ros"
_SUFFIXES = {b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3", b"#ROSBAG V": ".bag"}  # by a file's first bytes
HEAD = re.compile(b"|".join(map(re.escape, _SUFFIXES)))
_CHANNELS = ("t", *PLACE, *QUATERNION)
_POSE, _COVARIANT_POSE, _TRANSFORM = (  # the fields of these channels except the time
    attrgetter(*(f"{place}.{axis}" for axis in "xyz"), *(f"{turn}.{axis}" for axis in "xyzw"))
    for place, turn in (
        ("pose.position", "pose.orientation"),
        ("pose.pose.position", "pose.pose.orientation"),
        ("transform.translation", "transform.rotation"),
    )
)
_NAMED_POSE = "motion_capture_tracking_interfaces/msg/NamedPose"
_TYPES = {  # the field with its poses if it holds several, the field with a pose's name, its fields
    "geometry_msgs/msg/PoseStamped": ("", "", _POSE),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("", "", _COVARIANT_POSE),
    "geometry_msgs/msg/TransformStamped": ("", "child_frame_id", _TRANSFORM),
    "nav_msgs/msg/Odometry": ("", "", _COVARIANT_POSE),
    "tf2_msgs/msg/TFMessage": ("transforms", "child_frame_id", _TRANSFORM),
    f"{_NAMED_POSE}Array": ("poses", "name", _POSE),
}


_DEFINITIONS = {  # of messages that are not ROS's own; bags of Humble in SQLite hold no definitions
    _NAMED_POSE: "string name\ngeometry_msgs/Pose pose\n",
    f"{_NAMED_POSE}Array": "std_msgs/Header header\nmotion_capture_tracking_interfaces/NamedPose[] poses\n",
}
_Message = tuple[str, str, int, Any]  # topic, type, time of receipt in ns, content


def read(file: Path) -> MocapLog:
    """Read every pose, named by its topic, or by its own name if a message holds several; times are from headers.

    Transforms are composed up to their root frame. A damaged or truncated MCAP file is read up to its last complete
    chunk.

    Raises InputError if the bag is damaged or no message in it holds a pose; ImportError without the extra.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _DEFINITIONS.items():
        types.register(get_types_from_msg(text, name))
    if not file.is_dir():
        _check_suffix(file)
    topics: set[str] = set()
    notes: list[str] = []
    try:
        rows, parents = _rows(_messages([file] if is_bag(file) else files_in(file), types, topics))
    # for damaged bytes the readers raise errors of their parts: struct, sqlite, lz4, zstd, yaml, keys
    except Exception as error:
        complete = [path for path in (files_in(file) if file.is_dir() else [file]) if path.suffix == ".mcap"]
        rows, parents = _rows(message for path in complete for message in _complete_messages(path, types, topics))
        if not rows:
            raise InputError(
                f"the bag cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:160]})",
                where=str(file),
                hint="damaged or cut off; `ros2 bag reindex` repairs a bag that was not closed",
            ) from error
        notes.append("the bag is damaged or cut off; what is complete before that is shown")
    truncated = bool(notes)
    if not rows:
        raise InputError(
            f"no topic holds poses; the bag has {', '.join(sorted(topics)[:8]) or 'none'}",
            where=str(file),
            hint=f"known: {', '.join(name.rpartition('/')[2] for name in _TYPES)}",
        )
    start = min(row[0] for listed in rows.values() for row in listed)
    tables = {}
    for name, listed in sorted(rows.items()):
        # Sorted first: a topic may have several writers, and a bag holds messages in the order in which they arrived.
        values = np.array(sorted(listed, key=lambda row: row[0])) - np.r_[start, np.zeros(7)]
        # motion_capture_tracking marks a lone point by an orientation of NaN.
        tables[name] = in_order(dict(zip(_CHANNELS, values.T, strict=True)), f"poses of {name}", notes)
    subjects = [subject(name, _in_root_frame(name, tables, parents)) for name in tables]
    roots = sorted(set(parents.values()) - set(tables))
    if len(roots) > 1:
        notes.append(f"poses are in the frames {', '.join(roots)}; their relation is not in the bag")
    return MocapLog(FORMAT, tuple(subjects), tuple(notes), truncated)


def is_bag(place: Path) -> bool:
    """Return whether rosbags reads a place as one bag: a file, or a folder with metadata."""
    return not place.is_dir() or (place / "metadata.yaml").is_file()


def files_in(folder: Path) -> list[Path]:
    """Return the files of bags in a folder."""
    return sorted(path for path in folder.glob("*") if path.suffix in _SUFFIXES.values())


def _messages(paths: list[Path], types: Any, topics: set[str]) -> Iterator[_Message]:
    """Yield all messages with poses, and add what each topic holds to `topics`."""
    from rosbags.highlevel import AnyReader

    with AnyReader(paths, default_typestore=types) as reader:
        topics |= {f"{connection.topic} ({connection.msgtype})" for connection in reader.connections}
        wanted = [connection for connection in reader.connections if connection.msgtype in _TYPES]
        for connection, received, raw in reader.messages(connections=wanted) if wanted else ():
            yield connection.topic, connection.msgtype, received, reader.deserialize(raw, connection.msgtype)


def _complete_messages(path: Path, types: Any, topics: set[str]) -> Iterator[_Message]:
    """Yield the messages of an MCAP file in its order, up to the damage."""
    from mcap.reader import NonSeekingReader

    with path.open("rb") as stream, suppress(Exception):
        reader = NonSeekingReader(stream, validate_crcs=True, record_size_limit=path.stat().st_size)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            kind = schema.name if schema else ""
            topics.add(f"{channel.topic} ({kind})")
            if kind in _TYPES:
                yield channel.topic, kind, message.log_time, types.deserialize_cdr(message.data, kind)


def _rows(messages: Iterable[_Message]) -> tuple[dict[str, list[tuple[float, ...]]], dict[str, str]]:
    """Return time and pose of each row by its subject, and the frame in which a transform states each."""
    rows: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    parents: dict[str, str] = {}
    for topic, kind, received, message in messages:
        several, named, pose = _TYPES[kind]
        for item in getattr(message, several) if several else [message]:
            header = (item if hasattr(item, "header") else message).header
            time = header.stamp.sec + header.stamp.nanosec * 1e-9 or received * 1e-9
            name = (getattr(item, named).lstrip("/") if named else "") or topic
            rows[name].append((time, *pose(item)))
            if pose is _TRANSFORM:
                parents[name] = header.frame_id.lstrip("/")
    return rows, parents


def _in_root_frame(name: str, tables: Mapping[str, Table], parents: Mapping[str, str]) -> Table:
    """Return the poses of a subject in the frame at the root of its transforms."""
    table, passed = tables[name], {name}
    while (name := parents.get(name, "")) in tables and name not in passed:
        passed.add(name)
        table = _composed(tables[name], table)
    return table


def _composed(parent: Table, child: Table) -> Table:
    """Return poses of `child`, which are in the frame `parent`, in the frame of `parent`'s own poses.

    Their times are those of the child, or of the parent if the child has a single one, as static transforms do. The
    other poses are interpolated, and held beyond their ends.
    """
    time = parent["t"] if len(child["t"]) == 1 else child["t"]
    (outer, outer_turn), (inner, inner_turn) = (_at(table, time) for table in (parent, child))
    place, turn = outer + outer_turn.apply(inner), (outer_turn * inner_turn).as_quat()
    return {"t": time, **dict(zip(_CHANNELS[1:], np.hstack([place, turn]).T, strict=True))}


def _at(table: Table, time: NDArray) -> tuple[NDArray, Rotation]:
    """Return the positions, (N, 3) m, and the rotations of a table's poses at other times."""
    values = np.stack([table[channel] for channel in _CHANNELS], axis=1)
    known = values[np.isfinite(values).all(axis=1) & values[:, 4:].any(axis=1)]
    if not len(known):
        return np.full((len(time), 3), np.nan), Rotation.identity(len(time))
    held = np.clip(time, known[0, 0], known[-1, 0])
    place = np.stack([np.interp(held, known[:, 0], axis) for axis in known[:, 1:4].T], axis=1)
    turn = Rotation.from_quat(known[:, 4:])
    return place, Slerp(known[:, 0], turn)(held) if len(known) > 1 else turn[np.zeros(len(time), dtype=int)]


def _check_suffix(file: Path) -> None:
    with file.open("rb") as stream:
        head = HEAD.match(stream.read(max(map(len, _SUFFIXES))))
    wanted = _SUFFIXES[head[0]] if head else file.suffix
    if file.suffix != wanted:
        hint = f"give it the suffix {wanted}"
        raise InputError("the suffix is not that of the bag's format", where=str(file), hint=hint)
