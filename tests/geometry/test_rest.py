"""Rest at the ends for sources that have none, and polynomial files."""

import pathlib

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.geometry.min_snap import REST, pieces_through
from cfplan.geometry.path import Path
from cfplan.geometry.polynomial_csv import read_polynomials
from cfplan.geometry.polynomials import end_values, hermite, reversed_pieces, shifted
from cfplan.geometry.rest import close_joints, with_rest_ends

HEADER = "duration," + ",".join(f"{axis}^{k}" for axis in ("x", "y", "z", "yaw") for k in range(8))


def helix(turns: float = 1.0, speed: float = 1.0, pieces: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Pieces of degree 7 that fit a helix of 1 m radius up to jerk: moving at its ends, C³ and nearly C⁴."""
    durations = np.full(pieces, turns * 2 * np.pi / speed / pieces)
    breaks = np.concatenate([[0.0], np.cumsum(durations)])

    def values(t: np.ndarray) -> np.ndarray:
        phase = speed * t[:, None] + np.pi / 2 * np.arange(4)
        circle = speed ** np.arange(4) * np.array([np.cos(phase), np.sin(phase)])
        climb = np.column_stack([1 + 0.1 * t, 0.1 + 0 * t, 0 * t, 0 * t])
        return np.stack([*circle, climb], axis=-1)

    ends = np.concatenate([values(breaks[:-1]), values(breaks[1:])], axis=1)
    powers = durations[0] ** np.arange(8)
    scaled = ends * np.tile(powers[:4], 2)[:, None]
    return durations, hermite(4) @ scaled / powers[:, None]


def distance_to_curve(points: np.ndarray, curve: np.ndarray) -> np.ndarray:
    """(N,): distance of each point to a finely sampled curve, along its nearest chord."""
    nearest = np.array([np.argmin(((curve[1:-1] - p) ** 2).sum(axis=1)) + 1 for p in points])
    a, b = curve[nearest - 1], curve[nearest + 1]
    along = ((points - a) * (b - a)).sum(axis=1) / ((b - a) ** 2).sum(axis=1)
    return np.linalg.norm(points - a - np.clip(along, 0, 1)[:, None] * (b - a), axis=1)


def sampled(durations: np.ndarray, table: np.ndarray, count: int) -> np.ndarray:
    rows = [
        np.array([np.polynomial.polynomial.polyval(x, piece) for x in np.linspace(0, time, count)])
        for time, piece in zip(durations, table, strict=True)
    ]
    return np.concatenate(rows)


@pytest.mark.parametrize("speed", [0.2, 1.0, 3.0])
def test_a_moving_source_is_brought_to_rest(speed):
    path = with_rest_ends(*helix(speed=speed))
    for order in (1, 2, 3):
        assert not path([0.0, path.end], order).any()
    assert np.linalg.norm(path([0.0, path.end], 4), axis=1).min() > 1.0


def test_the_curve_in_space_stays():
    durations, table = helix()
    path = with_rest_ends(durations, table)
    original = sampled(durations, table, 2000)
    points = path(np.linspace(0, path.end, 300))
    assert distance_to_curve(points, original).max() < 1e-6
    np.testing.assert_allclose(path([0.0, path.end]), original[[0, -1]], atol=1e-12)
    polygon = np.linalg.norm(np.diff(original, axis=0), axis=1).sum()
    assert path.length == pytest.approx(polygon, rel=1e-6)


@pytest.mark.parametrize("speed", [0.2, 1.0, 3.0])
def test_whatever_its_own_speed_a_source_is_flown_at_one_nominally(speed):
    path = with_rest_ends(*helix(speed=speed))
    s = np.linspace(1.5, path.end - 1.5, 100)
    np.testing.assert_allclose(np.linalg.norm(path(s, 1), axis=1), 1.0, atol=1e-3)
    assert np.linalg.norm(path(np.linspace(0, path.end, 2000), 1), axis=1).max() < 1.001


@pytest.mark.parametrize("turns", [0.1, 1.0])
def test_speed_is_gathered_monotonically(turns):
    path = with_rest_ends(*helix(turns))
    speed = np.linalg.norm(path(np.linspace(0, min(1.5, path.end / 2), 500), 1), axis=1)
    assert (np.diff(speed) > -1e-4).all()
    path.check()


@pytest.mark.parametrize("order", range(4))
def test_derivatives_are_slopes_across_the_re_timed_stretch(order):
    path = with_rest_ends(*close_joints(*helix()))
    step = 1e-5
    s = np.linspace(0.02, 2.0, 500)
    s = s[np.abs(s[:, None] - path.breaks).min(axis=1) > 2 * step]
    slope = (path(s + step, order) - path(s - step, order)) / (2 * step)
    np.testing.assert_allclose(path(s, order + 1), slope, atol=1e-6 * np.abs(path(s, order + 1)).max())


def test_four_derivatives_are_continuous_at_every_break():
    path = with_rest_ends(*close_joints(*helix()))
    inner = path.breaks[1:-1]
    for order in range(5):
        largest = np.abs(path(path.breaks, order)).max()
        np.testing.assert_allclose(path(np.nextafter(inner, 0), order), path(inner, order), atol=1e-6 * largest)


def test_rest_with_acceleration_left_is_re_timed_too():
    # x = 3u² - 2u³: at rest in speed, not in acceleration
    table = np.zeros((1, 4, 3))
    table[0, 2:, 0] = [3, -2]
    path = with_rest_ends(np.array([1.0]), table)
    for order in (1, 2, 3):
        assert not path([0.0, path.end], order).any()
    np.testing.assert_allclose(path([0.0, path.end])[:, 0], [0, 1], atol=1e-12)
    path.check()


def test_a_source_at_rest_keeps_its_timing():
    table = np.zeros((1, 8, 3))
    table[0, 4:, 0] = [35, -84, 70, -20]
    path = with_rest_ends(np.array([1.0]), table)
    assert path.end == pytest.approx(1.0)
    u = np.linspace(0, 1, 30)
    np.testing.assert_allclose(path(u)[:, 0], u**4 * (35 - 84 * u + 70 * u**2 - 20 * u**3), atol=1e-12)


def test_backwards_twice_is_forwards():
    durations, table = helix()
    again = reversed_pieces(*reversed_pieces(durations, table))[1]
    np.testing.assert_allclose(again, table, atol=1e-12)


def test_shifting_a_polynomial_moves_its_origin():
    table = np.random.default_rng(0).normal(size=(2, 6, 3))
    moved = shifted(table, np.array([0.3, -1.2]))
    for piece, offset in enumerate((0.3, -1.2)):
        np.testing.assert_allclose(
            np.polynomial.polynomial.polyval(0.7, moved[piece]),
            np.polynomial.polynomial.polyval(0.7 + offset, table[piece]),
            rtol=1e-12,
        )


def test_mending_closes_steps_by_halves():
    durations, table = helix()
    table[5, 0] += 1e-4
    left, right = end_values(*close_joints(durations, table))
    np.testing.assert_allclose(left[1:], right[:-1], atol=1e-9)
    before, _ = end_values(durations, table)
    assert np.abs(left[:, 0] - before[:, 0]).max() == pytest.approx(5e-5, rel=1e-3)


def write(file: pathlib.Path, durations: np.ndarray, table: np.ndarray, decimals: int = 6) -> pathlib.Path:
    rows = [HEADER]
    for time, piece in zip(durations, table, strict=True):
        numbers = [time, *piece.T.ravel(), *np.zeros(8)]
        rows.append(",".join(f"{number:.{decimals}f}" for number in numbers))
    file.write_text("\n".join(rows) + "\n")
    return file


def test_a_crazyswarm_file_is_the_curve_that_it_describes(tmp_path):
    durations, table = helix()
    path, corners = read_polynomials(write(tmp_path / "helix.csv", durations, table))
    assert distance_to_curve(path(np.linspace(0, path.end, 200)), sampled(durations, table, 2000)).max() < 1e-5
    np.testing.assert_allclose(corners[:-1], table[:, 0], atol=1e-6)
    np.testing.assert_allclose(corners[-1], path(path.end), atol=1e-9)


def test_a_header_and_a_trailing_comma_change_nothing(tmp_path):
    file = write(tmp_path / "a.csv", *helix())
    plain = tmp_path / "b.csv"
    plain.write_text("".join(line + ",\n" for line in file.read_text().splitlines()[1:]))
    np.testing.assert_array_equal(read_polynomials(file)[0](1.0), read_polynomials(plain)[0](1.0))


def rows_of(file: pathlib.Path) -> list[list[str]]:
    return [line.split(",") for line in file.read_text().splitlines()]


@pytest.mark.parametrize(
    ("line", "column", "value", "message"),
    [
        (4, 1, "0.6", r":4: position jumps by 0\.\d+ m between lines 3 and 4"),
        (4, 2, "-0.2", r":4: velocity jumps by"),
        (4, 3, "1.0", r":4: acceleration jumps by"),
        (6, 9, "", ":6: column 10 is not a number"),
        (2, 0, "-1", ":2: a duration must be at least 0.001 s, not -1"),
        (2, 0, "0", ":2: a duration must be at least 0.001 s, not 0"),
        (3, 5, "nan", ":3: column 6 is not a finite number"),
        (3, 5, "1e300", ":3: column 6 is larger than 1e"),
    ],
)
def test_a_broken_polynomial_file_is_named_by_line(tmp_path, line, column, value, message):
    rows = rows_of(write(tmp_path / "h.csv", *helix()))
    rows[line - 1][column] = value
    (tmp_path / "h.csv").write_text("\n".join(",".join(row) for row in rows))
    with pytest.raises(InputError, match=message):
        read_polynomials(tmp_path / "h.csv")


def test_a_row_of_wrong_length_is_named(tmp_path):
    file = write(tmp_path / "h.csv", *helix())
    file.write_text(file.read_text() + "1.0,2.0,3.0\n")
    with pytest.raises(InputError, match=r"h\.csv:14: the row has 3 numbers, not 33"):
        read_polynomials(file)


def test_a_row_that_waits_in_one_place_is_named(tmp_path):
    durations, table = helix()
    durations, table = np.append(durations, 1.0), np.concatenate([table, np.zeros((1, 8, 3))])
    table[-1, 0] = end_values(durations[-2:-1], table[-2:-1])[1][0, 0]
    with pytest.raises(InputError, match=r":14: the piece stays in one place"):
        read_polynomials(write(tmp_path / "h.csv", durations, table))


def test_laps_of_a_file_that_flows_through_its_start_do_not_stop(tmp_path):
    durations, table = helix()
    table[:, 1:, 2] = 0.0
    table[:, 0, 2] = 1.0
    path, _ = read_polynomials(write(tmp_path / "h.csv", durations, table), laps=3)
    path.check()
    assert path.length == pytest.approx(6 * np.pi, rel=1e-4)


def test_a_path_of_one_polynomial_has_two_pieces(tmp_path):
    path: Path = with_rest_ends(*helix(turns=0.2, pieces=1))
    assert len(path.breaks) > 2
    assert not path([0.0, path.end], 1).any()


def halves_of_a_line() -> tuple[np.ndarray, np.ndarray]:
    """A line of 1 m from rest to rest within 4 s in two pieces: acceleration is 0 at the joint, as at the ends."""
    whole = np.zeros((1, 8, 3))
    whole[0, 4:, 0] = [35, -84, 70, -20]
    whole /= 4.0 ** np.arange(8)[:, None]
    return np.full(2, 2.0), np.concatenate([shifted(whole, np.array([t])) for t in (0.0, 2.0)])


def test_a_jump_is_weighed_against_the_pieces_not_only_their_joints(tmp_path):
    durations, table = halves_of_a_line()
    path, _ = read_polynomials(write(tmp_path / "rounded.csv", durations, table))
    path.check()
    assert np.abs(path(np.linspace(0, path.end, 200))[:, 1:]).max() < 1e-9
    assert path(path.end)[0] == pytest.approx(1.0, abs=1e-3)
    largest = np.linalg.norm(end_values(durations[:1] / 2, table[:1])[1][0, 2])
    table[1, 2, 0] += 0.05 * largest / 2
    with pytest.raises(InputError, match=r":3: acceleration jumps by"):
        read_polynomials(write(tmp_path / "jump.csv", durations, table))


def test_rest_but_for_six_decimals_is_no_cusp(tmp_path):
    points = np.cumsum(np.random.default_rng(36).uniform(-0.1, 0.1, (6, 3)), axis=0)
    durations, table = np.ones(5), pieces_through(points, np.ones(5), REST, rest_end=True)
    path, _ = read_polynomials(write(tmp_path / "slow.csv", durations, table))
    path.check()
    for order in (1, 2, 3):
        assert not path([0.0, path.end], order).any()
    places = path(np.linspace(0, path.end, 200))
    assert distance_to_curve(places, sampled(durations, table, 400)).max() < 1e-5
