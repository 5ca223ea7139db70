"""Vicon CSV of every layout: what is written comes back, and what is wrong is named."""

from itertools import chain

import numpy as np
import pytest
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
    seen[0] = seed != 1
    return rng.uniform(-3, 3, (count, 3)), Rotation.random(count, rng=rng), seen


def by_hand_euler(rotations):
    """The angles of R = Rx(a) Ry(b) Rz(c), from the entries of R."""
    m = rotations.as_matrix()
    return np.stack(
        [np.arctan2(-m[:, 1, 2], m[:, 2, 2]), np.arcsin(m[:, 0, 2]), np.arctan2(-m[:, 0, 1], m[:, 0, 0])], axis=1
    )


LAYOUTS = {  # the word for it, and the columns of its rotation, in rad
    "quaternion": ("Quaternion", Rotation.as_quat),
    "helical": ("Helical", Rotation.as_rotvec),
    "euler": ("EulerXYZ", by_hand_euler),
}


def text_of(
    subjects, *, delimiter=",", point=".", length="mm", angle="rad", rate=RATE, name="Objects", first=1, blank="",
    title="Global Angle ({word}) {subject}:{subject}", end="\n", occluded="",
):  # fmt: skip
    """subjects: {name: (layout, (positions, rotations, seen))}; what one laboratory's export looks like."""
    titles, columns, units, parts = ["", ""], ["Frame", "Sub Frame"], ["", ""], []
    for subject, (layout, (position, rotations, seen)) in subjects.items():
        word, turn = LAYOUTS[layout]
        angles = [""] * 4 if layout == "quaternion" else [angle] * 3
        titles += [title.format(word=word, subject=subject), *[""] * (len(angles) + 2)]
        columns += [*("RX", "RY", "RZ", "RW")[: len(angles)], "TX", "TY", "TZ"]
        units += [*angles, *[length] * 3]
        values = np.hstack([turn(rotations) * UNITS.get(angles[0], 1.0), position * UNITS[length]])
        cells = [[f"{value:.9f}".replace(".", point) for value in row] for row in values]
        parts.append([row if there else [occluded] * len(row) for row, there in zip(cells, seen, strict=True)])
    frames = [[str(first + i), "0", *chain(*row)] for i, row in enumerate(zip(*parts, strict=True))]
    lines = [name, f"{rate:g}", *(delimiter.join(row) for row in (titles, columns, units, *frames))]
    return blank + end.join(lines) + end


def write(file, subjects, **options):
    file.write_text(text_of(subjects, **options), newline="")
    return file


def assert_same(subject, wanted, atol=1e-6):
    position, rotations, seen = wanted
    np.testing.assert_array_equal(subject.seen, seen)
    np.testing.assert_allclose(subject.position[seen], position[seen], atol=atol)
    turned = (Rotation.from_quat(subject.quaternion[seen]) * rotations[seen].inv()).magnitude()
    np.testing.assert_allclose(turned, 0, atol=atol)
    assert np.isnan(subject.quaternion[~seen]).all()


WANTED = {layout: (layout, poses(seed=seed)) for seed, layout in enumerate(LAYOUTS)}
ONE = {"cf1": ("quaternion", poses())}


@pytest.mark.parametrize("subjects", [WANTED, *({layout: WANTED[layout]} for layout in WANTED)], ids=", ".join)
@pytest.mark.parametrize(("delimiter", "point"), [(",", "."), (";", "."), (";", ","), ("\t", ".")])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"length": "m", "angle": "deg", "blank": "\r\n\r\n", "end": "\r\n"},
        {"length": "cm", "angle": "deg", "blank": "\ufeff", "occluded": "0"},
        {"blank": "\n", "first": 11},
    ],
)
def test_poses_of_every_layout_come_back(tmp_path, subjects, delimiter, point, options):
    log = read_log(write(tmp_path / "log", subjects, delimiter=delimiter, point=point, **options))
    assert [subject.name for subject in log.subjects] == list(subjects)
    for subject in log.subjects:
        assert_same(subject, subjects[subject.name][1])
        np.testing.assert_allclose(subject.time, np.arange(40) / RATE)
    assert (log.notes, log.truncated) == ((), False)


@pytest.mark.parametrize(
    ("layout", "given", "notes"), [("helical", None, ["taken as helical"]), ("euler", Rotations.EULER, [])]
)
def test_angles_without_a_layout_are_read_as_the_given_one_or_else_as_helical(tmp_path, layout, given, notes):
    file = write(tmp_path / "log", {"cf1": (layout, poses())}, name="Segments", angle="deg", title="{subject}:root")
    log = read_log(file, rotations=given)
    assert log.subjects[0].name == "cf1:root"
    assert_same(log.subjects[0], poses())
    assert [note[-len("taken as helical") :] for note in log.notes] == notes


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
    file = tmp_path / "log"
    forces = "Devices\n1200\n,,Plate,,\nFrame,Sub Frame,Fx,Fy,Fz\n,,N,N,N\n11,0,1,2,3\n11,1,1,2,3\n"
    slower = text_of({"gate": ("euler", poses())}, rate=RATE / 2, first=11)
    file.write_text("\n".join([text_of(ONE, first=11), forces, slower]))
    log = read_log(file)
    assert [subject.name for subject in log.subjects] == ["cf1", "gate"]
    for subject, rate in zip(log.subjects, (RATE, RATE / 2), strict=True):
        np.testing.assert_allclose(subject.time, np.arange(40) / rate)
    assert "Devices" in log.notes[0]
    assert log.notes[1] == f"sections of {RATE:g} and {RATE / 2:g} Hz, each with its own times"


@pytest.mark.parametrize(
    ("change", "frames", "notes"),
    [
        (lambda head, rows: [*head, *rows[:10], *rows[20:]], [*range(10), *range(20, 40)], []),
        (lambda head, rows: [*head, *rows, *rows[5:7]], range(40), ["2 frames of section Objects left out"]),
        (lambda head, rows: [*head, *rows[:15], "\n", *rows[15:]], range(40), []),
        (lambda head, rows: [*head, *rows, "\n", *head, *rows], range(40), ["cf1 occurs twice in the file"]),
        (lambda head, rows: [*head, *rows[:30], rows[30][:40]], range(30), ["the last line is cut off"]),
    ],
    ids=["gap", "back", "blank line", "twice", "cut off"],
)
def test_frames_stand_at_the_time_of_their_number_whatever_else_is_in_the_file(tmp_path, change, frames, notes):
    lines = text_of(ONE).splitlines(keepends=True)
    file = tmp_path / "log"
    file.write_text("".join(change(lines[:5], lines[5:])))
    log = read_log(file)
    (subject,) = log.subjects
    np.testing.assert_allclose(subject.time, np.array(frames) / RATE)
    assert_same(subject, [part[np.array(frames)] for part in poses()])
    assert len(log.notes) == len(notes)
    assert all(note in found for note, found in zip(notes, log.notes, strict=True))
    assert log.truncated == any("cut off" in note for note in notes)


def test_a_subject_that_is_not_there_is_answered_with_those_that_are(tmp_path):
    log = read_log(write(tmp_path / "log", {"cf1": ("quaternion", poses()), "gate": ("euler", poses())}))
    assert [s.name for s in log.select(["gate"])] == ["gate"]
    with pytest.raises(InputError, match="no subject 'cf2'") as caught:
        log.select(["cf2"])
    assert caught.value.hint == "it has: cf1, gate"


HEAD = "Objects\n100\n,,cf1:cf1,,,,,\nFrame,Sub Frame,RX,RY,RZ,TX,TY,TZ\n,,deg,deg,deg,mm,mm,mm\n"
ROW = "1,0,1,2,3,4,5,6\n"
QUATERNIONS = HEAD.replace("RX,RY,RZ", "RX,RY,RZ,RW").replace("deg,deg,deg", ",,,")


@pytest.mark.parametrize(
    ("text", "message", "line"),
    [
        (HEAD.replace(",TZ", "") + "1,0,1,2,3,4,5\n", "no column TZ", 1),
        (HEAD.replace("deg,deg,deg", "grad,grad,grad") + ROW, "unit of 'cf1' is grad", 1),
        (HEAD.replace("mm,mm,mm", "inch,inch,inch") + ROW, "unit of 'cf1' is inch", 1),
        (HEAD.replace("mm,mm,mm", "mm,m,mm") + ROW, "m, mm", 1),
        (HEAD.replace(",,deg,deg,deg,mm,mm,mm\n", "") + ROW, "no unit", 1),
        (HEAD.replace("mm,mm,mm", "m,m,m") + "1,0,1,2,3,400,5000,6\n", "5000 m from the origin", None),
        (HEAD.replace("\n100\n", "\nfast\n") + ROW, "rate", 1),
        (HEAD.replace("\n100\n", "\n0\n") + ROW, "rate", 1),
        (HEAD.replace("Frame,Sub Frame,", "Sample,Part,") + ROW, "no column Frame", 1),
        (HEAD + ROW + "2,0,1,2,x3,4,5,6\n", "'x3' in column 5", 7),
        (HEAD + ROW + "2,0,1,2,3,4\n" + ROW, "6 cells, 8", 7),
        (HEAD, "no pose", None),
        (HEAD + "1,0,,,,,,\n", "no pose", None),
        ("Objects\n100\n", "ends before its columns", 1),
        (QUATERNIONS + "1,0,3,0,0,0,4,5,6\n", "length 3", None),
    ],
)
def test_what_is_wrong_is_named_with_its_place(tmp_path, text, message, line):
    file = tmp_path / "log.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_log(file)
    assert caught.value.where == (f"{file}:{line}" if line else str(file))
    assert "\n" not in str(caught.value)
