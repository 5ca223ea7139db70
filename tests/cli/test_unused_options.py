"""An option that would change nothing is refused, before anything is computed: nobody believes that it was followed."""

import pytest


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder to work in, with a folder of records; only their names are looked at."""
    (tmp_path / "records" / "flight").mkdir(parents=True)
    (tmp_path / "records" / "flight" / "flight.mcap").touch()
    monkeypatch.chdir(tmp_path)


FLIGHT = "records/flight"
REFUSED = [
    *[("check", FLIGHT, option, "0.3") for option in ("--safety", "--speed", "--budget", "--model")],
    ("check", FLIGHT, "--nodes", "40"),
    ("check", FLIGHT, "--planner", "expert"),
    *[("replay", "records", option, "a.rrd") for option in ("--save", "--png", "--figure", "--gif", "--plan")],
    ("replay", FLIGHT, "--subject", "cf1"),
    ("replay", FLIGHT, "--angles", "euler"),
    ("replay", FLIGHT, "--safety", "safety.yaml"),
    ("replay", FLIGHT, "--plan", "a.parquet", "--safety", "safety.yaml"),
    *[("validate", FLIGHT, option, "a.yaml") for option in ("--gains", "--polynomials", "--plan")],
    ("validate", FLIGHT, "--offset", "0", "0", "0"),
    ("validate", FLIGHT, "--time-scale", "0.5"),
    ("export", "path.yaml", "--to", "samples", "-o", "a.csv", "--plain"),
    ("export", "path.yaml", "--to", "samples", "-o", "a.csv", "--pieces", "9"),
    ("export", "path.yaml", "--to", "memory", "-o", "a.bin", "--rate", "50"),
]


@pytest.mark.parametrize("words", REFUSED, ids=" ".join)
def test_an_option_that_would_change_nothing_is_refused(cfplan, folder, words):
    ended = cfplan(*words, "--json")
    assert ended.code == 2
    assert ended.json["where"] == [word for word in words if word.startswith("--")][-1]
    assert ended.json["hint"]


@pytest.mark.parametrize("number", ["nan", "inf", "0"])
@pytest.mark.parametrize(
    "words",
    [
        ("plan", "path.yaml", "--budget"), ("plan", "path.yaml", "--speed"), ("virtual", "--seconds"),
        ("mocap", "vicon://127.0.0.1", "--seconds"), ("robustness", "path.yaml", "--epsilon"),
        ("export", "path.yaml", "--to", "samples", "-o", "a.csv", "--rate"), ("validate", FLIGHT, "--mass"),
    ],
    ids=" ".join,
)  # fmt: skip
def test_a_number_out_of_range_is_refused_by_its_option(cfplan, folder, words, number):
    ended = cfplan(*words, number)
    assert ended.code == 2
    assert f"Invalid value for '{words[-1]}'" in ended.err


def test_a_page_that_exists_is_refused_before_a_flight_is_validated(cfplan, folder, tmp_path):
    (tmp_path / "page.html").write_text("mine")
    ended = cfplan("validate", FLIGHT, "--report", "page.html", "--json")
    assert (ended.code, ended.json["where"]) == (2, "page.html")
    assert "--force" in ended.json["hint"]
