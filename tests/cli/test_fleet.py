"""Commands on fleet files: planned and checked together; what flies or saves one plan refuses them in words."""

import pytest

LINES = "vehicles:\n  a: {path: line.yaml}\n  b: {path: line.yaml, place: {yaw_deg: 90}}\n"


@pytest.fixture
def fleet_file(tmp_path):
    """Two lines that cross."""
    (tmp_path / "line.yaml").write_text("waypoints: [[-1, 0, 1], [1, 0, 1]]\nshape: min-snap\n")
    file = tmp_path / "fleet.yaml"
    file.write_text(LINES)
    return file


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


@pytest.mark.parametrize(
    ("command", "words", "what"),
    [
        ("plan", ["-o", "a.parquet"], "plan files are not supported"),
        ("fly", ["--records", ".", "--on-board"], "do not fly with --on-board"),
        ("fly", ["--records", ".", "--uri", "radio://0/80/2M/E7E7E7E7E7"], "do not fly with --uri"),
        ("export", ["--to", "samples", "-o", "out.csv"], "a fleet file"),
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
