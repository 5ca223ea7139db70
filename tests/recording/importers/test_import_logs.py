"""Logs of the microSD card, crazyswarm2, ROS and MAVLink: written here by their layouts, read back equal."""

import math
import struct
import zlib

import numpy as np
import pytest
from damaged_logs import check_damaged, log_or_error
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.recording.importers.formats import find_importer, read_log

COUNT = 30
TIMES = np.arange(COUNT) * 0.01
START = 1_700_000_000.0  # s since 1970


def poses(seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-3, 3, (COUNT, 3)), Rotation.random(COUNT, rng=rng)


def assert_same(subject, position, rotations, atol=1e-6):
    np.testing.assert_allclose(subject.time, TIMES, atol=1e-6)
    np.testing.assert_allclose(subject.position, position, atol=atol)
    np.testing.assert_allclose((Rotation.from_quat(subject.quaternion) * rotations.inv()).magnitude(), 0, atol=atol)


# microSD

ESTIMATE = [f"stateEstimate.{name}(f)" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]


def usd(variables, rows, *, version=2, crc=True, name="fixedFrequency", start=5.0, others=b""):
    """The log of one kind of event; `others` are records of a second kind, number 0, with one u16."""

    def text(value):
        return value.encode() + b"\0"

    head = struct.pack("<BHH", 0xBC, version, 2)
    head += struct.pack("<H", 0xFFFF) + text(name) + struct.pack("<H", len(variables)) + b"".join(map(text, variables))
    head += struct.pack("<H", 0) + text("estTDOA") + struct.pack("<H", 1) + text("id(H)")
    codes = "<" + "".join(variable[-2] for variable in variables)
    body = b""
    for time, row in zip(TIMES, rows, strict=True):
        stamp = (
            struct.pack("<Q", round((start + time) * 1e6))
            if version == 2
            else struct.pack("<I", round((start + time) * 1e3))
        )
        body += struct.pack("<H", 0xFFFF) + stamp + struct.pack(codes, *row) + others
    whole = head + body
    return whole + (struct.pack("<I", zlib.crc32(whole)) if crc else b"")


def estimate_rows(seed=0):
    position, rotations = poses(seed)
    return np.hstack([position, rotations.as_quat()]), position, rotations


@pytest.mark.parametrize("version", [1, 2])
def test_a_microsd_log_comes_back(tmp_path, version):
    rows, position, rotations = estimate_rows()
    file = tmp_path / "log00"
    other = struct.pack("<H", 0) + (struct.pack("<Q", 5_000_000) if version == 2 else struct.pack("<I", 5000)) + b"\1\0"
    file.write_bytes(usd(ESTIMATE, rows, version=version, others=other))
    log = read_log(file)
    assert [subject.name for subject in log.subjects] == ["estimate"]
    assert_same(log.subjects[0], position, rotations)
    assert (log.truncated, log.notes) == (False, ())


def test_every_type_of_variable_is_read_at_its_place(tmp_path):
    position, _ = poses()
    names = ["a.b(B)", "a.c(b)", "stateEstimateZ.x(h)", "a.d(H)", "stateEstimateZ.y(h)", "a.e(I)", "a.f(e)",
             "stateEstimateZ.z(h)", "a.g(i)"]  # fmt: skip
    millimetres = np.round(position * 1000).astype(int)
    rows = [(1, -1, x, 2, y, 3, 0.5, z, -4) for x, y, z in millimetres]
    file = tmp_path / "log00"
    file.write_bytes(usd(names, rows))
    np.testing.assert_allclose(read_log(file).subjects[0].position, millimetres / 1000, atol=1e-9)


def test_roll_pitch_and_yaw_are_those_of_the_firmware_whose_pitch_is_nose_up(tmp_path):
    names = [f"stateEstimate.{name}(f)" for name in ("x", "y", "z", "roll", "pitch", "yaw")]
    file = tmp_path / "log00"
    file.write_bytes(usd(names, [(0, 0, 1, 0, 30, 90)] * COUNT))
    turned = Rotation.from_quat(read_log(file).subjects[0].quaternion[0])
    nose = turned.apply([1, 0, 0])
    np.testing.assert_allclose(nose, [0, math.cos(math.radians(30)), math.sin(math.radians(30))], atol=1e-6)


def test_mocap_and_estimate_are_two_subjects(tmp_path):
    rows, position, rotations = estimate_rows()
    other, there, turned = estimate_rows(1)
    file = tmp_path / "log00"
    file.write_bytes(
        usd(ESTIMATE + [name.replace("stateEstimate", "locSrv") for name in ESTIMATE], np.hstack([rows, other]))
    )
    mocap, estimate = read_log(file).subjects
    assert (mocap.name, estimate.name) == ("mocap", "estimate")
    assert_same(mocap, there, turned)
    assert_same(estimate, position, rotations)


def test_kinds_of_records_of_one_name_are_all_read(tmp_path):
    rows, position, rotations = estimate_rows()
    file = tmp_path / "log00"
    file.write_bytes(usd(ESTIMATE, rows, name="estTDOA"))
    log = read_log(file)
    assert [subject.name for subject in log.subjects] == ["estimate at estTDOA"]
    assert_same(log.subjects[0], position, rotations)


@pytest.mark.parametrize("lost", [4, 5, 20, 60])
def test_a_microsd_log_that_lost_power_is_read_as_far_as_it_goes(tmp_path, lost):
    rows, position, _ = estimate_rows()
    whole = usd(ESTIMATE, rows)
    file = tmp_path / "log00"
    file.write_bytes(whole[:-lost])
    log = read_log(file)
    assert log.truncated
    assert "checksum" in log.notes[0]
    found = log.subjects[0].position
    assert len(found) == COUNT - math.ceil((lost - 4) / 38)
    np.testing.assert_allclose(found, position[: len(found)], atol=1e-6)


@settings(deadline=None, max_examples=80)
@given(data=st.data())
def test_a_flipped_bit_in_a_microsd_log_never_passes_unnoticed(tmp_path_factory, data):
    whole = bytearray(usd(ESTIMATE, estimate_rows()[0]))
    place = data.draw(st.integers(0, len(whole) - 1))
    whole[place] ^= 1 << data.draw(st.integers(0, 7))
    file = tmp_path_factory.mktemp("usd") / "log00"
    file.write_bytes(whole)
    log = log_or_error(file)
    assert log.truncated if not isinstance(log, InputError) else "\n" not in str(log)


def test_a_wrong_checksum_is_an_error(tmp_path):
    whole = bytearray(usd(ESTIMATE, estimate_rows()[0]))
    whole[-10] ^= 4
    file = tmp_path / "log00"
    file.write_bytes(whole)
    with pytest.raises(InputError, match="checksum is wrong"):
        read_log(file)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (usd(["gyro.x(f)"], [(0,)] * COUNT), "no position was logged; the variables are gyro.x, id"),
        (usd(ESTIMATE, estimate_rows()[0], version=2).replace(b"x(f)", b"x(Q)"), "head of the log is damaged"),
        (b"\xbc\x07\x00\x01\x00", "version 7"),
        (usd(ESTIMATE, estimate_rows()[0])[:30], "head of the log is damaged or cut off"),
    ],
)
def test_what_is_wrong_with_a_microsd_log_is_named(tmp_path, content, message):
    file = tmp_path / "log00"
    file.write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_log(file)


# crazyswarm2


def swarm(order=("timestamp", "x", "y", "z", "qw", "qx", "qy", "qz")):
    position, rotations = poses()
    x, y, z, w = rotations.as_quat().T
    columns = dict(zip(["x", "y", "z"], position.T, strict=True)) | {
        "timestamp": TIMES,
        "qw": w,
        "qx": x,
        "qy": y,
        "qz": z,
    }
    rows = [",".join(f"{columns[name][i]:.9f}" for name in order) for i in range(COUNT)]
    return "\n".join([",".join(order), *rows]) + "\n"


@pytest.mark.parametrize(
    "order",
    [("timestamp", "x", "y", "z", "qw", "qx", "qy", "qz"), ("qx", "qy", "qz", "qw", "z", "y", "x", "timestamp")],
)
def test_a_file_of_crazyswarm_comes_back_under_its_name(tmp_path, order):
    file = tmp_path / "cf231.csv"
    file.write_text(swarm(order))
    log = read_log(file)
    assert log.subjects[0].name == "cf231"
    assert_same(log.subjects[0], *poses())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace(",qz", "", 1), "no column qz"),
        (lambda text: text.replace("0.01", "soon", 1), "not a number"),
        (lambda text: text.replace("\n", ",1\n", 3), "8 cells, 9"),
        (lambda text: text.split("\n")[0] + "\n", "no pose"),
    ],
)
def test_what_is_wrong_with_a_file_of_crazyswarm_is_named(tmp_path, change, message):
    file = tmp_path / "cf.csv"
    file.write_text(change(swarm()))
    with pytest.raises(InputError, match=message):
        read_log(file)


@pytest.mark.parametrize("time", ["t", "time", "timestamp"])
def test_a_csv_with_other_columns_too_and_without_attitudes_is_places_over_time(tmp_path, time):
    position, _ = poses()
    rows = [f"{x:.9f},{t:.9f},{y:.9f},7,{z:.9f}" for t, (x, y, z) in zip(TIMES, position, strict=True)]
    file = tmp_path / "log.csv"
    file.write_text("\n".join([f"x,{time},y,battery,z", *rows]) + "\n")
    (subject,) = read_log(file).subjects
    assert subject.time == pytest.approx(TIMES, abs=1e-9)
    assert subject.position == pytest.approx(position, abs=1e-8)
    assert np.isnan(subject.quaternion).all()


def test_a_file_of_crazyswarm_may_be_cut(tmp_path):
    file = tmp_path / "cf.csv"
    file.write_text(swarm()[:-30])
    log = read_log(file)
    assert log.truncated
    assert len(log.subjects[0].time) == COUNT - 1


# ROS

NAMED_POSE = "motion_capture_tracking_interfaces/msg/NamedPose"


def store():
    types = get_typestore(Stores.ROS2_HUMBLE)
    types.register(get_types_from_msg("string name\ngeometry_msgs/Pose pose\n", NAMED_POSE))
    types.register(
        get_types_from_msg(f"std_msgs/Header header\n{NAMED_POSE.replace('/msg', '')}[] poses\n", NAMED_POSE + "Array")
    )
    return types


def bag(place, topic, kind, message_at, storage=StoragePlugin.SQLITE3):
    types = store()
    with Writer(place, version=9, storage_plugin=storage) as writer:
        connection = writer.add_connection(topic, kind, typestore=types)
        for i in range(COUNT):
            raw = types.serialize_cdr(message_at(types.types, i), kind)
            writer.write(connection, round((START + TIMES[i] + 0.003) * 1e9), raw)
    return place


def stamp(types, i, frame="world"):
    nanoseconds = round((START + TIMES[i]) * 1e9)
    time = types["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def pose(types, i, seed=0):
    position, rotations = poses(seed)
    x, y, z, w = rotations.as_quat()[i]
    return types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](**dict(zip("xyz", position[i], strict=True))),
        orientation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
    )


def transform(types, i):
    position, rotations = poses()
    x, y, z, w = rotations.as_quat()[i]
    return types["geometry_msgs/msg/TransformStamped"](
        header=stamp(types, i), child_frame_id="vicon/cf1/cf1",
        transform=types["geometry_msgs/msg/Transform"](
            translation=types["geometry_msgs/msg/Vector3"](**dict(zip("xyz", position[i], strict=True))),
            rotation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
        ),
    )  # fmt: skip


def named(types, i):
    one = types[NAMED_POSE]
    return types[NAMED_POSE + "Array"](
        header=stamp(types, i), poses=[one(name="cf1", pose=pose(types, i)), one(name="cf2", pose=pose(types, i, 1))]
    )


MESSAGES = {
    "geometry_msgs/msg/PoseStamped": (
        "/cf1/pose", lambda t, i: t["geometry_msgs/msg/PoseStamped"](header=stamp(t, i), pose=pose(t, i)),
    ),
    "geometry_msgs/msg/TransformStamped": ("vicon/cf1/cf1", transform),
    "tf2_msgs/msg/TFMessage": ("vicon/cf1/cf1", lambda t, i: t["tf2_msgs/msg/TFMessage"](transforms=[transform(t, i)])),
    "nav_msgs/msg/Odometry": (
        "/cf1/pose",
        lambda t, i: t["nav_msgs/msg/Odometry"](
            header=stamp(t, i), child_frame_id="cf1",
            pose=t["geometry_msgs/msg/PoseWithCovariance"](pose=pose(t, i), covariance=np.zeros(36)),
            twist=t["geometry_msgs/msg/TwistWithCovariance"](
                twist=t["geometry_msgs/msg/Twist"](
                    linear=t["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0),
                    angular=t["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0),
                ),
                covariance=np.zeros(36),
            ),
        ),
    ),
    NAMED_POSE + "Array": ("cf1", named),
}  # fmt: skip


@pytest.mark.parametrize("kind", MESSAGES)
@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_poses_in_a_ros_bag_come_back(tmp_path, kind, storage):
    name, message_at = MESSAGES[kind]
    place = bag(tmp_path / "bag", "/cf1/pose", kind, message_at, storage)
    log = read_log(place)
    assert log.subjects[0].name == name
    assert_same(log.subjects[0], *poses())
    if kind == NAMED_POSE + "Array":
        assert_same(log.subjects[1], *poses(1))


@pytest.mark.parametrize(("storage", "suffix"), [(StoragePlugin.SQLITE3, "db3"), (StoragePlugin.MCAP, "mcap")])
def test_a_file_of_a_bag_may_stand_alone(tmp_path, storage, suffix):
    kind = "geometry_msgs/msg/PoseStamped"
    (file,) = bag(tmp_path / "bag", "/cf1/pose", kind, MESSAGES[kind][1], storage).glob(f"*.{suffix}")
    assert_same(read_log(file).subjects[0], *poses())


def test_a_bag_without_poses_lists_its_topics(tmp_path):
    place = bag(tmp_path / "bag", "/chatter", "std_msgs/msg/String", lambda t, i: t["std_msgs/msg/String"](data="hi"))
    with pytest.raises(InputError, match="/chatter"):
        read_log(place)


@pytest.mark.parametrize(("storage", "suffix"), [(StoragePlugin.SQLITE3, "db3"), (StoragePlugin.MCAP, "mcap")])
def test_a_bag_that_is_cut_off_or_empty_is_an_error(tmp_path, storage, suffix):
    kind = "geometry_msgs/msg/PoseStamped"
    place = bag(tmp_path / "bag", "/cf1/pose", kind, MESSAGES[kind][1], storage)
    (file,) = place.glob(f"*.{suffix}")
    content = file.read_bytes()
    for size in (len(content) // 2, 200, 0):
        file.write_bytes(content[:size])
        with pytest.raises(InputError):
            read_log(place)


# MAVLink

TO_NED = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
TO_FRD = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


class Sink:
    def __init__(self):
        self.packets = []

    def write(self, data):
        self.packets.append(bytes(data))


def tlog(messages_at, *, v1=False):
    """Packets of all messages, each behind its time."""
    sink = Sink()
    link = common.MAVLink(sink, srcSystem=7)
    log = b""
    for i in range(COUNT):
        for message in messages_at(i):
            sink.packets.clear()
            link.send(message, force_mavlink1=v1)
            log += struct.pack(">Q", round((START + TIMES[i]) * 1e6)) + sink.packets[0]
    return log


def ned(i, world=TO_NED):
    position, rotations = poses()
    x, y, z, w = (world * rotations[i] * TO_FRD).as_quat()
    return world.apply(position[i]), [w, x, y, z]


def odometry(i, frame=common.MAV_FRAME_LOCAL_NED, world=TO_NED):
    place, turn = ned(i, world)
    return common.MAVLink_odometry_message(
        0, frame, common.MAV_FRAME_BODY_FRD, *place, turn, 0, 0, 0, 0, 0, 0, [math.nan] * 21, [math.nan] * 21, 0, 0, 100
    )


def local(i):
    place, turn = ned(i)
    return [
        common.MAVLink_attitude_quaternion_message(0, *turn, 0, 0, 0),
        common.MAVLink_local_position_ned_message(0, *place, 0, 0, 0),
        common.MAVLink_heartbeat_message(2, 0, 0, 0, 4, 3),
    ]


@pytest.mark.parametrize(
    ("messages_at", "name"),
    [
        (lambda i: [odometry(i)], "vehicle 7 odometry"),
        (lambda i: [odometry(i, common.MAV_FRAME_LOCAL_FRD, TO_FRD)], "vehicle 7 odometry"),
        (local, "vehicle 7"),
    ],
)
def test_poses_in_a_tlog_come_back_in_our_axes(tmp_path, messages_at, name):
    file = tmp_path / "flight.tlog"
    file.write_bytes(tlog(messages_at))
    log = read_log(file)
    assert [subject.name for subject in log.subjects] == [name]
    assert_same(log.subjects[0], *poses(), atol=2e-6)  # MAVLink has single precision
    assert log.notes == ()


def test_packets_of_the_first_version_are_read_too(tmp_path):
    file = tmp_path / "flight.tlog"
    file.write_bytes(tlog(local, v1=True))
    assert_same(read_log(file).subjects[0], *poses(), atol=2e-6)


def test_garbage_between_packets_is_passed_over_and_said(tmp_path):
    whole = tlog(local)
    third = whole.index(struct.pack(">Q", round((START + TIMES[10]) * 1e6)))
    file = tmp_path / "flight.tlog"
    file.write_bytes(whole[:third] + b"\xfd\x05 garbage \xfe" * 9 + whole[third:])
    log = read_log(file)
    assert_same(log.subjects[0], *poses(), atol=2e-6)
    assert "bytes skipped" in log.notes[0]


def test_a_packet_with_a_wrong_checksum_is_left_out_and_said(tmp_path):
    whole = bytearray(tlog(lambda i: [odometry(i)]))
    whole[60] ^= 1
    file = tmp_path / "flight.tlog"
    file.write_bytes(whole)
    log = read_log(file)
    assert len(log.subjects[0].time) == COUNT - 1
    assert "1 packets left out" in log.notes[0]


def test_a_tlog_that_is_cut_off_is_read_up_to_there(tmp_path):
    file = tmp_path / "flight.tlog"
    file.write_bytes(tlog(lambda i: [odometry(i)])[:-5])
    log = read_log(file)
    assert log.truncated
    assert len(log.subjects[0].time) == COUNT - 1


def test_a_tlog_of_nothing_but_heartbeats_holds_no_pose(tmp_path):
    file = tmp_path / "flight.tlog"
    file.write_bytes(tlog(lambda i: [common.MAVLink_heartbeat_message(2, 0, 0, 0, 4, 3)]))
    with pytest.raises(InputError, match="no pose"):
        read_log(file)


# all


def sound(tmp_path, name):
    if name == "microsd":
        return usd(ESTIMATE, estimate_rows()[0])
    if name == "crazyswarm":
        return swarm().encode()
    return tlog(lambda i: [odometry(i), *local(i)])


@settings(deadline=None, max_examples=150)
@given(data=st.data(), name=st.sampled_from(["microsd", "crazyswarm", "tlog"]))
def test_damage_anywhere_is_an_error_that_is_named_or_a_log(tmp_path_factory, data, name):
    folder = tmp_path_factory.mktemp("damaged")
    content = sound(folder, name)
    start = data.draw(st.integers(0, len(content)))
    end = data.draw(st.integers(start, min(len(content), start + 200)))
    file = folder / "log"
    file.write_bytes(content[:start] + data.draw(st.binary(max_size=30)) + content[end:])
    check_damaged(file)


def test_the_format_is_told_by_content_whatever_the_name(tmp_path):
    file = tmp_path / "log.csv"
    for content, name in (
        (usd(ESTIMATE, estimate_rows()[0]), "Crazyflie microSD log"),
        (swarm().encode(), "CSV of t, x, y, z"),
        (tlog(local), "MAVLink .tlog"),
        (b"\r\nObjects\r\n100\r\n", "Vicon CSV"),
        (b"SQLite format 3\0", "ROS bag"),
    ):
        file.write_bytes(content)
        assert name == find_importer(file).FORMAT
