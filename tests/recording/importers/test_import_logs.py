"""Logs of every format: written here by their layouts, read back equal; damaged ones are named or read in part."""

import math
import sqlite3
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer as McapWriter
from pymavlink.dialects.v20 import common
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.flight.setpoints.packets import compress_quaternion
from cfplan.recording.importers.formats import read_log
from tests.recording.importers import test_import_vicon as vicon

FLIGHTS = Path(__file__).parents[4] / "shared" / "data" / "flights"

COUNT = 30
TIMES = np.arange(COUNT) * 0.01
START = 1_700_000_000.0  # s since 1970


def poses(seed=0):
    position, rotations, _ = vicon.poses(COUNT, seed)
    return position, rotations, np.ones(COUNT, dtype=bool)


def assert_same(subject, seed=0, atol=1e-6):
    np.testing.assert_allclose(subject.time, TIMES, atol=1e-6)
    vicon.assert_same(subject, poses(seed), atol)


# microSD

ESTIMATE = [f"stateEstimate.{name}(f)" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
KALMAN = [f"kalman.{name}(f)" for name in ("stateX", "stateY", "stateZ", "q1", "q2", "q3", "q0")]
MOCAP = [name.replace("stateEstimate", "locSrv") for name in ESTIMATE]


def usd(variables, rows, *, version=2, crc=True, name="fixedFrequency", start=5.0, other=False, times=TIMES):
    """The log of one kind of event, each followed by a record of a second kind, number 0, with one u16 if `other`."""

    def kind(number, name, variables):
        texts = b"".join(text.encode() + b"\0" for text in variables)
        return struct.pack("<H", number) + name.encode() + b"\0" + struct.pack("<H", len(variables)) + texts

    def stamp(time):
        return struct.pack("<Q", round(time * 1e6)) if version == 2 else struct.pack("<I", round(time * 1e3))

    log = (
        bytearray(struct.pack("<BHH", 0xBC, version, 2)) + kind(0xFFFF, name, variables) + kind(0, "estTDOA", ["id(H)"])
    )
    codes = "<" + "".join(variable[-2] for variable in variables)
    for time, row in zip(times, rows, strict=True):
        log += b"\xff\xff" + stamp(start + time) + struct.pack(codes, *row)
        log += b"\0\0" + stamp(start) + b"\1\0" if other else b""
    return bytes(log) + (struct.pack("<I", zlib.crc32(log)) if crc else b"")


def old_usd(variables, rows, *, block=8):
    """The log of firmware before 2020: a header of text, and blocks of rows, each with a negated checksum."""

    def checked(part):
        return part + struct.pack("<I", ~zlib.crc32(part) & 0xFFFFFFFF)

    codes = "<I" + "".join(variable[-2] for variable in variables)
    packed = [struct.pack(codes, round(1000 * time) + 77, *row) for time, row in zip(TIMES, rows, strict=True)]
    blocks = [packed[i : i + block] for i in range(0, COUNT, block)]
    head = bytes([1 + len(variables)]) + ",".join(["tick(I)", *variables, ""]).encode()
    return checked(head) + b"".join(checked(bytes([len(part)]) + b"".join(part)) for part in blocks)


def estimate_rows(seed=0):
    position, rotations, _ = poses(seed)
    return np.hstack([position, rotations.as_quat()]), position, rotations


# crazyswarm2


def swarm(order=("timestamp", "x", "y", "z", "qw", "qx", "qy", "qz")):
    names = ("timestamp", "x", "y", "z", "qx", "qy", "qz", "qw")
    columns = dict(zip(names, np.c_[TIMES, estimate_rows()[0]].T, strict=True))
    rows = [",".join(f"{columns[name][i]:.9f}" for name in order) for i in range(COUNT)]
    return "\n".join([",".join(order), *rows]) + "\n"


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
            writer.write(connection, round((START + TIMES[i] + 0.003) * 1e9), cdr(*message_at(i)))
    return place


def cdr(*fields):
    """The bytes of a ROS 2 message of texts, counts and arrays of doubles, each aligned to its size."""
    raw = b""
    for field in fields:
        raw += bytes(-len(raw) % (8 if isinstance(field, np.ndarray) else 4))
        if isinstance(field, str):
            raw += struct.pack("<I", len(field) + 1) + field.encode() + b"\0"
        else:
            raw += struct.pack("<I", field) if isinstance(field, int) else field.astype("<f8").tobytes()
    return b"\0\1\0\0" + raw


def stamp(i):
    return (*divmod(round((START + TIMES[i]) * 1e9), 10**9), "world")


def pose(i, seed=0):
    return estimate_rows(seed)[0][i]


LEVEL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
COVARIANCE = np.zeros(36)
MESSAGES = {  # the first subject, and the fields of a message
    "geometry_msgs/msg/PoseStamped": ("/cf1/pose", lambda i: [*stamp(i), pose(i)]),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("/cf1/pose", lambda i: [*stamp(i), pose(i), COVARIANCE]),
    "geometry_msgs/msg/TransformStamped": ("vicon/cf1/cf1", lambda i: [*stamp(i), "vicon/cf1/cf1", pose(i)]),
    "tf2_msgs/msg/TFMessage": ("vicon/cf1/cf1", lambda i: [1, *stamp(i), "vicon/cf1/cf1", pose(i)]),
    "nav_msgs/msg/Odometry": (
        "/cf1/pose",
        lambda i: [*stamp(i), "cf1", pose(i), COVARIANCE, np.zeros(6), COVARIANCE],
    ),
    NAMED_POSE + "Array": ("cf1", lambda i: [*stamp(i), 2, "cf1", pose(i), "cf2", pose(i, 1)]),
}
SUFFIXES = {StoragePlugin.SQLITE3: "db3", StoragePlugin.MCAP: "mcap"}


def bag_of_poses(folder, storage):
    """A bag of one kind of pose, and its file."""
    kind = "geometry_msgs/msg/PoseStamped"
    place = bag(folder / "bag", "/cf1/pose", kind, MESSAGES[kind][1], storage)
    (file,) = place.glob(f"*.{SUFFIXES[storage]}")
    return place, file


# MAVLink

TO_NED = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
TO_FRD = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
GLOBAL = common.MAVLink_global_position_int_message(0, 500000000, 80000000, 1000, 1000, 0, 0, 0, 0)
HEARTBEAT = common.MAVLink_heartbeat_message(2, 0, 0, 0, 4, 3)


def tlog(messages_at, *, v1=False):
    """Packets of all messages, each behind its time."""
    link = common.MAVLink(None, srcSystem=7)
    return b"".join(
        struct.pack(">Q", round((START + TIMES[i]) * 1e6)) + message.pack(link, force_mavlink1=v1)
        for i in range(COUNT)
        for message in messages_at(i)
    )


def ned(i, world=TO_NED):
    position, rotations, _ = poses()
    x, y, z, w = (world * rotations[i] * TO_FRD).as_quat()
    return world.apply(position[i]), [w, x, y, z]


def odometry(i, frame=common.MAV_FRAME_LOCAL_NED, world=TO_NED):
    unknown = [math.nan] * 21
    return common.MAVLink_odometry_message(
        0, frame, common.MAV_FRAME_BODY_FRD, *ned(i, world)[0], ned(i, world)[1], *[0] * 6, unknown, unknown, 0, 0, 100
    )


def local(i, *, angles=False):
    place, turn = ned(i)
    yaw, pitch, roll = Rotation.from_quat([*turn[1:], turn[0]]).as_euler("ZYX")
    return [
        common.MAVLink_attitude_message(0, roll, pitch, yaw, 0, 0, 0)
        if angles
        else common.MAVLink_attitude_quaternion_message(0, *turn, 0, 0, 0),
        common.MAVLink_local_position_ned_message(0, *place, 0, 0, 0),
        HEARTBEAT,
    ]


# all

ROWS = estimate_rows()[0]
SOUND = {
    "microSD": usd(ESTIMATE, ROWS),
    "old microSD": old_usd(ESTIMATE, ROWS),
    "crazyswarm": swarm().encode(),
    "odometry": tlog(lambda i: [odometry(i)]),
    "tlog": tlog(lambda i: [odometry(i), *local(i)]),
    "Vicon": vicon.text_of(vicon.WANTED).encode(),
}
OF_ONE_FILE = [  # format, content, subjects
    ("Crazyflie microSD log", SOUND["microSD"], ["estimate"]),
    ("Crazyflie microSD log", usd(ESTIMATE, ROWS, other=True), ["estimate"]),
    ("Crazyflie microSD log", usd(ESTIMATE, ROWS, version=1, other=True), ["estimate"]),
    ("Crazyflie microSD log", usd(ESTIMATE, ROWS, name="estTDOA"), ["estimate at estTDOA"]),
    ("Crazyflie microSD log", usd(ESTIMATE + MOCAP, np.hstack([estimate_rows(1)[0], ROWS])), ["mocap", "estimate"]),
    ("Crazyflie microSD log", usd(KALMAN, ROWS), ["kalman"]),
    ("Crazyflie microSD log", SOUND["old microSD"], ["estimate"]),
    ("CSV of t, x, y, z", SOUND["crazyswarm"], ["log"]),
    ("CSV of t, x, y, z", swarm(("qx", "qy", "qz", "qw", "z", "y", "x", "timestamp")).encode(), ["log"]),
    ("MAVLink .tlog", SOUND["odometry"], ["vehicle 7 odometry"]),
    ("MAVLink .tlog", tlog(lambda i: [odometry(i, common.MAV_FRAME_LOCAL_FRD, TO_FRD)]), ["vehicle 7 odometry"]),
    ("MAVLink .tlog", tlog(local), ["vehicle 7"]),
    ("MAVLink .tlog", tlog(lambda i: local(i, angles=True)), ["vehicle 7"]),
    ("MAVLink .tlog", tlog(local, v1=True), ["vehicle 7"]),
]


def written(folder, content):
    file = folder / "log.csv"  # whatever its format: its content decides
    file.write_bytes(content)
    return file


@pytest.mark.parametrize(("name", "content", "subjects"), OF_ONE_FILE)
def test_a_log_comes_back_in_our_axes_whatever_the_name_of_its_file(tmp_path, name, content, subjects):
    log = read_log(written(tmp_path, content))
    assert (log.format, log.truncated, log.notes) == (name, False, ())
    assert [subject.name for subject in log.subjects] == subjects
    for seed, subject in enumerate(log.subjects):
        assert_same(subject, seed, atol=2e-6 if "MAVLink" in name else 1e-6)  # MAVLink has single precision


@pytest.mark.parametrize("kind", MESSAGES)
@pytest.mark.parametrize("storage", SUFFIXES)
def test_poses_in_a_ros_bag_come_back(tmp_path, kind, storage):
    name, message_at = MESSAGES[kind]
    log = read_log(bag(tmp_path / "bag", "/cf1/pose", kind, message_at, storage))
    assert (log.format, log.subjects[0].name, log.notes) == ("ROS bag", name, ())
    assert len(log.subjects) == (2 if "Array" in kind else 1)
    for seed, subject in enumerate(log.subjects):
        assert_same(subject, seed)


@pytest.mark.parametrize("storage", SUFFIXES)
def test_a_file_of_a_bag_may_stand_alone_under_its_suffix(tmp_path, storage):
    _, file = bag_of_poses(tmp_path, storage)
    assert_same(read_log(file).subjects[0])
    with pytest.raises(InputError, match="suffix"):
        read_log(file.rename(tmp_path / "log"))


@pytest.mark.parametrize("storage", SUFFIXES)
def test_a_folder_without_metadata_is_read_by_its_files(tmp_path, storage):
    place, _ = bag_of_poses(tmp_path, storage)
    (place / "metadata.yaml").unlink()
    assert_same(read_log(place).subjects[0])


def test_a_bag_without_definitions_of_its_messages_as_humble_writes_holds_the_poses_of_crazyswarm2(tmp_path):
    kind = NAMED_POSE + "Array"
    place = bag(tmp_path / "bag", "/poses", kind, MESSAGES[kind][1])
    (file,) = place.glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("UPDATE schema SET schema_version = 3")
    database.close()
    assert_same(read_log(place).subjects[0])


def transforms(*frames):
    """A message of transforms: (parent, child, pose (7,)) each."""
    return lambda i: [
        len(frames),
        *(part for above, name, at in frames for part in (*stamp(i)[:2], above, name, at(i))),
    ]


def test_frames_of_transforms_are_composed_and_those_of_several_roots_are_told(tmp_path):
    aside = np.array([0.1, 0.0, 0.0, *Rotation.from_euler("z", 90, degrees=True).as_quat()])
    frames = [("world", "cf1", pose), ("cf1", "deck", lambda _: LEVEL), ("deck", "camera", lambda _: aside)]
    other = ("/map", "gate", lambda _: LEVEL)
    kind = "tf2_msgs/msg/TFMessage"
    log = read_log(bag(tmp_path / "bag", "/tf", kind, transforms(*frames, other)))
    cf1, deck, camera = log.select(["cf1", "deck", "camera"])
    np.testing.assert_allclose(deck.position, cf1.position, atol=1e-9)
    turned = Rotation.from_quat(cf1.quaternion)
    np.testing.assert_allclose(camera.position, cf1.position + turned.apply(aside[:3]), atol=1e-9)
    np.testing.assert_allclose(
        Rotation.from_quat(camera.quaternion).apply([1, 0, 0]), turned.apply([0, 1, 0]), atol=1e-9
    )
    assert "the frames map, world" in log.notes[0]


def test_a_static_transform_follows_its_moving_parent(tmp_path):
    def message(i):
        return transforms(("world", "cf1", pose), *([("cf1", "deck", lambda _: LEVEL)] if i == 0 else []))(i)

    cf1, deck = read_log(bag(tmp_path / "bag", "/tf", "tf2_msgs/msg/TFMessage", message)).subjects
    np.testing.assert_allclose(deck.time, cf1.time)
    np.testing.assert_allclose(deck.position, cf1.position, atol=1e-9)


def test_an_mcap_bag_that_is_cut_off_is_read_up_to_its_last_complete_chunk(tmp_path):
    kind = "geometry_msgs/msg/PoseStamped"
    file = tmp_path / "bag.mcap"
    with file.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=1000)
        writer.start(profile="ros2", library="")
        schema = writer.register_schema(kind, "ros2msg", store().generate_msgdef(kind)[0].encode())
        channel = writer.register_channel("/cf1/pose", "cdr", schema)
        for i in range(COUNT):
            writer.add_message(channel, round((START + TIMES[i]) * 1e9), cdr(*MESSAGES[kind][1](i)), 0)
        writer.finish()
    content = file.read_bytes()
    assert_same(read_log(file).subjects[0])
    file.write_bytes(content[: len(content) // 2])
    log = read_log(file)
    rows = len(log.subjects[0].time)
    assert log.truncated
    assert "cut off" in log.notes[0]
    assert 5 < rows < COUNT
    np.testing.assert_array_equal(log.subjects[0].position, poses()[0][:rows])


def test_every_type_of_variable_is_read_at_its_place(tmp_path):
    names = ["a.b(B)", "a.c(b)", "stateEstimateZ.x(h)", "a.d(H)", "stateEstimateZ.y(h)", "a.e(I)", "a.f(e)",
             "stateEstimateZ.z(h)", "a.g(i)"]  # fmt: skip
    millimetres = np.round(poses()[0] * 1000).astype(int)
    rows = [(1, -1, x, 2, y, 3, 0.5, z, -4) for x, y, z in millimetres]
    log = read_log(written(tmp_path, usd(names, rows)))
    np.testing.assert_allclose(log.subjects[0].position, millimetres / 1000, atol=1e-9)


def test_the_compressed_estimate_and_setpoint_are_millimetres_and_a_packed_quaternion(tmp_path):
    _, position, rotations = estimate_rows()
    millimetres = np.round(position * 1000).astype(int)
    names = [f"{group}.{axis}(h)" for group in ("stateEstimateZ", "ctrltargetZ") for axis in "xyz"]
    packed = compress_quaternion(rotations.as_quat())
    rows = [(*place, *place, int(quat)) for place, quat in zip(millimetres, packed, strict=True)]
    estimate, setpoint = read_log(written(tmp_path, usd([*names, "stateEstimateZ.quat(I)"], rows))).subjects
    assert (estimate.name, setpoint.name) == ("estimate, compressed", "setpoint, compressed")
    np.testing.assert_allclose([estimate.position, setpoint.position], [millimetres / 1000] * 2, atol=1e-9)
    assert (Rotation.from_quat(estimate.quaternion) * rotations.inv()).magnitude().max() < 0.005
    assert np.isnan(setpoint.quaternion).all()


def test_the_lee_controllers_angles_are_the_attitudes_of_the_compressed_estimate_and_setpoint(tmp_path):
    _, position, rotations = estimate_rows()
    millimetres = np.round(position * 1000).astype(int)
    groups = ("stateEstimateZ", "ctrltargetZ")
    names = [f"{group}.{axis}(h)" for group in groups for axis in "xyz"]
    names += [f"ctrlLee.{group}{axis}(f)" for group in ("rpy", "rpyd") for axis in "xyz"]
    angles = rotations.as_euler("ZYX")[:, ::-1]
    rows = [(*place, *place, *each, *(-each)) for place, each in zip(millimetres, angles, strict=True)]
    estimate, setpoint = read_log(written(tmp_path, usd(names, rows))).subjects
    assert (Rotation.from_quat(estimate.quaternion) * rotations.inv()).magnitude().max() < 1e-6
    wanted = Rotation.from_euler("ZYX", -angles[:, ::-1])
    assert (Rotation.from_quat(setpoint.quaternion) * wanted.inv()).magnitude().max() < 1e-6


@pytest.mark.parametrize("name", ["log76", "log206"])
def test_public_logs_of_the_lee_controller_have_setpoint_and_attitude(name):
    if not (file := FLIGHTS / "original_logs" / name).is_file():
        pytest.skip("the public flights, ../shared/data/flights, are not here")
    subjects = {subject.name: subject for subject in read_log(file).subjects}
    estimate, setpoint = subjects["estimate, compressed"], subjects["setpoint, compressed"]
    for subject in (estimate, setpoint):
        assert np.isfinite(subject.quaternion).all()
        assert Rotation.from_quat(subject.quaternion).as_matrix()[:, 2, 2].min() > 0.7  # upright
    assert np.linalg.norm(estimate.position - setpoint.position, axis=1).max() < 0.3


def test_roll_pitch_and_yaw_are_those_of_the_firmware_whose_pitch_is_nose_up(tmp_path):
    names = [f"stateEstimate.{name}(f)" for name in ("x", "y", "z", "roll", "pitch", "yaw")]
    log = read_log(written(tmp_path, usd(names, [(0, 0, 1, 0, 30, 90)] * COUNT)))
    nose = Rotation.from_quat(log.subjects[0].quaternion[0]).apply([1, 0, 0])
    np.testing.assert_allclose(nose, [0, math.cos(math.radians(30)), math.sin(math.radians(30))], atol=1e-6)


@pytest.mark.parametrize("time", ["t", "time", "timestamp"])
def test_a_csv_with_other_columns_too_and_without_attitudes_is_places_over_time(tmp_path, time):
    rows = [f"{x:.9f},{t:.9f},{y:.9f},7,{z:.9f}" for t, (x, y, z) in zip(TIMES, poses()[0], strict=True)]
    (subject,) = read_log(written(tmp_path, "\n".join([f"x,{time},y,battery,z", *rows, ""]).encode())).subjects
    assert subject.time == pytest.approx(TIMES, abs=1e-9)
    assert subject.position == pytest.approx(poses()[0], abs=1e-8)
    assert np.isnan(subject.quaternion).all()


# what is wrong


@pytest.mark.parametrize(
    ("name", "lost", "rows"),
    [
        ("old microSD", 4, 30), ("old microSD", 5, 29), ("old microSD", 200, 24), ("microSD", 4, 30),
        ("microSD", 5, 29), ("microSD", 20, 29), ("microSD", 60, 28), ("crazyswarm", 30, 29),
        ("odometry", 5, 29), ("odometry", 200, 29), ("Vicon", 12, 39),
    ],
)  # fmt: skip
def test_a_log_that_is_cut_off_is_read_as_far_as_it_goes(tmp_path, name, lost, rows):
    log = read_log(written(tmp_path, SOUND[name][:-lost]))
    assert log.truncated
    assert ("checksum" if "microSD" in name else "cut off") in log.notes[-1]
    sound = read_log(written(tmp_path, SOUND[name])).subjects[0]
    assert len(log.subjects[0].time) == rows
    np.testing.assert_array_equal(log.subjects[0].position, sound.position[:rows])


THIRD = SOUND["tlog"].index(struct.pack(">Q", round((START + TIMES[10]) * 1e6)))


@pytest.mark.parametrize(
    ("content", "rows", "note"),
    [
        (SOUND["tlog"][:THIRD] + b"\xfd\x05 garbage \xfe" * 9 + SOUND["tlog"][THIRD:], COUNT, "108 bytes skipped"),
        (SOUND["odometry"][:60] + b"\xff" + SOUND["odometry"][61:], COUNT - 1, "1 packets left out"),
        (SOUND["odometry"] + SOUND["odometry"][-400:], COUNT, "1 messages 331 of vehicle 7 left out"),
    ],
)
def test_what_is_left_out_of_a_tlog_is_said(tmp_path, content, rows, note):
    log = read_log(written(tmp_path, content))
    assert len(log.subjects[0].time) == rows
    assert note in " ".join(log.notes)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (usd(["gyro.x(f)"], [(0,)] * COUNT), "fixedFrequency has gyro.x; estTDOA has id"),
        (SOUND["microSD"].replace(b"x(f)", b"x(Q)"), "head of the log is damaged"),
        (b"\xbc\x07\x00\x01\x00", "version 7"),
        (SOUND["old microSD"][:30], "damaged after byte 0"),
        (SOUND["old microSD"][:-9] + b"~" + SOUND["old microSD"][-8:], "damaged after byte"),
        (SOUND["microSD"][:30], "head of the log is damaged or cut off"),
        (SOUND["microSD"][: -38 * COUNT - 4], "ends before its first record"),
        (SOUND["microSD"][:-10] + b"\x12" + SOUND["microSD"][-9:], "checksum is wrong"),
        (SOUND["crazyswarm"].replace(b",qz", b"", 1), ":1: .*no column qz"),
        (SOUND["crazyswarm"].replace(b"0.01", b"soon", 1), ":3: 'soon.*in column 1 is not a number"),
        (SOUND["crazyswarm"].replace(b"\n", b",1\n", 3), ":4: 8 cells, 9"),
        (SOUND["crazyswarm"].split(b"\n")[0] + b"\n", "no rows of numbers below the header"),
        (tlog(lambda i: [HEARTBEAT]), "no pose .*no positions; LOCAL_POSITION_NED"),
        (tlog(lambda i: [GLOBAL, HEARTBEAT]), "no pose .*global positions only; LOCAL_POSITION_NED and ODOMETRY"),
        (b"", "the file is empty"),
        *((content, "unknown format") for content in (b"a picture", b"\x00" * 100, b"Objects\n")),
    ],
)
def test_what_is_wrong_with_a_log_is_named(tmp_path, content, message):
    with pytest.raises(InputError, match=message):
        read_log(written(tmp_path, content))


@pytest.mark.parametrize(
    ("package", "content", "extra"), [("pymavlink", SOUND["tlog"], "mavlink"), ("rosbags", b"#ROSBAG V2.0\n", "ros")]
)
def test_a_log_whose_package_is_missing_names_the_extra(tmp_path, monkeypatch, package, content, extra):
    for module in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=f"needs the package {package} ") as caught:
        read_log(written(tmp_path, content))
    assert f"cfplan[{extra}]" in caught.value.hint


def test_a_file_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_log(tmp_path / "none.csv")


def test_a_bag_without_poses_lists_its_topics(tmp_path):
    place = bag(tmp_path / "bag", "/chatter", "std_msgs/msg/String", lambda i: ["hi"])
    with pytest.raises(InputError, match="/chatter"):
        read_log(place)


@pytest.mark.parametrize("storage", SUFFIXES)
def test_a_bag_that_is_cut_off_or_empty_is_an_error(tmp_path, storage):
    place, file = bag_of_poses(tmp_path, storage)
    content = file.read_bytes()
    for size in (len(content) // 2, 200, 0):
        file.write_bytes(content[:size])
        with pytest.raises(InputError):
            read_log(place)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """The name and the content of the file of a log, by format."""
    bags = {storage.name: bag_of_poses(tmp_path_factory.mktemp("bag"), storage)[1] for storage in SUFFIXES}
    return {name: ("log", content) for name, content in SOUND.items()} | {
        name: (file.name, file.read_bytes()) for name, file in bags.items()
    }


def log_or_error(file):
    try:
        return read_log(file)
    except InputError as error:
        return error


patches = st.one_of(st.binary(max_size=30), st.sampled_from([b"\n\n", b",,,\n", b";", b"1e999", b'"', b"soon"]))


@pytest.mark.parametrize("name", [*SOUND, *(storage.name for storage in SUFFIXES)])
@settings(deadline=None, max_examples=120)
@given(data=st.data(), kind=st.sampled_from(["cut", "flipped bit", "patch", "other head"]))
def test_damage_anywhere_is_an_error_with_its_place_and_a_hint_or_a_log(tmp_path_factory, sound, name, data, kind):
    file_name, content = sound[name]
    begin = 0 if kind == "other head" else data.draw(st.integers(0, len(content) - 1))
    if kind == "cut":
        damaged = content[:begin]
    elif kind == "flipped bit":
        damaged = bytearray(content)
        damaged[begin] ^= 1 << data.draw(st.integers(0, 7))
    else:
        damaged = content[:begin] + data.draw(patches) + content[begin + data.draw(st.integers(0, 300)) :]
    file = tmp_path_factory.mktemp("damaged") / file_name
    file.write_bytes(damaged)
    log = log_or_error(file)
    assert list(file.parent.iterdir()) == [file]
    if isinstance(log, InputError):
        assert log.where.startswith(str(file))
        assert log.hint
        assert "\n" not in str(log)
        return
    assert log.truncated or kind != "flipped bit" or "microSD" not in name  # its checksum tells
    for subject in log.subjects:
        assert subject.position.shape == (len(subject.time), 3)
        assert np.all(np.diff(subject.time) > 0)
    if kind == "cut":
        file.write_bytes(content)
        rows = len(log.subjects[0].time) - 1  # the last may be cut within a number
        np.testing.assert_array_equal(log.subjects[0].position[:rows], read_log(file).subjects[0].position[:rows])
