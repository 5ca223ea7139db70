"""Records by public schemas: read with Foxglove's own, and by rerun, without cfplan."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
import rerun_cli
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from cfplan.recording.header import RecordHeader
from cfplan.recording.writer import RecordWriter

RERUN = Path(rerun_cli.__file__).with_name("rerun")


@pytest.fixture(scope="module")
def public(flight):
    """The messages of each public topic, decoded by the schemas in the file."""
    found: dict[str, list] = {}
    with open(flight.folder / "flight.mcap", "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        topics = [f"/public/{name}" for name in ("pose", "setpoint", "tf", "scene", "log")]
        for schema, channel, message, content in reader.iter_decoded_messages(topics=topics):
            assert schema.name.startswith("foxglove.")
            found.setdefault(channel.topic, []).append((message, content))
    return found


def places(contents) -> np.ndarray:
    return np.array([[pose.position.x, pose.position.y, pose.position.z] for pose in contents])


def test_poses_and_setpoints_are_those_of_the_record(flight, public):
    record, zero = flight.record, flight.header.wall_time_at_zero
    for topic, stream in (("/public/pose", record.poses), ("/public/setpoint", record.setpoints)):
        contents = [content for _, content in public[topic]]
        assert {content.frame_id for content in contents} == {"room"}
        np.testing.assert_array_equal(places([content.pose for content in contents]), stream.position)
        turns = [[getattr(content.pose.orientation, axis) for axis in "xyzw"] for content in contents]
        np.testing.assert_array_equal(turns, stream.quaternion)
        stamps = np.array([content.timestamp.ToNanoseconds() for content in contents]) / 1e9
        np.testing.assert_allclose(stamps, zero + stream.time, atol=1e-6)


def test_the_vehicles_frame_is_its_own_estimate_in_the_room(flight, public):
    frames = [content for _, content in public["/public/tf"]]
    assert {(frame.parent_frame_id, frame.child_frame_id) for frame in frames} == {("room", "vehicle")}
    moved = np.array([[getattr(frame.translation, axis) for axis in "xyz"] for frame in frames])
    np.testing.assert_array_equal(moved, flight.record.estimates.position)


def test_the_room_and_the_path_are_there_from_the_first_message_on(flight, public):
    ((message, scene),) = public["/public/scene"]
    assert message.log_time <= min(other.log_time for topic in public for other, _ in public[topic])
    room, path, vehicle = scene.entities
    (edges,) = room.lines
    corners = np.array([[point.x, point.y, point.z] for point in edges.points])
    assert len(corners) == 24
    np.testing.assert_array_equal([corners.min(axis=0), corners.max(axis=0)], flight.header.fence)
    lengths = np.linalg.norm(corners[1::2] - corners[::2], axis=1)
    sides = np.subtract(*flight.header.fence[::-1])
    assert sorted(lengths) == pytest.approx(sorted(np.repeat(sides, 4)))
    (line,) = path.lines
    np.testing.assert_allclose([[point.x, point.y, point.z] for point in line.points], flight.header.path)
    assert vehicle.frame_id == "vehicle"


def test_the_log_has_events_and_phases(flight, public):
    said = [content.message for _, content in public["/public/log"]]
    assert sorted(said) == sorted([*flight.record.events.text, *flight.record.phases.phase])


def test_what_is_not_finite_is_left_out(tmp_path, small_header: RecordHeader, flight):
    from cfplan.flight.telemetry import PoseReceived

    with RecordWriter(tmp_path / "flight", small_header) as writer:
        writer.write(PoseReceived(1.0, 1.0, (float("nan"), 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        writer.write(PoseReceived(2.0, 2.0, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    assert writer.failure == ""
    with open(tmp_path / "flight" / "flight.mcap", "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        ((_, _, _, pose),) = reader.iter_decoded_messages(topics=["/public/pose"])
    assert pose.pose.position.x == 1.0


@pytest.mark.integration
def test_rerun_opens_a_record_without_cfplan(flight, tmp_path):
    """Its own reader turns poses and frames into what its viewer draws."""
    file = tmp_path / "flight.rrd"
    done = subprocess.run(
        [RERUN, "mcap", "convert", flight.folder / "flight.mcap", "-o", file],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    shown = subprocess.run([RERUN, "rrd", "print", "-v", file], capture_output=True, text=True, check=True).stdout
    assert "/public/pose" in shown
    assert "Transform3D" in shown
    assert "InstancePoses3D" in shown
