"""Read ROS 2 bags (and ROS 1's) with poses, as crazyswarm2, motion_capture_tracking and vicon_bridge record them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cfplan.errors import InputError
from cfplan.recording.importers.mocap_log import LoggedSubject, MocapLog, ascending, unit_quaternions

FORMAT = "ROS bag"
_MCAP, _SQLITE, _ROS1 = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"#ROSBAG V"
_SUFFIXES = {_MCAP: ".mcap", _SQLITE: ".db3", _ROS1: ".bag"}
_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
    "tf2_msgs/msg/TFMessage",
    "motion_capture_tracking_interfaces/msg/NamedPoseArray",
)
_Row = tuple[float, float, float, float, float, float, float, float]


def recognises(file: Path, head: bytes) -> bool:
    """Return whether this is a bag's folder or file. Records of cfplan, MCAP too, are recognised before."""
    if file.is_dir():
        return (file / "metadata.yaml").is_file()
    return head.startswith(tuple(_SUFFIXES))


def read(file: Path) -> MocapLog:
    """Read every pose by its topic, or by its name where a message holds several; times are of the messages' headers.

    Raises InputError where the extra is not installed, the bag is damaged, or no message in it holds a pose.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(
            "ROS bags need the package rosbags", where=str(file), hint="pip install 'cfplan[ros]'"
        ) from error
    if not file.is_dir():
        _check_suffix(file)
    rows: dict[str, list[_Row]] = {}
    try:
        with AnyReader([file], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            wanted = [connection for connection in reader.connections if connection.msgtype in _TYPES]
            if not wanted:
                topics = sorted({f"{c.topic} ({c.msgtype})" for c in reader.connections})
                raise InputError(
                    f"no topic holds poses; the bag has {', '.join(topics[:8]) or 'none'}",
                    where=str(file),
                    hint=f"known: {', '.join(name.rpartition('/')[2] for name in _TYPES)}",
                )
            for connection, received, raw in reader.messages(connections=wanted):
                message = reader.deserialize(raw, connection.msgtype)
                for name, row in _poses(connection.topic, connection.msgtype, message, received * 1e-9):
                    rows.setdefault(name, []).append(row)
    except InputError:
        raise
    # on damaged bytes the readers raise what their parts raise: struct, sqlite, lz4, zstd, yaml, keys
    except Exception as error:
        raise InputError(
            f"the bag cannot be read ({type(error).__name__}: {_one_line(error)})",
            where=str(file),
            hint="damaged or cut off; `ros2 bag reindex` repairs a bag that was not closed",
        ) from error
    start = min((row[0] for table in rows.values() for row in table), default=0.0)
    notes: list[str] = []
    subjects = tuple(_subject(name, table, start, notes) for name, table in sorted(rows.items()))
    return MocapLog(FORMAT, subjects, tuple(notes), truncated=False)


def _check_suffix(file: Path) -> None:
    with file.open("rb") as stream:
        head = stream.read(len(_SQLITE))
    wanted = next(suffix for magic, suffix in _SUFFIXES.items() if head.startswith(magic))
    if file.suffix != wanted:
        raise InputError(
            "the suffix is not that of the bag's format", where=str(file), hint=f"give it the suffix {wanted}"
        )


def _poses(topic: str, kind: str, message: Any, received: float) -> Iterator[tuple[str, _Row]]:
    name = kind.rpartition("/")[2]
    if name == "TFMessage":
        for transform in message.transforms:
            yield transform.child_frame_id.lstrip("/"), _transform(transform, received)
    elif name == "TransformStamped":
        yield message.child_frame_id.lstrip("/") or topic, _transform(message, received)
    elif name == "NamedPoseArray":
        time = _stamp(message.header, received)
        for item in message.poses:
            yield item.name, _row(time, item.pose.position, item.pose.orientation)
    else:
        pose = message.pose if name == "PoseStamped" else message.pose.pose
        yield topic, _row(_stamp(message.header, received), pose.position, pose.orientation)


def _transform(message: Any, received: float) -> _Row:
    transform = message.transform
    return _row(_stamp(message.header, received), transform.translation, transform.rotation)


def _stamp(header: Any, received: float) -> float:
    """Return s; the time of receipt where the header has no stamp."""
    stamp = header.stamp
    return stamp.sec + stamp.nanosec * 1e-9 if stamp.sec or stamp.nanosec else received


def _row(time: float, place: Any, turn: Any) -> _Row:
    return time, place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w


def _subject(name: str, table: list[_Row], start: float, notes: list[str]) -> LoggedSubject:
    values = np.array(table)
    # Sorted first: a topic may have several writers, and a bag holds messages in the order in which they arrived.
    values = values[np.argsort(values[:, 0], kind="stable")]
    keep = ascending(values[:, 0])
    if not keep.all():
        notes.append(f"{np.sum(~keep)} poses of {name} left out, as their stamps repeat")
    values = values[keep]
    # motion_capture_tracking marks a lone point by an orientation of NaN.
    quaternion = unit_quaternions(values[:, 4:], tolerance=np.inf)
    return LoggedSubject(name, values[:, 0] - start, values[:, 1:4], quaternion)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:160]
