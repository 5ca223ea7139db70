"""In the air the terminal says which keys end the flight, and shows only what was measured."""

import re

import pytest

from cfplan.cli import flight_progress
from cfplan.cli.flight_progress import KEYS, SIGNALS_ALONE, FlightProgress
from cfplan.cli.output import Steps
from cfplan.flight.clock import SteppedClock
from cfplan.flight.telemetry import Phase, PhaseEntered, PoseReceived, SetpointSent

LEVEL = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def shown(capsys, monkeypatch):
    """Call it with whether standard error and standard input are terminals: what a flight's phases show."""

    def show(*, screen: bool, keyboard: bool) -> dict[Phase, str]:
        monkeypatch.setattr(flight_progress.sys.stdin, "isatty", lambda: keyboard, raising=False)
        monkeypatch.setenv("COLUMNS", "80")
        monkeypatch.delenv("NO_COLOR", raising=False)
        monkeypatch.setenv("TERM", "xterm")
        if screen:
            monkeypatch.setenv("FORCE_COLOR", "1")
        else:
            monkeypatch.delenv("FORCE_COLOR", raising=False)
        clock, texts = SteppedClock(), {}
        for phase in Phase:
            with FlightProgress(duration=4.0, steps=Steps(as_json=False), clock=clock) as progress:
                progress.show(PhaseEntered(clock.now(), phase))
                clock.sleep(1.0)
                pose = PoseReceived(clock.now(), clock.now(), (-0.001, 1.0, 0.5), (0.0, 0.0, 0.0, 1.0))
                progress.show(pose)
            # at its end the bar is drawn once more
            texts[phase] = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", capsys.readouterr().err)
        return texts

    return show


def test_the_keys_stand_under_the_bar_in_every_phase(shown):
    for phase, text in shown(screen=True, keyboard=True).items():
        assert KEYS in text, phase
        assert max(map(len, text.splitlines())) <= 80


def test_without_a_bar_the_keys_are_said_before_take_off(shown):
    texts = shown(screen=False, keyboard=True)
    assert KEYS in texts[Phase.ARM]
    assert KEYS not in texts[Phase.STREAM]


def test_without_a_keyboard_only_what_works_is_said(shown):
    assert SIGNALS_ALONE in shown(screen=False, keyboard=False)[Phase.ARM]


def test_a_battery_that_was_not_heard_is_not_shown_and_zero_has_no_sign(shown):
    text = shown(screen=True, keyboard=True)[Phase.TAKE_OFF]
    assert " V" not in text
    assert "(0.00, 1.00, 0.50) m" in text


def test_without_a_bar_a_long_phase_says_every_few_seconds_how_far_it_is(capsys, monkeypatch):
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    clock = SteppedClock()
    with FlightProgress(duration=10.0, steps=Steps(as_json=False), clock=clock) as progress:
        for phase, seconds in ((Phase.ARM, 1), (Phase.GO_TO_START, 9), (Phase.STREAM, 10)):
            progress.show(PhaseEntered(clock.now(), phase))
            for index in range(10 * seconds):
                if phase is Phase.STREAM:
                    progress.show(
                        SetpointSent(clock.now(), clock.now(), index, *[(0.0, 0.0, 0.0)] * 3, LEVEL, (0.0, 0.0, 0.0))
                    )
                progress.show(PoseReceived(clock.now(), clock.now(), (0.1, 1.0, 0.5), LEVEL))
                clock.sleep(0.1)
    notes = [line.strip() for line in capsys.readouterr().err.splitlines() if "…" in line]
    place = "(0.10, 1.00, 0.50) m"
    assert notes == [
        f"… go to start, 4 s, {place}", f"… go to start, 8 s, {place}",
        f"… stream, 4.0 of 10.0 s, {place}", f"… stream, 8.0 of 10.0 s, {place}",
    ]  # fmt: skip
