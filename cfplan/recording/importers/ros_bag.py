"""Read ROS 2 bags (and ROS 1's) with poses, as crazyswarm2, motion_capture_tracking and vicon_bridge record them."""

from operator import attrgetter
from pathlib import Path

import numpy as np

from cfplan.errors import InputError
from cfplan.recording.importers.mocap_log import LoggedSubject, MocapLog, growing, unit_quaternions

FORMAT = "ROS bag"
_SUFFIXES = {b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3", b"#ROSBAG V": ".bag"}  # by a file's first bytes
_POSE = attrgetter("pose.position", "pose.orientation")
_COVARIANT_POSE = attrgetter("pose.pose.position", "pose.pose.orientation")
_TRANSFORM = attrgetter("transform.translation", "transform.rotation")
_TYPES = {  # the field with its poses if it holds several, the field with a pose's name, its place and turn
    "geometry_msgs/msg/PoseStamped": ("", "", _POSE),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("", "", _COVARIANT_POSE),
    "geometry_msgs/msg/TransformStamped": ("", "child_frame_id", _TRANSFORM),
    "nav_msgs/msg/Odometry": ("", "", _COVARIANT_POSE),
    "tf2_msgs/msg/TFMessage": ("transforms", "child_frame_id", _TRANSFORM),
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": ("poses", "name", _POSE),
}


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
        hint = "pip install 'cfplan[ros]'"
        raise InputError("ROS bags need the package rosbags", where=str(file), hint=hint) from error
    if not file.is_dir():
        _check_suffix(file)
    tables: dict[str, list[tuple[float, ...]]] = {}
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
                    stamped = stamp.sec or stamp.nanosec
                    time = stamp.sec + stamp.nanosec * 1e-9 if stamped else received * 1e-9
                    name = getattr(item, named).lstrip("/") if named else ""
                    p, q = pose(item)
                    tables.setdefault(name or connection.topic, []).append((time, p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    except InputError:
        raise
    # on damaged bytes the readers raise what their parts raise: struct, sqlite, lz4, zstd, yaml, keys
    except Exception as error:
        raise InputError(
            f"the bag cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:160]})",
            where=str(file),
            hint="damaged or cut off; `ros2 bag reindex` repairs a bag that was not closed",
        ) from error
    start = min((row[0] for table in tables.values() for row in table), default=0.0)
    notes: list[str] = []
    subjects = []
    for name, table in sorted(tables.items()):
        values = np.array(table)
        # Sorted first: a topic may have several writers, and a bag holds messages in the order in which they arrived.
        values = values[np.argsort(values[:, 0], kind="stable")]
        values = values[growing(values[:, 0], f"poses of {name}", notes)]
        # motion_capture_tracking marks a lone point by an orientation of NaN.
        subjects.append(LoggedSubject(name, values[:, 0] - start, values[:, 1:4], unit_quaternions(values[:, 4:])))
    return MocapLog(FORMAT, tuple(subjects), tuple(notes), truncated=False)


def _check_suffix(file: Path) -> None:
    with file.open("rb") as stream:
        head = stream.read(max(map(len, _SUFFIXES)))
    wanted = next(suffix for magic, suffix in _SUFFIXES.items() if head.startswith(magic))
    if file.suffix != wanted:
        hint = f"give it the suffix {wanted}"
        raise InputError("the suffix is not that of the bag's format", where=str(file), hint=hint)
