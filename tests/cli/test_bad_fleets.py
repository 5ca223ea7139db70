"""Fleets that must not fly: each mistake is refused in words, before anything is planned or armed."""

from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from cfplan.errors import LinkError
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.simulation.virtual_vicon.vicon import serve

pytestmark = pytest.mark.integration

AT_ORIGIN = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
MOCAP = ["--mocap", "vicon://10.0.0.1"]
SEEN = ["--mocap", "SERVED"]  # a system that sees the bodies a and gate


def radio(dongle, address):
    return f"uri: 'radio://{dongle}/80/2M/E7E7E7E7{address}'"


@pytest.fixture
def fly(cfplan, safety_file, tmp_path, monkeypatch):
    """Fly two vehicles a metre apart, with these keys each, where no dongle is plugged in; how the command ended."""
    monkeypatch.setattr("cfplan.flight.radio.crazyradio.find_radios", lambda kind=None: [])
    monkeypatch.setattr("cfplan.steering.connected_fleet.plan_fleet", lambda *_: pytest.fail("it was planned"))
    (tmp_path / "line.yaml").write_text("waypoints: [[-0.6, 0, 1], [0.6, 0, 1]]\n")

    def run(a, b, words, *others):
        keys = {"a": a, "b": f"place: {{y: 1}}, {b}"}
        keys |= {f"c{n}": f"place: {{y: {n + 2}}}, {other}" for n, other in enumerate(others)}
        lines = [f"  {name}: {{path: line.yaml, {more}}}\n".replace(", }", "}") for name, more in keys.items()]
        (tmp_path / "fleet.yaml").write_text("vehicles:\n" + "".join(lines))
        with serve(ViconSettings(subject="a", others=(("gate", (3.0, 0.0, 1.0)),)), lambda _: AT_ORIGIN) as vicon:
            served = vicon.uri.rpartition("/")[0]
            words = [served if word == "SERVED" else word for word in words]
            records = tmp_path / "records"
            ended = cfplan(
                "fly", tmp_path / "fleet.yaml", "--safety", safety_file(), "--records", records, "--yes", *words
            )
        assert not records.exists()
        return ended

    return run


@pytest.mark.parametrize(
    ("a", "b", "words", "code", "what"),
    [
        ("uri: 'sim://1'", "", [], 2, "a and b have the same address"),
        ("uri: 'sim://01'", "uri: 'sim://1'", [], 2, "a and b have the same address"),
        (radio(0, "0a"), radio(1, "0A"), MOCAP, 2, "a and b have the same address"),
        (radio(0, "E7"), "uri: 'radio://1/80'", MOCAP, 2, "a and b have the same address"),
        (radio("0?safelink=0", "01"), radio(1, "01"), MOCAP, 2, "a and b have the same address"),
        ("body: b", "", [], 2, "a and b have the same body"),
        ("body: one", "body: one", [], 2, "a and b have the same body"),
        ("place: {y: 0.8}", "", [], 2, "start 0.20 m from each other"),
        (radio(0, "01"), "", [], 2, "b is a virtual vehicle, and a is not"),
        (radio(0, "01"), radio(1, "02"), [], 2, "need a source of poses"),
        (radio(0, "01"), "uri: 'radio://0/110/2M/E7E7E7E702'", MOCAP, 2, "does not transmit on channel 110"),
        (radio(0, "01"), "uri: 'radio://0/80/250K/E7E7E7E702'", MOCAP, 2, "does not transmit on channel 80 at 250K"),
        (radio("E7E7E7E7E7", "01"), radio("E7E7E7E7E7", "02"), MOCAP, 2, "named by its serial number"),
        (radio("e7aabbccdd", "01"), radio("E7AABBCCDD", "02"), MOCAP, 2, "named by its serial number"),
        (radio("1234567890", "01"), radio("1234567890", "02"), MOCAP, 2, "named by its serial number"),
        ("uri: 'radio://0/80/2M/1'", radio(1, "01"), MOCAP, 2, "not an address"),
        ("uri: 'radio://0/200'", radio(1, "01"), MOCAP, 2, "not a channel"),
        ("uri: here", radio(1, "01"), MOCAP, 2, "not the URI of a vehicle"),
        (radio(0, "01"), radio(1, "02"), ["--mocap", "vicon://10.0.0.1/a"], 2, "cannot be that of every"),
        (radio(0, "01"), radio(1, "02"), ["--mocap", "video://10.0.0.1"], 2, "unknown motion capture"),
        ("", "", MOCAP, 2, "have a virtual Vicon"),
        ("body: 'a#1'", "", [], 2, "the body of a, 'a#1', has # in its name"),
        (radio(0, "01"), radio(1, "02"), SEEN, 8, "no Crazyradio is plugged in"),
        ("uri: 'udp://127.0.0.1:19850'", "uri: 'udp://127.0.0.1:19851'", SEEN, 2, "no body named 'b'"),
    ],
)
def test_a_mistake_is_refused_before_anything_is_planned(fly, a, b, words, code, what):
    ended = fly(a, b, words)
    assert ended.code == code
    assert what in " ".join(ended.err.split())
    assert "hint" in ended.err


def test_a_dozen_vehicles_on_one_dongle_are_too_many(fly):
    ended = fly(radio(0, "01"), radio(0, "02"), MOCAP, *(radio(0, f"{n:02}") for n in range(3, 13)))
    assert ended.code == 2
    assert "2 to 6 vehicles, not 12" in ended.err


def test_a_dongle_that_five_vehicles_share_is_refused_with_need_capacity_and_cure(fly):
    ended = fly(radio(0, "01"), radio(0, "02"), MOCAP, *(radio(0, f"{n:02}") for n in range(3, 6)))
    assert ended.code == 2
    for part in ("a and b", "need 1100 packets a second of dongle 0", "carries 975", "more dongles"):
        assert part in " ".join(ended.err.split())


@pytest.mark.parametrize(("firmware", "code"), [(0x0053, 2), (0x0500, 2), (0x0501, 8)])
def test_a_crazyradio_without_inline_mode_serves_one_vehicle(fly, monkeypatch, firmware, code):
    radios = [SimpleNamespace(bcdDevice=firmware)]
    monkeypatch.setattr("cfplan.steering.fleet_addresses.find_radios", lambda: radios)
    monkeypatch.setattr("cfplan.steering.fleet_addresses.look_at_hardware", lambda *_: None)
    monkeypatch.setattr("cfplan.steering.connected_fleet.plan_fleet", Mock(side_effect=LinkError("it would fly")))
    ended = fly(radio(0, "01"), radio(0, "02"), MOCAP)
    assert ended.code == code
    parts = ("need 440", "carries 225", "firmware 5.1") if code == 2 else ("it would fly",)
    for part in parts:
        assert part in " ".join(ended.err.split())


def test_a_path_outside_the_room_is_refused_with_the_name_of_its_vehicle(cfplan, safety_file, tmp_path):
    (tmp_path / "line.yaml").write_text("waypoints: [[-0.6, 0, 1], [0.6, 0, 1]]\nshape: min-snap\n")
    fleet = tmp_path / "fleet.yaml"
    fleet.write_text("vehicles:\n  a: {path: line.yaml, place: {x: 30}}\n  b: {path: line.yaml}\n")
    ended = cfplan("plan", fleet, "--safety", safety_file())
    assert ended.code == 3
    assert "a: " in ended.err
    assert "hint" in ended.err
