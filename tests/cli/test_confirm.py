"""The question before hardware flies."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cfplan.cli import confirm
from cfplan.errors import InputError
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode, encode
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.link_loss import simulate_link_loss

RADIO = "radio://0/80/2M"
REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def mission():
    time = np.arange(101) / 100.0
    zero = np.zeros_like(time)
    speed = 1.5 * np.sin(np.pi * time) ** 2
    payloads = encode(
        FullStateSetpoints(
            position=np.stack([np.cumsum(speed) / 100.0, zero, zero + 1.0], axis=1),
            velocity=np.stack([speed, zero, zero], axis=1),
            acceleration=np.zeros((101, 3)),
            quaternion=np.stack([zero, zero, zero, zero + 1.0], axis=1),
            body_rate=np.zeros((101, 3)),
        )
    )
    return Mission(payloads, encode_stops(decode(payloads), 100.0), load_limits(REPOSITORY / "safety.yaml"))


@pytest.fixture
def terminal(monkeypatch):
    """Somebody sits there, and gives this answer."""

    def answers(answer: bool) -> list[str]:
        said: list[str] = []
        monkeypatch.setattr(confirm.sys, "stdin", SimpleNamespace(isatty=lambda: True))
        monkeypatch.setattr(confirm.click, "echo", lambda text, err: said.append(text))
        monkeypatch.setattr(confirm.click, "confirm", lambda text, err: answer)
        return said

    return answers


def ask(mission, records, uri=RADIO, yes=False, speed_factor=1.0):
    lost = simulate_link_loss(mission.payloads, mission.limits)
    planned = SimpleNamespace(name="eight", duration=1.0, plan=SimpleNamespace(speed_factor=speed_factor))
    prepared = SimpleNamespace(planned=planned, mission=mission, link_loss=lost)
    return confirm.confirmed({uri: prepared}, "eight", records, yes=yes)


def record(records, folder, exit_code=0, uri=RADIO):
    (records / folder).mkdir(parents=True)
    (records / folder / "summary.json").write_text(json.dumps({"uri": uri, "outcome": {"exit_code": exit_code}}))


def test_a_virtual_vehicle_is_flown_without_a_question(mission, tmp_path):
    assert ask(mission, tmp_path, uri="sim://0")


def test_yes_answers_beforehand(mission, tmp_path):
    assert ask(mission, tmp_path, yes=True)


def test_without_a_terminal_nothing_is_flown(mission, tmp_path, monkeypatch):
    monkeypatch.setattr(confirm.sys, "stdin", SimpleNamespace(isatty=lambda: False))
    with pytest.raises(InputError, match="not a terminal") as caught:
        ask(mission, tmp_path)
    assert "--yes" in caught.value.hint


@pytest.mark.parametrize("answer", [True, False])
def test_the_answer_counts_and_time_speed_and_fence_are_shown(mission, tmp_path, terminal, answer):
    said = terminal(answer)
    assert ask(mission, tmp_path) is answer
    text = " ".join(said)
    for part in ("1.0 s", "1.5 m/s", "x -2.25 to 2.25 m", "--speed 0.3"):
        assert part in text


@pytest.mark.parametrize(
    ("folder", "exit_code", "uri", "suggested"),
    [
        ("20260101-120000-eight", 0, RADIO, False),
        ("20260101-120000-eight-2", 0, RADIO, False),
        ("20260101-120000-eight", 7, RADIO, True),
        ("20260101-120000-eight", 0, "sim://0", True),
        ("20260101-120000-figure-eight-b", 0, RADIO, True),
    ],
)
def test_a_slow_flight_is_suggested_until_one_has_ended_well_on_hardware(
    mission, tmp_path, terminal, folder, exit_code, uri, suggested
):
    record(tmp_path, folder, exit_code, uri)
    said = terminal(True)
    ask(mission, tmp_path)
    assert any("--speed" in text for text in said) is suggested


def test_a_slow_flight_is_not_suggested_to_who_flies_slowly(mission, tmp_path, terminal):
    said = terminal(True)
    ask(mission, tmp_path, speed_factor=0.3)
    assert not any("--speed" in text for text in said)


def test_a_broken_summary_is_no_flight(tmp_path):
    (tmp_path / "x-eight").mkdir()
    (tmp_path / "x-eight" / "summary.json").write_text("[1")
    assert not confirm.flown_before("eight", tmp_path)
