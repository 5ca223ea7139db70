"""Read poses from ROS 1 and ROS 2 bags, as recorded from crazyswarm2, motion_capture_tracking and vicon_bridge."""

import re
from collections import defaultdict
from operator import attrgetter
from pathlib import Path

import numpy as np

from cfplan.errors import InputError
from cfplan.recording.importers.mocap_log import PLACE, QUATERNION, MocapLog, in_order, subject

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
_TYPES = {  # the field with its poses if it holds several, the field with a pose's name, its fields
    "geometry_msgs/msg/PoseStamped": ("", "", _POSE),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("", "", _COVARIANT_POSE),
    "geometry_msgs/msg/TransformStamped": ("", "child_frame_id", _TRANSFORM),
    "nav_msgs/msg/Odometry": ("", "", _COVARIANT_POSE),
    "tf2_msgs/msg/TFMessage": ("transforms", "child_frame_id", _TRANSFORM),
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": ("poses", "name", _POSE),
}


def read(file: Path) -> MocapLog:
    """Read every pose, named by its topic, or by its own name if a message holds several; times are from headers.

    Raises InputError if the bag is damaged or no message in it holds a pose; ImportError without the extra.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if not file.is_dir():
        _check_suffix(file)
    rows: dict[str, list[tuple[float, ...]]] = defaultdict(list)
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
                several, named, pose = _TYPES[connection.msgtype]
                message = reader.deserialize(raw, connection.msgtype)
                for item in getattr(message, several) if several else [message]:
                    stamp = (item if hasattr(item, "header") else message).header.stamp
                    time = stamp.sec + stamp.nanosec * 1e-9 or received * 1e-9
                    name = getattr(item, named).lstrip("/") if named else ""
                    rows[name or connection.topic].append((time, *pose(item)))
    except InputError:
        raise
    # for damaged bytes the readers raise errors of their parts: struct, sqlite, lz4, zstd, yaml, keys
    except Exception as error:
        raise InputError(
            f"the bag cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:160]})",
            where=str(file),
            hint="damaged or cut off; `ros2 bag reindex` repairs a bag that was not closed",
        ) from error
    start = min((row[0] for listed in rows.values() for row in listed), default=0.0)
    notes: list[str] = []
    subjects = []
    for name, listed in sorted(rows.items()):
        # Sorted first: a topic may have several writers, and a bag holds messages in the order in which they arrived.
        values = np.array(sorted(listed, key=lambda row: row[0])) - np.r_[start, np.zeros(7)]
        # motion_capture_tracking marks a lone point by an orientation of NaN.
        table = in_order(dict(zip(_CHANNELS, values.T, strict=True)), f"poses of {name}", notes)
        subjects.append(subject(name, table))
    return MocapLog(FORMAT, tuple(subjects), tuple(notes), truncated=False)


def _check_suffix(file: Path) -> None:
    with file.open("rb") as stream:
        head = HEAD.match(stream.read(max(map(len, _SUFFIXES))))
    wanted = _SUFFIXES[head[0]] if head else file.suffix
    if file.suffix != wanted:
        hint = f"give it the suffix {wanted}"
        raise InputError("the suffix is not that of the bag's format", where=str(file), hint=hint)
