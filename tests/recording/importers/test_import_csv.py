"""CSV and TSV of other programs, in their smallest form: places in metres, attitudes, and times come back in SI."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.recording.importers.formats import read_log

S = f"{math.sqrt(0.5):.9f}"  # a quarter turn to the left about z is 0, 0, S, S; written as ~ below


def lines(*each):
    return "\n".join(each) + "\n"


def motive(unit="Meters", scale=1):
    place = f"{scale},{3 * scale},{-2 * scale}"
    return lines(
        f"Format Version,1.23,Take Name,one,Rotation Type,Quaternion,Length Units,{unit},Coordinate Space,Global", "",
        ",Type" + 8 * ",Rigid Body" + 3 * ",Marker", ",Name" + 8 * ",cf1" + 3 * ",wand", ",ID" + 8 * ",7C" + 3 * ",8D",
        "," + 4 * ",Rotation" + 3 * ",Position" + ",Error" + 3 * ",Position",
        "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z",
        f"0,0.0,0,~,0,~,{place},0.1,1,2,3", f"1,0.01,0,~,0,~,{place},0.1,1,2,3", "2,0.02,,,,,,,,,1,2,3",
    )  # fmt: skip


QTM_HEAD = ("NO_OF_FRAMES\t3", "NO_OF_CAMERAS\t8", "NO_OF_BODIES\t2", "FREQUENCY\t100", "BODY_NAMES\tgate\tcf1")
HIDDEN = 16 * "\t0"
SEEN = "\t1000\t2000\t3000\t0\t0\t90\t0.4\t0\t1\t0\t-1\t0\t0\t0\t0\t1"
QTM = lines(
    *QTM_HEAD, "Frame\tTime\tgate X\tY\tZ\tRoll\tPitch\tYaw\tResidual\tRot[0]",
    f"1\t0.00{HIDDEN}{SEEN}", f"2\t0.01{HIDDEN}{SEEN}", f"3\t0.02{HIDDEN}{HIDDEN}",
)  # fmt: skip
NAMED = "CSV of t, x, y, z"
READ = {  # name: format, content; a body at (1, 2, 3), turned by 90° to the left, at times 0.01 s apart
    "semicolons": (NAMED, lines("t;x;y;z;qx;qy;qz;qw", "0;1;2;3;0;0;~;~", "0.01;1;2;3;0;0;~;~")),
    "decimal commas": (NAMED, lines("t;x;y;z;qx;qy;qz;qw", "0,0;1,0;2,0;3,0;0;0;~;~", "0,01;1;2;3;0;0;~;~")),
    "tabs and capitals": (NAMED, lines(
        "Time X Y Z QX QY QZ QW", "0 1 2 3 0 0 ~ ~", ".01 1 2 3 0 0 ~ ~").replace(" ", "\t")),
    "a comment first": (NAMED, lines(
        "# of 12:30, cf1", "t,x,y,z,qx,qy,qz,qw", "0,1,2,3,0,0,~,~", "0.01,1,2,3,0,0,~,~")),
    "units": (NAMED, lines(
        '"Time [msec]","x [m]","y [cm]","z [mm]",qx,qy,qz,qw', "0,1,200,3000,0,0,~,~", "10,1,200,3000,0,0,~,~")),
    "race planner": ("CSV of t, p_x, p_y, p_z", lines(
        "t,p_x,p_y,p_z,q_w,q_x,q_y,q_z,v_x", "0,1,2,3,~,0,0,~,9", "0.01,1,2,3,~,0,0,~,9")),
    "TUM": ("TUM trajectory", lines(
        "# ground truth", "# timestamp tx ty tz qx qy qz qw", "17.00  1 2 3 0 0 ~ ~", "17.01  1 2 3 0 0 ~ ~")),
    "EuRoC": ("EuRoC ground truth", lines(
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v [m s^-1]",
        "0,1,2,3,~,0,0,~,9", "10000000,1,2,3,~,0,0,~,9")),
    "cfclient": ("cfclient log", lines(
        ",".join(["Timestamp", *(f"stateEstimate.{name}" for name in ("x", "y", "z", "roll", "pitch", "yaw"))]),
        "5120,1.0,2.0,3.0,0.0,-0.0,90.0", "5130,1.0,2.0,3.0,0.0,0.0,90.0")),
    "Motive": ("Motive CSV", motive()),
    "Motive in mm": ("Motive CSV", motive("Millimeters", 1000)),
    "Motive without labels": ("Motive CSV", motive().replace(",Type", ",").replace(",Name", ",").replace(",ID", ",")),
    "QTM": ("QTM TSV", QTM),
    "QTM without Frame and Time": ("QTM TSV", lines(
        *QTM_HEAD, *((HIDDEN + body)[1:] for body in (SEEN, SEEN, HIDDEN)))),
}  # fmt: skip


def read(folder, content):
    file = folder / "cf1.csv"
    file.write_text(content)
    return read_log(file)


@pytest.mark.parametrize("name", READ)
def test_a_pose_comes_back(tmp_path, name):
    kind, content = READ[name]
    log = read(tmp_path, content.replace("~", S.replace(".", "," if name == "decimal commas" else ".")))
    assert (log.format, log.truncated) == (kind, False)
    (subject,) = [subject for subject in log.subjects if subject.name in ("cf1", "estimate")]
    assert np.diff(subject.time[:2]) == pytest.approx(0.01, abs=1e-6)
    for position, quaternion in zip(subject.position[:2], subject.quaternion[:2], strict=True):
        assert position == pytest.approx([1, 2, 3])
        assert Rotation.from_quat(quaternion).apply([1, 0, 0]) == pytest.approx([0, 1, 0], abs=1e-6)
    assert not subject.seen[2:].any()


def test_motive_says_which_axis_is_taken_as_up_and_its_markers_are_points(tmp_path):
    log = read(tmp_path, motive().replace("~", S))
    assert "y axis is taken as up" in " ".join(log.notes)
    wand = log.select(["wand"])[0]
    assert wand.position[0] == pytest.approx([1, -3, 2])
    assert np.isnan(wand.quaternion).all()


def test_angles_of_motive_are_left_out_and_told(tmp_path):
    log = read(tmp_path, motive().replace("~", S).replace("Z,W,X", "Z,,X"))
    assert np.isnan(log.select(["cf1"])[0].quaternion).all()
    assert "quaternions" in " ".join(log.notes)


def test_markers_of_qtm_are_points(tmp_path):
    head = "FILE_VERSION\t2.0.0\nFREQUENCY\t50\nMARKER_NAMES\ta\tb\n"
    log = read(tmp_path, head + "1000\t0\t500\t0\t0\t0\t\n1000\t0\t500\t2000\t0\t100\t\n")
    a, b = log.subjects
    assert a.time == pytest.approx([0, 0.02])
    assert a.position == pytest.approx(np.array([[1, 0, 0.5]] * 2))
    assert b.seen.tolist() == [False, True]


@pytest.mark.parametrize(
    ("content", "names"),
    [("0,1,2,3\n0.01,1,2,3\n", "t, x, y, z"), ("# a log\n0 1 2 3 0 0 0 1\n.01 1 2 3 0 0 0 1\n", "t, tx, ty, tz")],
)
def test_columns_without_names_are_read_and_told(tmp_path, content, names):
    log = read(tmp_path, content)
    assert log.subjects[0].position[1] == pytest.approx([1, 2, 3])
    assert f"taken as {names}" in log.notes[0]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("0,1,2,3,4\n1,1,2,3,4\n", "no column x, y, z, t.*names: none"),
        ("frame,x,y,z\n0,1,2,3\n", "no column t.*names: frame, x, y, z"),
        ("t,x,y\n0,1,2\n", "no column z"),
        ("t [h],x [m],y [m],z [m]\n0,1,2,3\n", "the unit 'h' is unknown"),
        ("Time;X;Y;Z\n", "no rows of numbers below the header"),
        (motive("Feet"), "unit of lengths is 'feet'"),
        ("Format Version,1.23\n\n0,1,2\n", "not that of Motive"),
        (QTM.replace("\t100\n", "\tEXT\n"), "no bodies or markers with a frequency"),
        (QTM.replace("\tcf1\n", "\tcf1\tcf2\n"), "all their columns"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(tmp_path, content, message):
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, content)
    assert caught.value.where.startswith(str(tmp_path / "cf1.csv:"))


patches = st.sampled_from(
    ["", "\n", "\n\n", ",", ";", "\t", '"', "#", "soon", "1e999", "\0", "-", "[h]", "nan", ",,,\n"]
)


@settings(deadline=None, max_examples=200)
@given(name=st.sampled_from(sorted(READ)), patch=patches, data=st.data())
def test_damage_anywhere_is_an_error_with_its_place_and_a_hint_or_a_log(tmp_path_factory, name, patch, data):
    content = READ[name][1].replace("~", S)
    begin = data.draw(st.integers(0, len(content)))
    rest = content[begin + data.draw(st.integers(0, 40)) :] if data.draw(st.booleans()) else ""
    try:
        log = read(tmp_path_factory.mktemp("damaged"), content[:begin] + patch + rest)
    except InputError as error:
        log = error
    if isinstance(log, InputError):
        assert log.where
        assert log.hint
        return
    for subject in log.subjects:
        assert subject.position.shape == (len(subject.time), 3)
        assert np.all(np.diff(subject.time) > 0)
