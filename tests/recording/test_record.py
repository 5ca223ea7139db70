"""What is written is what is read, however the writing ended."""

import errno
import io
import signal
import struct
import subprocess
import sys
from dataclasses import fields
from datetime import datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import Writer

from cfplan.errors import InputError
from cfplan.flight.clock import SteppedClock
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE
from cfplan.flight.telemetry import Event, Level, Phase, PhaseEntered, PlanCommitted, PoseReceived
from cfplan.recording.commitments import committed_setpoints
from cfplan.recording.header import header_from_json, header_to_json
from cfplan.recording.reader import read_record
from cfplan.recording.topics import TOPICS, columns_from_json, message_to_json
from cfplan.recording.writer import FLUSH_PERIOD, RecordWriter, new_record_folder

patiently = settings(deadline=None)  # files and threads take as long as a busy machine lets them
STREAMS = [(topic.stream, topic.message) for topic in TOPICS if topic.message is not PlanCommitted]


def assert_same_header(left, right):
    for f in fields(left):
        np.testing.assert_equal(getattr(left, f.name), getattr(right, f.name))


@pytest.mark.parametrize(("stream", "kind"), STREAMS)
def test_every_message_reads_back_exactly(flight, stream, kind):
    wanted = [message for message in flight.messages if type(message) is kind]
    columns = getattr(flight.record, stream)
    assert len(wanted) > 0
    for f in fields(kind):
        np.testing.assert_array_equal(getattr(columns, f.name), [getattr(m, f.name) for m in wanted])


def test_what_was_committed_reads_back_and_joins_into_one_sequence(tmp_path, small_header):
    """A plan replaces the rest of the one before from its splice on; where that has ended, it hovers until then."""
    random = np.random.default_rng(0)
    plans = [(0, 10), (6, 20), (40, 5), (41, 2)]
    payloads = [random.integers(0, 256, (count, PAYLOAD_SIZE), dtype=np.uint8) for _, count in plans]
    with RecordWriter(tmp_path, small_header) as writer:
        for number, ((splice, _), rows) in enumerate(zip(plans, payloads, strict=True)):
            writer.write(PlanCommitted(5.0 + number, splice, (1 << 32) - 1 - number, rows.tobytes()))
    record = read_record(tmp_path)
    assert record.commitments.checksum.tolist() == [(1 << 32) - 1 - number for number in range(4)]
    first, second, third, fourth = payloads
    hover = np.repeat(second[-1:], 14, axis=0)
    np.testing.assert_array_equal(
        committed_setpoints(record), np.concatenate([first[:6], second, hover, third[:1], fourth])
    )


@pytest.mark.parametrize(("splice", "payloads"), [(0, b""), (0, b"x" * 28), (-1, b"x" * 29), (10**12, b"x" * 29)])
def test_commitments_that_are_none_are_refused(tmp_path, small_header, splice, payloads):
    with RecordWriter(tmp_path, small_header) as writer:
        writer.write(PlanCommitted(5.0, 0, 0, b"x" * 29))
        writer.write(PlanCommitted(5.0, splice, 1, payloads))
    with pytest.raises(InputError, match="commitment 2"):
        read_record(tmp_path)


def test_the_header_reads_back_exactly(flight):
    assert_same_header(flight.record.header, flight.header)


def test_a_flight_that_ended_well_is_not_truncated(flight):
    assert not flight.record.truncated


def test_a_record_opens_by_its_folder_and_by_its_file(flight):
    assert len(read_record(flight.folder / "flight.mcap").poses.time) == len(flight.record.poses.time)


def test_other_mcap_readers_see_the_messages_on_one_clock(flight):
    with open(flight.folder / "flight.mcap", "rb") as file:
        seen = list(make_reader(file, validate_crcs=True).iter_messages())
    seen = [(schema, channel, message) for schema, channel, message in seen if channel.message_encoding == "json"]
    assert len(seen) == len(flight.messages)
    assert {channel.topic for _, channel, _ in seen} == {topic.name for topic in TOPICS} - {"/committed"}
    assert all(schema.encoding == "jsonschema" for schema, _, _ in seen)
    wall = flight.header.wall_time_at_zero
    first = next(m for m in flight.messages if isinstance(m, PhaseEntered))
    stamps = [message.log_time for _, channel, message in seen if channel.topic == "/phase"]
    assert stamps[0] / 1e9 == pytest.approx(wall + first.time, abs=1e-6)


def test_the_summary_reads_back(tmp_path, small_header):
    writer = RecordWriter(tmp_path / "a", small_header)
    writer.close({"travel time": 9.0, "ended": "landed"})
    assert read_record(tmp_path / "a").summary == {"travel time": 9.0, "ended": "landed"}


def test_a_record_without_messages_has_empty_streams_of_the_right_shape(tmp_path, small_header):
    RecordWriter(tmp_path / "a", small_header).close()
    record = read_record(tmp_path / "a")
    assert record.setpoints.quaternion.shape == (0, 4)
    assert record.status.motor.shape == (0, 4)
    assert record.phases.phase.shape == (0,)
    assert (record.duration, record.truncated, dict(record.summary)) == (0.0, False, {})


numbers = st.floats(allow_nan=True, allow_infinity=True)
triples = st.tuples(numbers, numbers, numbers)


@given(time=numbers, received=numbers, position=triples, quaternion=st.tuples(numbers, numbers, numbers, numbers))
def test_numbers_read_back_bit_for_bit_and_those_not_finite_as_nan(time, received, position, quaternion):
    message = PoseReceived(time, received, position, quaternion)
    topic = next(topic for topic in TOPICS if topic.message is PoseReceived)
    columns = columns_from_json(topic, [message_to_json(message)])
    for f in fields(message):
        value = np.array(getattr(message, f.name))
        np.testing.assert_array_equal(getattr(columns, f.name)[0], np.where(np.isfinite(value), value, np.nan))


@given(text=st.text())
def test_any_text_reads_back(text):
    topic = next(topic for topic in TOPICS if topic.message is Event)
    columns = columns_from_json(topic, [message_to_json(Event(1.0, Level.INFO, text))])
    assert columns.text[0] == text.rstrip("\0")  # numpy's strings end before trailing NULs


def test_a_text_of_any_length_reads_back(tmp_path, small_header):
    texts = ["short", "long" * 2_000_000, "short again"]
    with RecordWriter(tmp_path, small_header) as writer:
        for text in texts:
            writer.write(Event(1.0, Level.INFO, text))
    assert read_record(tmp_path).events.text.tolist() == texts


def test_messages_may_hold_numpy_numbers(tmp_path, small_header):
    with RecordWriter(tmp_path / "a", small_header) as writer:
        writer.write(PoseReceived(np.float32(1.5), np.float64(2.5), np.array([1.0, 2.0, np.nan]), (0.0, 0.0, 0.0, 1.0)))
    assert writer.failure == ""
    np.testing.assert_equal(read_record(tmp_path / "a").poses.position, [[1.0, 2.0, np.nan]])


# Where the file ends too early


@pytest.fixture(scope="module")
def several_chunks(tmp_path_factory):
    """A record of several chunks, and how many phases each whole prefix holds."""
    folder = tmp_path_factory.mktemp("chunks")
    header = _header()
    file = folder / "flight.mcap"
    steps, clock = [], SteppedClock()
    with RecordWriter(folder, header, clock=clock) as writer:
        for number in range(4):
            for i in range(5):
                writer.write(PhaseEntered(number * 5.0 + i, Phase.STREAM))
            before = file.stat().st_size
            clock.sleep(FLUSH_PERIOD)
            assert file.stat().st_size > before
            steps.append((file.stat().st_size, 5 * (number + 1)))
    return file.read_bytes(), steps


def _header():
    return header_from_json(
        """{"name": "x", "version": "0", "uri": "sim://0", "planner": "expert", "thrust_at_full_command": 0.1,
        "vehicle": {"name": "v", "mass": 0.03, "inertia": [1, 1, 1], "arm": 0.03, "thrust_to_torque": 0.01,
                    "motor_thrust_min": 0, "motor_thrust_max": 0.1, "motor_time_constant": 0.1, "drag": [0, 0],
                    "source": ""},
        "plan_limits": {"speed": 2, "acceleration": 5, "angular_velocity": 8, "tilt": 0.5, "motor_thrust_min": 0,
                        "motor_thrust_max": 0.1, "specific_thrust_min": 5},
        "bounds": {}, "travel_time": 1, "path": [], "fence": [[0, 0, 0], [1, 1, 1]], "wall_time_at_zero": 0,
        "provenance": {}}"""
    )


def read_or_error(file):
    try:
        return read_record(file)
    except InputError as error:
        return error


@patiently
@given(cut=st.data())
def test_a_file_cut_anywhere_gives_its_whole_chunks_or_an_error(several_chunks, tmp_path_factory, cut):
    data, steps = several_chunks
    end = cut.draw(st.integers(0, len(data) - 1))
    file = tmp_path_factory.mktemp("cut") / "flight.mcap"
    file.write_bytes(data[:end])
    whole = max((count for size, count in steps if size <= end), default=0)
    record = read_or_error(file)
    if isinstance(record, InputError):
        assert whole == 0
        assert "\n" not in str(record)
    else:
        assert record.truncated
        assert len(record.phases.time) >= whole
        np.testing.assert_array_equal(record.phases.time, np.arange(len(record.phases.time), dtype=float))


@patiently
@given(place=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255))
def test_a_damaged_byte_never_gives_wrong_messages(several_chunks, tmp_path_factory, place, bits):
    data = bytearray(several_chunks[0])
    data[int(place * len(data))] ^= bits
    file = tmp_path_factory.mktemp("damaged") / "flight.mcap"
    file.write_bytes(data)
    record = read_or_error(file)
    if isinstance(record, InputError):
        assert "\n" not in str(record)
    else:
        times = record.phases.time
        assert set(times) <= set(np.arange(20.0))
        assert np.all(np.diff(times) > 0)
        assert record.truncated or len(times) == 20


@pytest.mark.parametrize("which", range(4))
def test_a_record_that_lacks_a_chunk_in_its_midst_says_so(several_chunks, tmp_path, which):
    """Where its kind is damaged: readers pass over kinds that they do not know."""
    data, place, chunks = bytearray(several_chunks[0]), 8, []
    while place + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, place)
        if opcode == Opcode.CHUNK:
            chunks.append(place)
        place += 9 + length
    data[chunks[which]] = Opcode.MESSAGE_INDEX
    (tmp_path / "flight.mcap").write_bytes(data)
    record = read_record(tmp_path)
    assert record.truncated
    assert set(record.phases.time) == set(np.arange(20.0)) - set(5.0 * which + np.arange(5.0))


WRITE_FOR_EVER = """
import pathlib, sys
from cfplan.flight.clock import SteppedClock
from cfplan.flight.telemetry import PhaseEntered, Phase
from cfplan.recording.header import header_from_json
from cfplan.recording.writer import FLUSH_PERIOD, RecordWriter
clock = SteppedClock()
writer = RecordWriter(pathlib.Path(sys.argv[1]), header_from_json(sys.argv[2]), clock=clock)
while True:
    stamp = clock.now()
    writer.write(PhaseEntered(stamp, Phase.STREAM))
    print(repr(stamp), flush=True)
    clock.sleep(0.01)
"""


@pytest.mark.integration
def test_a_killed_process_leaves_all_but_its_last_quarter_of_a_second(tmp_path):
    header = header_to_json(_header())
    command = [sys.executable, "-c", WRITE_FOR_EVER, str(tmp_path / "a"), header]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    stamps = [float(process.stdout.readline()) for _ in range(200)]
    process.send_signal(signal.SIGKILL)
    stamps += [float(line) for line in process.communicate()[0].splitlines(keepends=True) if line.endswith("\n")]
    record = read_record(tmp_path / "a")
    assert record.truncated
    kept = len(record.phases.time)
    np.testing.assert_array_equal(record.phases.time, stamps[:kept])
    assert record.phases.time[-1] >= stamps[-1] - FLUSH_PERIOD - 0.02


# Disks that fill up


class FullDisk:
    """A file on a disk with so much room; it takes what still fits, as a disk does."""

    def __init__(self, path, room):
        self.file, self.room = io.FileIO(path, "x"), room

    def write(self, data):
        if self.room == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        taken = self.file.write(data[: self.room])
        self.room -= taken
        return taken

    def truncate(self, size):
        return self.file.truncate(size)

    def close(self):
        self.file.close()


HEADER_SIZE = 2000  # bytes, more than the header takes


@patiently
@given(room=st.integers(0, 500))
def test_a_disk_without_room_for_the_header_is_an_error_before_the_flight(tmp_path_factory, room):
    folder = tmp_path_factory.mktemp("full")
    with pytest.raises(InputError, match="No space left"):
        RecordWriter(folder, _header(), open_file=lambda path: FullDisk(path, room))
    assert list(folder.iterdir()) == []


@patiently
@given(room=st.integers(0, 40_000))
def test_a_full_disk_is_told_once_and_leaves_a_readable_record(tmp_path_factory, room):
    folder = tmp_path_factory.mktemp("full")
    warnings = []
    room += HEADER_SIZE
    writer = RecordWriter(folder, _header(), warn=warnings.append, open_file=lambda path: FullDisk(path, room))
    rng = np.random.default_rng(0)
    for i in range(300):
        writer.write(PoseReceived(float(i), rng.normal(), tuple(rng.normal(size=3)), tuple(rng.normal(size=4))))
    writer.close()
    for i in range(3):
        writer.write(PoseReceived(float(i), 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    record = read_record(folder)
    np.testing.assert_array_equal(record.poses.time, np.arange(len(record.poses.time)))
    if record.truncated:
        assert len(warnings) == 1
        assert "No space left" in warnings[0]
    else:
        assert warnings == []
        assert len(record.poses.time) == 300


def test_a_summary_that_cannot_be_written_is_a_warning(tmp_path, small_header):
    warnings = []
    writer = RecordWriter(tmp_path, small_header, warn=warnings.append)
    writer.close({"deviation": float("nan")})
    assert len(warnings) == 1
    assert not list(tmp_path.glob("summary*.json"))


def test_a_message_that_cannot_be_written_does_not_stop_the_others(tmp_path, small_header):
    warnings = []
    with RecordWriter(tmp_path, small_header, warn=warnings.append) as writer:
        writer.write(PhaseEntered(1.0, Phase.ARM))
        writer.write(PhaseEntered(float("nan"), Phase.ARM))
        writer.write("no message at all")
        writer.write(PhaseEntered(2.0, Phase.LAND))
    assert len(warnings) == 1
    record = read_record(tmp_path)
    assert record.phases.time[-1] == 2.0
    assert record.phases.phase[-1] == "land"


# Nothing is overwritten


def test_folders_never_clash(tmp_path):
    now = datetime(2024, 1, 2, 3, 4, 5)
    folders = [new_record_folder(tmp_path / "records", "figure 8/é", now=now) for _ in range(3)]
    assert [folder.name for folder in folders] == [f"20240102-030405-figure-8{end}" for end in ("", "-2", "-3")]


def test_a_record_is_never_overwritten(tmp_path, small_header):
    RecordWriter(tmp_path, small_header).close()
    before = (tmp_path / "flight.mcap").read_bytes()
    with pytest.raises(InputError, match="already"):
        RecordWriter(tmp_path, small_header)
    assert (tmp_path / "flight.mcap").read_bytes() == before


def test_a_file_in_the_way_of_the_records_is_an_error(tmp_path):
    (tmp_path / "records").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        new_record_folder(tmp_path / "records", "x")


# What is no record of ours


def foreign_mcap(path):
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        writer.add_message(writer.register_channel("/tf", "cdr", 0), 0, b"abc", 0)
        writer.finish()


def of_a_later_format(path):
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start(profile="cfplan")
        writer.add_metadata("cfplan", {"format": "99", "header": "{}"})
        writer.finish()


def with_a_header_of(text):
    def write(path):
        with open(path, "wb") as file:
            writer = Writer(file)
            writer.start(profile="cfplan")
            writer.add_metadata("cfplan", {"format": "1", "header": text})
            writer.finish()

    return write


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda path: None, "no such record"),
        (lambda path: path.mkdir(), "no flight.mcap"),
        (lambda path: path.write_bytes(b""), "empty"),
        (lambda path: path.write_bytes(b"time,x,y\n1,2,3\n"), "no MCAP file"),
        (lambda path: path.write_bytes(b"\x89MCAP0\r\n"), "before its header"),
        (lambda path: path.write_bytes(b"\x89MC"), "before its header"),
        (foreign_mcap, "profile is 'ros2'"),
        (of_a_later_format, "format '99'"),
        (with_a_header_of("{}"), "header cannot be read"),
        (with_a_header_of("["), "header cannot be read"),
        (with_a_header_of("[" * 100_000), "header cannot be read"),
    ],
)
def test_what_is_no_record_is_an_error_of_one_line_with_place(tmp_path, write, words):
    place = tmp_path / "thing"
    write(place)
    with pytest.raises(InputError, match=words) as caught:
        read_record(place)
    assert "\n" not in str(caught.value)
    assert str(place) in caught.value.where


@patiently
@given(data=st.binary(max_size=200), magic=st.booleans())
def test_arbitrary_bytes_are_an_error_never_a_crash(tmp_path_factory, data, magic):
    file = tmp_path_factory.mktemp("bytes") / "flight.mcap"
    file.write_bytes((b"\x89MCAP0\r\n" if magic else b"") + data)
    with pytest.raises(InputError):
        read_record(file)


def test_a_length_beyond_the_file_is_not_believed(tmp_path):
    file = tmp_path / "flight.mcap"
    file.write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, 1 << 60))
    with pytest.raises(InputError, match="before its header"):
        read_record(file)
