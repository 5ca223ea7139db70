"""Commands on fleet files: planned, checked and exported together; what is of one plan refuses them in words."""

from pathlib import Path

import numpy as np
import pytest

from cfplan.flight.on_board.memory_format import read_compressed, read_raw
from cfplan.flight.on_board.pieces import states_at

LINES = "vehicles:\n  a: {path: line.yaml}\n  b: {path: line.yaml, place: {yaw_deg: 90}}\n"


@pytest.fixture
def fleet_file(tmp_path):
    """Two lines that cross."""
    (tmp_path / "line.yaml").write_text("waypoints: [[-1, 0, 1], [1, 0, 1]]\nshape: min-snap\n")
    file = tmp_path / "fleet.yaml"
    file.write_text(LINES)
    return file


@pytest.fixture
def export(cfplan, fleet_file, safety_file, tmp_path):
    """Write the fleet in a form; return what was printed as JSON, and the folder."""

    def run(form, *words):
        folder = tmp_path / form
        ended = cfplan("export", fleet_file, "--safety", safety_file(), "--to", form, "-o", folder, "--json", *words)
        assert ended.code == 0, ended.err
        return ended.json, folder

    return run


def places_of_crazyswarm(file, times):
    """Return the x and y, (N, 2) m, that Crazyswarm flies at each time after the start of a file."""
    table = np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2)
    begins = np.concatenate([[0.0], np.cumsum(table[:, 0])])
    rows = np.clip(np.searchsorted(begins, times, side="right") - 1, 0, len(table) - 1)
    own = np.minimum(times - begins[rows], table[rows, 0])
    powers = own[:, None] ** np.arange(8)
    return np.stack([(table[rows, k : k + 8] * powers).sum(axis=1) for k in (1, 9)], axis=1)


@pytest.fixture
def narrow_fleet(tmp_path):
    """Write a fleet of two lines beside each other, nearer than the drift of a lost vehicle."""
    (tmp_path / "line.yaml").write_text("waypoints: [[-0.6, 0, 1], [0.6, 0, 1]]\nshape: min-snap\n")
    file = tmp_path / "fleet.yaml"

    def write(*lines: str):
        file.write_text("\n".join(("apart: 0.3", *lines, LINES.replace("yaw_deg: 90", "y: 0.35"))))
        return file

    return write


def test_a_fleet_is_planned_and_its_pairs_are_certified(cfplan, fleet_file, safety_file):
    document = cfplan("plan", fleet_file, "--safety", safety_file(), "--json").json
    (pair,) = document["pairs"]
    assert pair["pair"] == ["a", "b"]
    assert pair["distance"] >= document["apart"] == 0.35
    assert document["duration"] >= document["slowest_alone"]
    assert any(each["starts"] > 0.0 or each["slower_for"] for each in document["vehicles"])
    assert all(each["certificate"]["passed"] for each in document["vehicles"])


def test_each_lost_vehicle_is_kept_clear_of_by_the_others(cfplan, fleet_file, safety_file):
    document = cfplan("plan", fleet_file, "--safety", safety_file(), "--json").json
    assert {tuple(each["vehicles"]) for each in document["lost"]} == {("a",), ("b",)}
    for each in document["lost"]:
        assert each["distance"] >= document["apart"] - 0.1
        assert each["reaction"] == "the others brake"
        assert 0.0 <= each["time"] <= document["duration"]
    printed = cfplan("plan", fleet_file, "--safety", safety_file()).out
    assert "Lost vehicles: passed" in printed


def test_a_lost_vehicle_that_may_meet_another_is_refused_unless_the_file_only_warns(cfplan, narrow_fleet, safety_file):
    refused = cfplan("plan", narrow_fleet(), "--safety", safety_file())
    assert refused.code == 3
    for each in ("m from a lost vehicle", " lost at (", "the others brake", "lost: warn"):
        assert each in " ".join(refused.err.split())
    warned = cfplan("plan", narrow_fleet("lost: warn"), "--safety", safety_file())
    assert warned.code == 0
    assert "Lost vehicles: not passed" in warned.out


def test_the_vehicles_of_one_dongle_are_lost_together(cfplan, narrow_fleet, safety_file):
    file = narrow_fleet("lost: warn")
    with_uris = file.read_text().replace("line.yaml}", "line.yaml, uri: 'radio://0/80/2M/E7E7E7E701'}")
    file.write_text(with_uris.replace("0.35}", "0.35}, uri: 'radio://0/80/2M/E7E7E7E702'"))
    lost = cfplan("plan", file, "--safety", safety_file(), "--json").json["lost"]
    together = [each for each in lost if each["vehicles"] == ["a", "b"]]
    assert len(together) == 1
    assert together[0]["reaction"] == "all are lost"
    assert together[0]["distance"] < 0.2
    file.write_text(file.read_text().replace("lost: warn", ""))
    refused = cfplan("plan", file, "--safety", safety_file())
    assert refused.code == 3
    assert "own dongle" in " ".join(refused.err.split())


def test_the_figure_of_a_fleet_has_its_paths_distances_and_conflict_map(cfplan, fleet_file, safety_file, tmp_path):
    words = ("plan", fleet_file, "--safety", safety_file(), "--figure", tmp_path / "fleet.svg")
    ended = cfplan(*words)
    assert ended.code == 0
    drawn = (tmp_path / "fleet.svg").read_text()
    for text in ("from above", "distance of each pair", "conflict maps"):
        assert text in drawn
    assert "--force" in cfplan(*words).err


def test_a_fleet_is_rehearsed(cfplan, fleet_file, safety_file):
    ended = cfplan("check", fleet_file, "--safety", safety_file())
    assert ended.code == 0
    assert "Separation: passed" in ended.out
    assert "a – b" in ended.out
    assert "Dry runs" in ended.out


@pytest.mark.slow
@pytest.mark.parametrize("form", ["crazyswarm", "memory", "compressed"])
def test_polynomials_of_a_fleet_that_are_started_together_keep_apart(export, form):
    document, folder = export(form)
    times = np.arange(0.0, 2.0 * document["duration"], 0.01)
    flown = []
    for vehicle in document["vehicles"]:
        written = vehicle["export"]
        assert written["file"] == str(folder / vehicle["name"]) + (".csv" if form == "crazyswarm" else ".bin")
        assert written["certificate"]["passed"]
        assert written["compressed"] == (form == "compressed")
        assert 1.0 <= written["slowing"] < 1.2
        assert written["duration"] > vehicle["ends"]
        if form == "crazyswarm":
            flown.append(places_of_crazyswarm(written["file"], times))
            continue
        memory = Path(written["file"]).read_bytes()
        pieces = read_compressed(memory) if form == "compressed" else read_raw(memory, written["pieces"])
        flown.append(states_at(pieces, np.minimum(times, pieces.duration))[:, 0, :2])
    ends = np.array([[-1.0, 0.0], [0.0, -1.0]])
    for places, end in zip(flown, ends, strict=True):
        np.testing.assert_allclose(places[[0, -1]], [end, -end], atol=2e-3)
    # They lead the plan, by some cm where it is fast, and stray 2 cm at most.
    assert np.linalg.norm(flown[0] - flown[1], axis=1).min() > document["apart"] - 0.05
    assert min(vehicle["starts"] for vehicle in document["vehicles"]) == 0.0
    assert document["pairs"][0]["distance"] >= document["apart"]
    assert document["lost"] == []


def test_samples_of_a_fleet_begin_at_one_time_and_keep_apart(export):
    document, folder = export("samples", "--rate", "50")
    a, b = (np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1) for name in ("a", "b"))
    assert a[0, 0] == b[0, 0] == 0.0
    many = min(len(a), len(b)) - 1
    np.testing.assert_allclose(a[:many, 0], b[:many, 0], atol=1e-9)
    assert np.linalg.norm(a[:many, 1:3] - b[:many, 1:3], axis=1).min() >= document["apart"]
    later = max(document["vehicles"], key=lambda each: each["starts"])
    waits = {"a": a, "b": b}[later["name"]]
    waits = waits[waits[:, 0] < later["starts"]]
    assert len(waits) == pytest.approx(50 * later["starts"], abs=1)
    assert not waits[:, 4:10].any()


def test_no_folder_is_made_for_a_fleet_that_is_refused(cfplan, narrow_fleet, safety_file, tmp_path):
    file = narrow_fleet()
    file.write_text(file.read_text().replace("y: 0.35", "y: 0.2"))
    ended = cfplan("export", file, "--safety", safety_file(), "--to", "samples", "-o", tmp_path / "out")
    assert ended.code == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["../a", "a/b", ".a"])
def test_a_vehicle_whose_name_is_no_file_name_is_refused(cfplan, fleet_file, safety_file, tmp_path, name):
    fleet_file.write_text(LINES.replace("  a:", f"  {name}:"))
    ended = cfplan("export", fleet_file, "--safety", safety_file(), "--to", "samples", "-o", tmp_path / "out")
    assert ended.code == 2
    assert name in ended.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("command", "words", "what"),
    [
        ("plan", ["-o", "a.parquet"], "plan files are not supported"),
        ("fly", ["--records", ".", "--live"], "--live: fleets do not fly with this option"),
        ("fly", ["--records", ".", "--uri", "radio://0/80/2M/E7E7E7E7E7"], "--uri: fleets do not fly with this option"),
        ("export", ["--to", "memory", "--pieces", "40", "-o", "out"], "holds 31 pieces"),
        ("export", ["--to", "memory", "-o", "line.yaml"], "this is a file"),
        ("export", ["--to", "memory", "-o", "."], "the folder already exists"),
    ],
)
def test_what_is_of_one_vehicle_refuses_a_fleet(
    cfplan, fleet_file, safety_file, tmp_path, monkeypatch, command, words, what
):
    monkeypatch.chdir(tmp_path)
    ended = cfplan(command, fleet_file, "--safety", safety_file(), *words)
    assert ended.code == 2
    assert what in ended.err
    assert "hint" in ended.err
    assert not [file for file in tmp_path.iterdir() if file.suffix in (".parquet", ".csv")]
