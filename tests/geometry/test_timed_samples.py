"""Samples with times: their way becomes a path, and what is lost is told."""

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.geometry.path_file import load_path_file

RADIUS = 0.8


def circle(seconds=8.0, rate=100, noise=0.0, rest=0.0, seed=0):
    """Rows of t, x, y, z: most of a circle with a speed that varies, and a rest of `rest` s half way."""
    time = np.arange(round(seconds * rate) + 1) / rate
    share = time / seconds
    angle = 1.8 * np.pi * (share + 0.1 * np.sin(2 * np.pi * share) / (2 * np.pi))
    if rest:
        half = len(time) // 2
        angle = np.concatenate([angle[:half], np.full(round(rest * rate), angle[half]), angle[half:]])
        time = np.arange(len(angle)) / rate
    position = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), 1.0 + 0.1 * np.sin(angle)], axis=1)
    return np.column_stack([time, position + noise * np.random.default_rng(seed).normal(size=position.shape)])


@pytest.fixture
def load(tmp_path):
    def read(rows, more=""):
        np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t,x,y,z", comments="")
        (tmp_path / "path.yaml").write_text(f"samples: log.csv\n{more}")
        return load_path_file(tmp_path / "path.yaml")

    return read


def off_circle(path):
    places = path(np.linspace(0.0, path.end, 2000))
    angle = np.arctan2(places[:, 1], places[:, 0])
    return np.hypot(np.hypot(places[:, 0], places[:, 1]) - RADIUS, places[:, 2] - 1.0 - 0.1 * np.sin(angle)).max()


@pytest.mark.parametrize(("noise", "rest", "within"), [(0.0, 0.0, 0.002), (0.002, 0.0, 0.006), (0.002, 3.0, 0.006)])
def test_the_way_is_kept_whatever_noise_and_rests_there_are(load, noise, rest, within):
    rows = circle(noise=noise, rest=rest)
    made = load(rows)
    assert off_circle(made.path) < within
    assert made.path(0.0) == pytest.approx(rows[0, 1:], abs=5 * noise + 1e-6)
    assert made.path(made.path.end) == pytest.approx(rows[-1, 1:], abs=5 * noise + 1e-6)
    assert made.path.length == pytest.approx(1.8 * np.pi * RADIUS, rel=0.02)


def test_what_is_lost_is_told(load):
    told = " / ".join(load(circle(noise=0.001, rest=3.0)).losses)
    assert "timing is not kept: 11.0 s of 1101 samples" in told
    assert "1 rests are left out, 3.0 s together" in told or "1 rests are left out, 3.1 s" in told
    assert "mm from the path" in told


def test_a_gap_is_told(load):
    rows = circle()
    told = load(np.delete(rows, slice(300, 380), axis=0)).losses
    assert any("there are no samples for 0.8 s before 3.8 s" in each for each in told)


def test_the_rate_does_not_matter(load):
    slow, quick = (load(circle(rate=rate)).path for rate in (25, 200))
    assert slow.length == pytest.approx(quick.length, rel=2e-3)


@pytest.mark.parametrize(
    ("spoil", "what"),
    [
        (lambda rows: rows[::-1], "csv:3: time goes from"),
        (lambda rows: rows * [1.0, 1000.0, 1000.0, 1000.0], "the motion jumps"),
        (lambda rows: rows * [1.0, 0.001, 0.001, 0.001], "stays within"),
        (lambda rows: rows[:1], "two samples"),
        (lambda rows: np.array([[0.0, 1.0, 0.0, 1.0], [0.1, 0.995, 0.1, 1.0]]), r"csv: .* too short for a smooth path"),
        (lambda rows: rows + 5.0 * (np.arange(len(rows)) == 77)[:, None] * [0, 1, 0, 0], "jumps by"),
        (lambda rows: rows[:, :3], "3 numbers, not 4"),
        (lambda rows: rows[:, [0, 1, 2, 3, 1, 1]], "6 numbers, not 4"),
        (lambda rows: np.add(rows, [1.76e12, 0, 0, 0]), r"larger than 1e\+10"),
    ],
)
def test_what_is_no_motion_is_refused_with_the_line(load, spoil, what):
    with pytest.raises(InputError, match=what):
        load(spoil(circle()))


@pytest.mark.parametrize(
    ("header", "columns", "unused"),
    [
        ("timestamp,x,y,z,qw,qx,qy,qz", (0, 1, 2, 3, 4, 4, 4, 4), "qw, qx, qy, qz"),
        ("Time,Z,Y,X", (0, 3, 2, 1), ""),
        ('"frame","t","x","y","z"', (4, 0, 1, 2, 3), "frame"),
        ("t,x,y,z,yaw", (0, 1, 2, 3, 4), "yaw"),
        ("", (0, 1, 2, 3, 4), "yaw"),
        ("seconds,east,north,up", (0, 1, 2, 3), ""),
    ],
)
def test_columns_are_found_by_their_names_and_others_are_told(load, tmp_path, header, columns, unused):
    rows = circle()
    expected = load(rows)
    wide = np.column_stack([rows, np.ones(len(rows))])[:, columns]
    np.savetxt(tmp_path / "log.csv", wide, delimiter=",", header=header, comments="")
    made = load_path_file(tmp_path / "path.yaml")
    np.testing.assert_array_equal(made.path.coefficients, expected.path.coefficients)
    assert made.losses == (*expected.losses, *([f"columns are not used: {unused}"] if unused else []))


def test_times_may_count_from_1970(load):
    rows = circle(noise=0.001, rest=3.0)
    unix = load(np.add(rows, [1_760_000_000.0, 0, 0, 0]))
    np.testing.assert_array_equal(unix.path.coefficients, load(rows).path.coefficients)
    assert unix.losses[0] == "timing is not kept: 11.0 s of 1101 samples"


def test_a_unix_time_that_goes_back_is_named_by_its_line(load):
    with pytest.raises(InputError, match=r"csv:4: time goes from"):
        load(circle()[[0, 2, 1, 3]] + [1_760_000_000.0, 0, 0, 0])


def test_laps_need_a_closed_way(load):
    with pytest.raises(InputError, match="closed path"):
        load(circle(), "laps: 2\n")
