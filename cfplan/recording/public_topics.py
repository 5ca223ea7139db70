"""Public topics of a record: poses, the vehicle's frame, the room and the log, in Foxglove's schemas.

Foxglove, rerun and PlotJuggler show these without cfplan; cfplan itself reads only its own topics. All three support
Protobuf. Frames are `room`, and `vehicle` at the vehicle's own estimate.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from cfplan.flight import telemetry
from cfplan.recording.header import RecordHeader
from cfplan.safety.space import Obstacle

ROOM, VEHICLE = "room", "vehicle"
POSE, SETPOINT, TRANSFORM, SCENE, LOG = (f"/public/{name}" for name in ("pose", "setpoint", "tf", "scene", "log"))
SCHEMAS: dict[str, Any] = {
    POSE: PoseInFrame, SETPOINT: PoseInFrame, TRANSFORM: FrameTransform, SCENE: SceneUpdate, LOG: Log,
}  # fmt: skip
WIDTH, HEIGHT = 0.13, 0.04  # m, of the box that stands for the vehicle
_LEVELS = {
    telemetry.Level.INFO: Log.Level.INFO,
    telemetry.Level.WARNING: Log.Level.WARNING,
    telemetry.Level.ERROR: Log.Level.ERROR,
}


class PublicTopics:
    """Adds the public topics to a record's MCAP file."""

    def __init__(self, mcap: Writer, header: RecordHeader, nanoseconds: Callable[[float], int]):
        self._mcap, self._header, self._nanoseconds = mcap, header, nanoseconds
        self._channels = {
            topic: mcap.register_channel(topic, "protobuf", register_schema(mcap, schema))
            for topic, schema in SCHEMAS.items()
        }
        self._has_scene = False

    def add(self, message: telemetry.Telemetry) -> None:
        """Add the public topics of a message, if it has any; the room and the path come with the first."""
        log_time = self._nanoseconds(getattr(message, "received", message.time))
        if not self._has_scene:
            self._has_scene = True
            self._send(SCENE, _scene(self._header), log_time, log_time)
        for topic, content in _topics_of(message):
            self._send(topic, content, log_time, self._nanoseconds(message.time))

    def _send(self, topic: str, content: Any, log_time: int, time: int) -> None:
        for stamped in content.entities if topic == SCENE else (content,):
            stamped.timestamp.FromNanoseconds(time)
        self._mcap.add_message(self._channels[topic], log_time, content.SerializeToString(), time)


def _topics_of(message: telemetry.Telemetry) -> Iterator[tuple[str, Any]]:
    """Return a message in public schemas, without time stamps; nothing for values that are not finite."""
    match message:
        case telemetry.PoseReceived() | telemetry.SetpointSent():
            if _finite(message):
                topic = POSE if isinstance(message, telemetry.PoseReceived) else SETPOINT
                found = PoseInFrame(frame_id=ROOM)
                _put(found.pose, message)
                yield topic, found
        case telemetry.Estimate():
            if _finite(message):
                frame = FrameTransform(parent_frame_id=ROOM, child_frame_id=VEHICLE)
                frame.translation.x, frame.translation.y, frame.translation.z = message.position
                turn = frame.rotation
                turn.x, turn.y, turn.z, turn.w = message.quaternion
                yield TRANSFORM, frame
        case telemetry.Event():
            yield LOG, Log(level=_LEVELS[message.level], message=message.text, name="pilot")
        case telemetry.PhaseEntered():
            yield LOG, Log(level=Log.Level.INFO, message=str(message.phase), name="phase")


def _finite(message: Any) -> bool:
    return all(math.isfinite(value) for value in (*message.position, *message.quaternion))


def _put(pose: Any, message: Any) -> None:
    pose.position.x, pose.position.y, pose.position.z = message.position
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = message.quaternion


def _scene(header: RecordHeader) -> SceneUpdate:
    """Return the room's edges and the path, in the room, and a box in the place of the vehicle."""
    scene = SceneUpdate()
    room = scene.entities.add(frame_id=ROOM, id="room")
    edges = room.lines.add(type=LinePrimitive.LINE_LIST, thickness=0.01)
    edges.color.r = edges.color.g = edges.color.b = 0.5
    edges.color.a = 1.0
    low, high = header.fence
    for a, b in _edges():
        for corner in (a, b):
            edges.points.add(**{axis: (low, high)[corner[k]][k] for k, axis in enumerate("xyz")})
    for obstacle in header.obstacles:
        _add_solid(room, obstacle)
    path = scene.entities.add(frame_id=ROOM, id="path")
    line = path.lines.add(type=LinePrimitive.LINE_STRIP, thickness=0.015)
    line.color.g, line.color.b, line.color.a = 0.6, 0.9, 1.0
    for x, y, z in header.path:
        line.points.add(x=x, y=y, z=z)
    vehicle = scene.entities.add(frame_id=VEHICLE, id="vehicle", frame_locked=True)
    box = vehicle.cubes.add()
    box.pose.orientation.w = 1.0
    box.size.x = box.size.y = WIDTH
    box.size.z = HEIGHT
    box.color.r, box.color.g, box.color.a = 0.9, 0.6, 1.0
    return scene


def _add_solid(room: Any, obstacle: Obstacle) -> None:
    x, y, z, wide, deep, tall, radius, yaw = obstacle.prism
    solid = (room.cylinders if radius else room.cubes).add()
    solid.pose.position.x, solid.pose.position.y, solid.pose.position.z = x, y, z
    solid.pose.orientation.z, solid.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    solid.size.x, solid.size.y, solid.size.z = 2 * (wide + radius), 2 * (deep + radius), 2 * tall
    if radius:
        solid.bottom_scale = solid.top_scale = 1.0
    solid.color.r, solid.color.g, solid.color.b, solid.color.a = 0.5, 0.4, 0.3, 1.0


def _edges() -> Iterator[tuple[tuple[int, int, int], tuple[int, int, int]]]:
    """Return the twelve edges of a box by its corners, 0 low and 1 high along each axis."""
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    for a in corners:
        for k in range(3):
            if not a[k]:
                b = (*a[:k], 1, *a[k + 1 :])
                yield a, (b[0], b[1], b[2])
