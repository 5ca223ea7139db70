"""The time left of a run, from a clock that the test sets."""

import pytest

from cfplan.studies.time_left import TimeLeft, duration_text


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def test_the_rest_takes_as_long_a_step_as_those_that_are_done(clock):
    left = TimeLeft(clock)
    left.step(0, 10)
    assert left.seconds is None
    clock.now += 30.0
    left.step(3, 10)
    assert left.seconds == pytest.approx(70.0)
    clock.now += 4.0
    assert left.seconds == pytest.approx(66.0)
    clock.now += 1000.0
    assert left.seconds == 0.0


def test_what_a_run_before_has_done_does_not_count(clock):
    left = TimeLeft(clock)
    left.step(90, 100)
    clock.now += 20.0
    left.step(91, 100)
    assert left.seconds == pytest.approx(180.0)


@pytest.mark.parametrize(("done", "total"), [(0, 50), (0, 10)])
def test_another_phase_has_a_pace_of_its_own(clock, done, total):
    left = TimeLeft(clock)
    left.step(0, 10)
    clock.now += 500.0
    left.step(10, 10)  # training
    left.step(done, total)
    assert left.seconds is None
    clock.now += 2.0
    left.step(done + 1, total)
    assert left.seconds == pytest.approx(2.0 * (total - done - 1))


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (99.0, "99 s"), (100.0, "2 min"), (5700.0, "95 min"), (12_000.0, "3 h 20 min")]
)
def test_durations_as_people_say_them(seconds, text):
    assert duration_text(seconds) == text
