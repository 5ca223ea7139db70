"""`cfplan plan`: what it says of a plan compares like with like, in one short line a step."""

import re
from pathlib import Path

import pytest

from cfplan.preparation.plan_flight import plan_flight
from cfplan.safety.limits_file import load_limits

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture
def planned(cfplan, path_file, safety_file, tmp_path):
    """Plan the line with more words, and return what was printed."""
    kept = tmp_path / "plan.parquet"  # for what is not kept nobody waits until everything is compiled
    files = path_file("name: line\nwaypoints: [[-1.2, -1.2, 0.7], [0.0, 0.0, 0.9], [1.2, 1.2, 1.1]]\n"), safety_file()

    def run(*words):
        return cfplan("plan", files[0], "--safety", files[1], "-o", kept, "--force", *words)

    return run


def test_at_half_the_speed_the_flight_and_its_bound_are_twice_as_long(planned):
    shares = []
    for speed in ("1", "0.5"):
        out = planned("--speed", speed).out
        (flight,) = re.findall(r"plan .* ms  (\d+\.\d+) s of flight", out)
        (more, bound) = re.findall(r"bound .* ms  (\d+\.\d) % above (\d+\.\d+) s, which no flight along it", out)[0]
        assert float(flight) / float(bound) - 1.0 == pytest.approx(float(more) / 100, abs=0.004)
        shares.append(float(more))
        assert ("at 0.5 of full speed" in out) == (speed == "0.5")
        assert all(len(line) < 100 for line in out.splitlines() if re.match(r"\S+ (plan|bound) ", line))
    assert shares[1] == pytest.approx(shares[0], abs=0.2)


def test_details_are_told_to_who_asks(planned):
    assert "a gap of 0.2 s" not in planned().out
    assert "a gap of 0.2 s" in planned("--verbose").out


def test_the_bound_is_in_the_document(planned):
    document = planned("--json").json
    assert 0.8 * document["duration"] < document["lower_bound"] < document["duration"]


def test_the_choice_of_a_fastest_path_is_told_and_bench_and_robustness_make_the_same(cfplan, path_file, safety_file):
    rectangle = "waypoints: [[-1.5, 0, 1], [1.5, 0, 1], [1.5, 0.3, 1], [-1.5, 0.3, 1], [-1.5, 0, 1]]"
    files = path_file(f"{rectangle}\n"), "--safety", safety_file()
    chosen, min_snap = {}, {}
    for speed in ("1", "0.5"):
        out = cfplan("plan", *files, "--speed", speed).out
        chosen[speed], min_snap[speed] = re.findall(r" plan .* ms  (\S+) s of flight.* (\S+) s along min-snap", out)[0]
        assert float(chosen[speed]) < 0.95 * float(min_snap[speed])
        ((above, least),) = re.findall(r"point mass .* ms  (\S+) % above (\S+) s, which no vehicle", out)
        assert float(chosen[speed]) / float(least) - 1.0 == pytest.approx(float(above) / 100, abs=0.004)
    assert float(chosen["0.5"]) == pytest.approx(2 * float(chosen["1"]), abs=0.02)
    (benched,) = cfplan("bench", *files, "--planner", "learned", "--json").json["plans"]
    assert f"{benched['duration']:.2f}" == chosen["1"]
    perturbed = cfplan("robustness", *files, "--draws", "1", "--epsilon", "0.001", "--json").json
    assert f"{perturbed['flight']:.2f}" == chosen["1"]


@pytest.mark.parametrize(
    "option", [("--speed", "0.3"), ("--planner", "expert"), ("--nodes", "40"), ("--budget", "1"), ("--model", "models")]
)
@pytest.mark.parametrize("command", ["plan", "check", "sim", "export", "fly"])
def test_a_plan_file_is_used_only_as_it_was_planned(cfplan, plan_file, tmp_path, command, option):
    """With an option that would change its plan, e.g. a lower speed, it must not be flown as if that were not given."""
    more = {
        "export": ["--to", "samples", "-o", tmp_path / "a.csv"],
        "fly": ["--uri", "radio://0/80/2M/E7E7E7E7E7", "--mocap", "vicon://127.0.0.1/cf1", "--records", tmp_path],
    }
    ended = cfplan(command, plan_file, "--safety", REPOSITORY / "safety.yaml", *more.get(command, []), *option)
    assert ended.code == 2
    assert f"{option[0]}: a plan file is flown as it was planned" in ended.err
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def plan_file(tmp_path_factory):
    file = tmp_path_factory.mktemp("plan") / "line.parquet"
    plan_flight(REPOSITORY / "flights" / "line.yaml", load_limits(REPOSITORY / "safety.yaml")).save(file)
    return file
