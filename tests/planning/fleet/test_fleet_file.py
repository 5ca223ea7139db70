"""Fleet files: what they say, and what is refused before anything is planned."""

import json

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cfplan.errors import InputError
from cfplan.geometry.path_file import load_path_file
from cfplan.planning.fleet.fleet_file import is_fleet_file, load_fleet_file

LINE = "waypoints: [[-1, 0, 1], [1, 0, 1]]\n"
TWO = (
    "vehicles:\n  a: {path: line.yaml, uri: 'sim://0', body: one}\n  b: {path: line.yaml, place: {y: 1, yaw_deg: 90}}\n"
)


@pytest.fixture
def fleet_file(tmp_path):
    """Write a fleet file beside a line."""
    (tmp_path / "line.yaml").write_text(LINE)

    def write(text: str):
        file = tmp_path / "fleet.yaml"
        file.write_text(text)
        return file

    return write


def test_each_path_is_turned_and_moved_to_its_place(fleet_file):
    fleet = load_fleet_file(fleet_file(TWO))
    a, b = fleet.vehicles
    assert (fleet.name, fleet.apart, fleet.skew) == ("fleet", 0.35, 0.03)
    assert (a.name, a.uri, a.body) == ("a", "sim://0", "one")
    assert a.path_file.waypoints[0] == pytest.approx([-1, 0, 1])
    assert b.path_file.waypoints[0] == pytest.approx([0, 0, 1])
    assert b.path_file.path(b.path_file.path.end) == pytest.approx([0, 2, 1])


@pytest.mark.parametrize(
    ("text", "what", "line"),
    [
        (TWO.replace("y: 1, yaw_deg: 90", "y: 0.2"), "start 0.20 m from each other", 3),
        (TWO.replace("y: 1, yaw_deg: 90", "x: 2, yaw_deg: 180"), "end 0.00 m", 3),
        (TWO.replace("place", "uri: 'sim://0', place"), "same uri", 3),
        (TWO.replace("place", "body: one, place"), "same body", 3),
        (TWO.replace("path: line.yaml, place", "path: none.yaml, place"), "no such path file", 3),
        ("".join(TWO.splitlines(keepends=True)[:2]), "2 to 6 vehicles, not 1", 1),
        (TWO + "".join(f"  v{n}: {{path: line.yaml, place: {{y: {n}}}}}\n" for n in range(2, 7)), "not 7", 1),
        ("apart: 0.29\n" + TWO, "apart: must be at least 0.3 m", 1),
        ("skew: 0.02\n" + TWO, "skew: must be at least 0.03 s", 1),
        ("skew: 1\n" + TWO, "skew", 1),
    ],
)
def test_a_fleet_that_cannot_be_flown_is_refused_with_its_place(fleet_file, text, what, line):
    file = fleet_file(text)
    with pytest.raises(InputError) as refused:
        load_fleet_file(file)
    assert what in refused.value.what
    assert refused.value.where.startswith(f"{file}:{line}:")
    assert refused.value.hint


def test_a_fleet_file_is_told_from_a_path_file(fleet_file, tmp_path):
    file = fleet_file(TWO)
    assert is_fleet_file(file)
    assert not is_fleet_file(tmp_path / "line.yaml")
    with pytest.raises(InputError, match="a fleet file"):
        load_path_file(file)


@pytest.mark.parametrize(("line", "only_warns"), [("", False), ("lost: refuse\n", False), ("lost: warn\n", True)])
def test_a_lost_vehicle_is_a_reason_to_refuse_unless_the_file_says_to_warn(fleet_file, line, only_warns):
    assert load_fleet_file(fleet_file(line + TWO)).lost_only_warns is only_warns


@given(st.one_of(st.text(max_size=12), st.booleans(), st.none(), st.floats(), st.lists(st.integers(), max_size=2)))
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_other_word_says_what_to_do_about_lost_vehicles(fleet_file, word):
    if word in ("refuse", "warn"):
        return
    file = fleet_file(f"lost: {json.dumps(word)}\n{TWO}")
    with pytest.raises(InputError) as refused:
        load_fleet_file(file)
    assert refused.value.where.startswith(f"{file}:1:") or "lost" not in refused.value.what


def test_vehicles_of_one_dongle_are_known_by_their_addresses(fleet_file):
    three = (
        TWO.replace("uri: 'sim://0'", "uri: 'radio://0/80/2M/E7E7E7E701'").replace(
            "place", "uri: 'radio://0/80/2M/E7E7E7E702', place"
        )
        + "  c: {path: line.yaml, place: {y: 3}, uri: 'radio://1/80/2M/E7E7E7E703'}\n"
    )
    assert load_fleet_file(fleet_file(three)).dongles == {"0": (0, 1)}
    same = three.replace("radio://0/80/2M/E7E7E7E702", "radio://00/80/2M/E7E7E7E702")
    assert load_fleet_file(fleet_file(same)).dongles == {"0": (0, 1)}
    assert load_fleet_file(fleet_file(TWO)).dongles == {}


CRAZYFLIES = """\
fileversion: 3
robots:
  a:
    enabled: true
    uri: radio://0/80/2M/E7E7E7E701
    initial_position: [0.0, 0.5, 0.0]
    type: cf21  # see robot_types
  b: {uri: radio://1/100/2M/E7E7E7E702, type: cf21}
  spare: {enabled: false, uri: radio://0/80/2M/E7E7E7E703}
robot_types:
  cf21:
    motion_capture: {tracking: librigidbodytracker, marker: default_single_marker}
all:
  firmware_params: {commander: {enHighLevel: 1}}
"""
SWARM = """\
name: two
units:
  - uri: radio://0/80/2M/E7E7E7E701
    name: a
    description: Crazyflie 01
  - {uri: radio://1/100/2M/E7E7E7E702, name: b}
lighthouse: room.yaml
"""
NAMED = "addresses: addresses.yaml\n" + TWO.replace("uri: 'sim://0', ", "")


@pytest.mark.parametrize("text", [CRAZYFLIES, SWARM])
def test_addresses_come_from_a_file_of_crazyswarm2_or_cfcli(fleet_file, tmp_path, text):
    (tmp_path / "addresses.yaml").write_text(text)
    a, b = load_fleet_file(fleet_file(NAMED)).vehicles
    assert (a.uri, b.uri) == ("radio://0/80/2M/E7E7E7E701", "radio://1/100/2M/E7E7E7E702")
    own = load_fleet_file(fleet_file(NAMED.replace("body: one", "body: one, uri: 'usb://0'"))).vehicles[0]
    assert own.uri == "usb://0"


@pytest.mark.parametrize(
    ("text", "what", "place"),
    [
        (None, "addresses.yaml", "addresses.yaml"),
        ("", "empty", "addresses.yaml"),
        ("crazyflies:\n  - id: 1\n", "neither `robots` nor `units`", "addresses.yaml"),
        ("- a\n", "keys with values", "addresses.yaml"),
        ("robots: 3\n", "robots", "addresses.yaml:1:"),
        ("robots:\n  a: {enabled: true}\n", "'uri' is missing", "addresses.yaml:2:"),
        ("robots:\n  a: {uri: 80}\n", "uri", "addresses.yaml:2:"),
        (CRAZYFLIES.replace("true", "yes"), "enabled", "addresses.yaml:4:"),
        (CRAZYFLIES.replace("true", "false"), "a is disabled", "addresses.yaml:3:"),
        (CRAZYFLIES.replace("\n  b:", "\n  bb:"), "b is not in", "fleet.yaml:4:"),
        (CRAZYFLIES.replace("radio://1/100/2M/E7E7E7E702", "radio://0/80/2M/E7E7E7E701"), "same uri", "fleet.yaml:4:"),
        (SWARM.replace("name: b", "name: a"), "two units have the name 'a'", "addresses.yaml:6:"),
        (SWARM.replace(", name: b", ""), "'name' is missing", "addresses.yaml:6:"),
        (SWARM.replace("name: b", "name: c"), "b is not in", "fleet.yaml:4:"),
        ("units: &all\n  - *all\n", "anchors", "addresses.yaml:1:"),
    ],
)
def test_a_wrong_file_of_addresses_is_refused_with_its_place(fleet_file, tmp_path, text, what, place):
    if text is not None:
        (tmp_path / "addresses.yaml").write_text(text)
    with pytest.raises(InputError) as refused:
        load_fleet_file(fleet_file(NAMED))
    assert what in str(refused.value)
    assert refused.value.where.startswith(str(tmp_path / place))
    assert refused.value.hint
