"""Vicon CSV of every layout: what is written comes back, and what is wrong is named."""

import numpy as np
import pytest
from damaged_logs import check_damaged, log_or_error
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.recording.importers.formats import read_log
from cfplan.recording.importers.vicon_header import Rotations

RATE = 300.0
UNITS = {"mm": 1e3, "cm": 1e2, "m": 1.0, "rad": 1.0, "deg": 180 / np.pi}


def poses(count=40, seed=0):
    """Positions, rotations of a subject, and which frames it is seen in."""
    rng = np.random.default_rng(seed)
    seen = np.ones(count, dtype=bool)
    seen[5:9] = seen[-1] = False
    return rng.uniform(-3, 3, (count, 3)), Rotation.random(count, rng=rng), seen


def turn(rotations, layout):
    """The rotation columns, in rad."""
    if layout == "quaternion":
        return rotations.as_quat()
    return rotations.as_rotvec() if layout == "helical" else by_hand_euler(rotations.as_matrix())


def by_hand_euler(m):
    """The angles of R = Rx(a) Ry(b) Rz(c), from the entries of R."""
    return np.stack(
        [np.arctan2(-m[:, 1, 2], m[:, 2, 2]), np.arcsin(m[:, 0, 2]), np.arctan2(-m[:, 0, 1], m[:, 0, 0])], axis=1
    )


def write(
    file, subjects, *, delimiter=",", point=".", length="mm", angle="rad", rate=RATE, name="Objects", first=1,
    blank="", title="Global Angle ({word}) {subject}:{subject}", end="\n", occluded="",
):  # fmt: skip
    """subjects: {name: (layout, (positions, rotations, seen))}; what one laboratory's export looks like."""

    def number(value):
        return f"{value:.9f}".replace(".", point)

    words = {"quaternion": "Quaternion", "helical": "Helical", "euler": "EulerXYZ"}
    widths = {subject: 7 if layout == "quaternion" else 6 for subject, (layout, _) in subjects.items()}
    titles, columns, units = ["", ""], ["Frame", "Sub Frame"], ["", ""]
    for subject, (layout, _) in subjects.items():
        titles += [title.format(word=words[layout], subject=subject), *[""] * (widths[subject] - 1)]
        columns += ["RX", "RY", "RZ", *(["RW"] if layout == "quaternion" else []), "TX", "TY", "TZ"]
        units += [""] * 4 if layout == "quaternion" else [angle] * 3
        units += [length] * 3
    lines = [name, f"{rate:g}", *(delimiter.join(row) for row in (titles, columns, units))]
    frames = len(next(iter(subjects.values()))[1][0])
    for i in range(frames):
        cells = [str(first + i), "0"]
        for subject, (layout, (position, rotations, seen)) in subjects.items():
            scale = 1.0 if layout == "quaternion" else UNITS[angle]
            values = [*turn(rotations[i : i + 1], layout)[0] * scale, *position[i] * UNITS[length]]
            cells += [number(v) for v in values] if seen[i] else [occluded] * widths[subject]
        lines.append(delimiter.join(cells))
    file.write_text(blank + end.join(lines) + end, newline="")
    return file


def assert_same(subject, wanted):
    position, rotations, seen = wanted
    np.testing.assert_array_equal(subject.seen, seen)
    np.testing.assert_allclose(subject.position[seen], position[seen], atol=1e-6)
    turned = (Rotation.from_quat(subject.quaternion[seen]) * rotations[seen].inv()).magnitude()
    np.testing.assert_allclose(turned, 0, atol=1e-6)
    assert np.isnan(subject.quaternion[~seen]).all()


@pytest.mark.parametrize("layout", ["quaternion", "helical", "euler"])
@pytest.mark.parametrize(("delimiter", "point"), [(",", "."), (";", "."), (";", ","), ("\t", ".")])
@pytest.mark.parametrize(("length", "angle"), [("mm", "rad"), ("m", "deg"), ("cm", "deg")])
def test_poses_of_every_layout_come_back(tmp_path, layout, delimiter, point, length, angle):
    wanted = {"cf1": (layout, poses()), "gate": (layout, poses(seed=1))}
    file = write(tmp_path / "log", wanted, delimiter=delimiter, point=point, length=length, angle=angle)
    log = read_log(file)
    assert [subject.name for subject in log.subjects] == ["cf1", "gate"]
    for subject in log.subjects:
        assert_same(subject, wanted[subject.name][1])
        np.testing.assert_allclose(subject.time, np.arange(40) / RATE)
    assert (log.notes, log.truncated) == ((), False)


def test_layouts_may_stand_side_by_side(tmp_path):
    wanted = {"a": ("quaternion", poses()), "b": ("euler", poses(seed=1)), "c": ("helical", poses(seed=2))}
    for subject in read_log(write(tmp_path / "log", wanted, angle="deg")).subjects:
        assert_same(subject, wanted[subject.name][1])


@pytest.mark.parametrize("blank", ["", "\n", "\r\n\r\n", "\ufeff"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_blank_lines_line_ends_and_byte_order_marks_change_nothing(tmp_path, blank, end):
    wanted = poses()
    log = read_log(write(tmp_path / "log", {"cf1": ("quaternion", wanted)}, blank=blank, end=end))
    assert_same(log.subjects[0], wanted)


def test_decimal_commas_are_known_also_where_the_first_frame_sees_nothing(tmp_path):
    position, rotations, seen = poses()
    seen[0] = False
    file = write(tmp_path / "log", {"cf1": ("quaternion", (position, rotations, seen))}, delimiter=";", point=",")
    assert_same(read_log(file).subjects[0], (position, rotations, seen))


def test_zeros_all_along_are_an_occlusion(tmp_path):
    wanted = poses()
    log = read_log(write(tmp_path / "log", {"cf1": ("helical", wanted)}, occluded="0"))
    assert_same(log.subjects[0], wanted)


def test_angles_without_a_word_are_helical_and_the_log_says_so(tmp_path):
    wanted = poses()
    file = write(tmp_path / "log", {"cf1": ("helical", wanted)}, name="Segments", angle="deg", title="{subject}:root")
    log = read_log(file)
    assert log.subjects[0].name == "cf1:root"
    assert_same(log.subjects[0], wanted)
    assert "taken as helical" in log.notes[0]


def test_angles_without_a_word_are_what_the_reader_is_told(tmp_path):
    wanted = poses()
    file = write(tmp_path / "log", {"cf1": ("euler", wanted)}, angle="deg", title="{subject}")
    log = read_log(file, rotations=Rotations.EULER)
    assert_same(log.subjects[0], wanted)
    assert log.notes == ()


def test_markers_have_positions_and_no_orientation(tmp_path):
    file = tmp_path / "log"
    file.write_text(
        "Trajectories\n100\n,,cf1:m1,,,cf1:m2,,\nFrame,Sub Frame,X,Y,Z,X,Y,Z\n,,mm,mm,mm,mm,mm,mm\n"
        "7,0,1000,2000,3000,,,\n8,0,1001,2001,3001,10,20,30\n"
    )
    first, second = read_log(file).subjects
    assert (first.name, second.name) == ("cf1:m1", "cf1:m2")
    np.testing.assert_allclose(first.position, [[1, 2, 3], [1.001, 2.001, 3.001]])
    np.testing.assert_allclose(second.position, [[np.nan] * 3, [0.01, 0.02, 0.03]])
    assert np.isnan(first.quaternion).all()


def test_sections_of_other_rates_have_times_of_their_own_and_forces_are_left_out(tmp_path):
    wanted, file = poses(), tmp_path / "log"
    write(file, {"cf1": ("quaternion", wanted)}, first=11)
    write(tmp_path / "b", {"gate": ("euler", wanted)}, rate=RATE / 2, first=11)
    forces = "Devices\n1200\n,,Plate,,\nFrame,Sub Frame,Fx,Fy,Fz\n,,N,N,N\n11,0,1,2,3\n11,1,1,2,3\n"
    file.write_text("\n".join([file.read_text(), forces, (tmp_path / "b").read_text()]))
    log = read_log(file)
    assert [subject.name for subject in log.subjects] == ["cf1", "gate"]
    np.testing.assert_allclose(log.subjects[0].time, np.arange(40) / RATE)
    np.testing.assert_allclose(log.subjects[1].time, np.arange(40) / (RATE / 2))
    assert "Devices" in log.notes[0]
    assert log.notes[1] == f"sections of {RATE:g} and {RATE / 2:g} Hz, each with its own times"


def test_a_gap_in_the_frame_numbers_is_a_gap_in_time(tmp_path):
    file = write(tmp_path / "log", {"cf1": ("quaternion", poses())})
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join(lines[:15] + lines[25:]))
    time = read_log(file).subjects[0].time
    assert time[10] - time[9] == pytest.approx(11 / RATE)


def test_frames_that_go_back_are_left_out_and_said(tmp_path):
    file = write(tmp_path / "log", {"cf1": ("quaternion", poses())})
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join([*lines, *lines[10:12]]))
    log = read_log(file)
    assert len(log.subjects[0].time) == 40
    assert "2 frames" in log.notes[0]


def test_blank_lines_between_frames_do_not_end_a_section(tmp_path):
    wanted = poses()
    file = write(tmp_path / "log", {"cf1": ("quaternion", wanted)})
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join([*lines[:20], "\n", *lines[20:]]))
    assert_same(read_log(file).subjects[0], wanted)


def test_a_subject_that_is_not_there_is_answered_with_those_that_are(tmp_path):
    log = read_log(write(tmp_path / "log", {"cf1": ("quaternion", poses()), "gate": ("euler", poses())}))
    assert [s.name for s in log.select(["gate"])] == ["gate"]
    with pytest.raises(InputError, match="no subject 'cf2'") as caught:
        log.select(["cf2"])
    assert caught.value.hint == "it has: cf1, gate"


HEAD = "Objects\n100\n,,cf1:cf1,,,,,\nFrame,Sub Frame,RX,RY,RZ,TX,TY,TZ\n,,deg,deg,deg,mm,mm,mm\n"


@pytest.mark.parametrize(
    ("text", "message", "line"),
    [
        (HEAD.replace(",TZ", "") + "1,0,1,2,3,4,5\n", "no column TZ", 1),
        (HEAD.replace("deg,deg,deg", "grad,grad,grad") + "1,0,1,2,3,4,5,6\n", "unit of 'cf1' is grad", 1),
        (HEAD.replace("mm,mm,mm", "inch,inch,inch") + "1,0,1,2,3,4,5,6\n", "unit of 'cf1' is inch", 1),
        (HEAD.replace("mm,mm,mm", "mm,m,mm") + "1,0,1,2,3,4,5,6\n", "m, mm", 1),
        (HEAD.replace(",,deg,deg,deg,mm,mm,mm\n", "") + "1,0,1,2,3,4,5,6\n", "no unit", 1),
        (HEAD.replace("mm,mm,mm", "m,m,m") + "1,0,1,2,3,400,5000,6\n", "5000 m from the origin", None),
        (HEAD.replace("\n100\n", "\nfast\n") + "1,0,1,2,3,4,5,6\n", "rate", 1),
        (HEAD.replace("\n100\n", "\n0\n") + "1,0,1,2,3,4,5,6\n", "rate", 1),
        (HEAD.replace("Frame,Sub Frame,", "Sample,Part,") + "1,0,1,2,3,4,5,6\n", "no column Frame", 1),
        (HEAD + "1,0,1,2,3,4,5,6\n2,0,1,2,x3,4,5,6\n", "'x3' in column 5", 7),
        (HEAD + "1,0,1,2,3,4,5,6\n2,0,1,2,3,4\n3,0,1,2,3,4,5,6\n", "6 cells, 8", 7),
        (HEAD, "no pose", None),
        (HEAD + "1,0,,,,,,\n", "no pose", None),
        ("Objects\n100\n", "ends before its columns", 1),
        (
            HEAD.replace("RX,RY,RZ", "RX,RY,RZ,RW").replace("deg,deg,deg", ",,,") + "1,0,3,0,0,0,4,5,6\n",
            "length 3",
            None,
        ),
    ],
)
def test_what_is_wrong_is_named_with_its_place(tmp_path, text, message, line):
    file = tmp_path / "log.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_log(file)
    assert caught.value.where == (f"{file}:{line}" if line else str(file))
    assert "\n" not in str(caught.value)


def test_a_subject_that_stands_twice_is_read_once_and_said(tmp_path):
    file = write(tmp_path / "log", {"cf1": ("quaternion", poses())})
    file.write_text(file.read_text() + "\n" + file.read_text())
    log = read_log(file)
    assert len(log.subjects) == 1
    assert "twice" in log.notes[0]


def test_a_last_line_that_is_cut_off_ends_the_log_and_is_said(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text(HEAD + "1,0,1,2,3,4,5,6\n2,0,1,2,3,4")
    log = read_log(file)
    assert log.truncated
    assert len(log.subjects[0].time) == 1
    assert "cut off" in log.notes[-1]


@pytest.mark.parametrize("content", [b"", b"a picture", b"\x00" * 100, b"Objects\n"])
def test_what_is_no_log_is_told_so(tmp_path, content):
    file = tmp_path / "log.csv"
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"empty|unknown format"):
        read_log(file)


def test_a_file_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_log(tmp_path / "none.csv")


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    file = tmp_path_factory.mktemp("vicon") / "log.csv"
    return write(file, {"cf1": ("quaternion", poses()), "gate": ("euler", poses(seed=1))}).read_bytes()


@settings(deadline=None, max_examples=150)
@given(data=st.data())
def test_damage_anywhere_is_an_error_that_is_named_or_a_log(tmp_path_factory, sound, data):
    start = data.draw(st.integers(0, len(sound)))
    end = data.draw(st.integers(start, min(len(sound), start + 300)))
    patch = data.draw(st.one_of(st.binary(max_size=20), st.sampled_from([b"\n\n", b",,,\n", b";", b"1e999", b'"'])))
    file = tmp_path_factory.mktemp("damaged") / "log.csv"
    file.write_bytes(sound[:start] + patch + sound[end:])
    check_damaged(file)


@given(cut=st.integers(1, 5000))
@settings(deadline=None, max_examples=60)
def test_a_log_cut_anywhere_is_read_up_to_the_cut_or_is_an_error(tmp_path_factory, sound, cut):
    file = tmp_path_factory.mktemp("cut") / "log.csv"
    file.write_bytes(sound[: len(sound) - cut])
    wanted = poses()
    log = log_or_error(file)
    if isinstance(log, InputError):
        assert "\n" not in str(log)
        return
    subject = log.subjects[0]
    whole = len(subject.time) - 1  # the last may be cut within a number
    seen = wanted[2][:whole]
    np.testing.assert_allclose(subject.position[:whole][seen], wanted[0][:whole][seen], atol=1e-6)
