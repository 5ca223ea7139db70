"""Both clocks keep one contract; on the stepped one every moment is exact."""

import socket
import threading

import pytest

from cfplan.flight.clock import BEGIN, REAL_CLOCK, SteppedClock


@pytest.fixture
def stepped():
    return SteppedClock()


@pytest.fixture
def pair():
    ours, theirs = socket.socketpair()
    yield ours, theirs
    ours.close()
    theirs.close()


def test_time_stands_still_until_somebody_waits(stepped):
    assert stepped.now() == BEGIN
    stepped.sleep(0.25)
    assert stepped.now() == BEGIN + 0.25
    stepped.sleep(-1.0)
    assert stepped.now() == BEGIN + 0.25


def test_a_computer_that_stands_still_makes_the_next_sleep_longer_and_only_that(stepped):
    stepped.stall(0.5)
    assert stepped.now() == BEGIN
    stepped.sleep(0.1)
    assert stepped.now() == pytest.approx(BEGIN + 0.6)
    stepped.sleep(0.1)
    assert stepped.now() == pytest.approx(BEGIN + 0.7)


def test_what_is_due_happens_at_its_time_and_in_order(stepped):
    seen = []
    for after in (0.3, 0.1, 0.2):
        stepped.at(BEGIN + after, lambda: seen.append(stepped.now()))
    stepped.sleep(0.25)
    assert seen == [BEGIN + 0.1, BEGIN + 0.2]
    stepped.sleep(1.0)
    assert seen == [BEGIN + 0.1, BEGIN + 0.2, BEGIN + 0.3]


def test_what_an_event_raises_comes_out_of_the_wait(stepped):
    def fail():
        raise ZeroDivisionError

    stepped.at(BEGIN + 0.1, fail)
    with pytest.raises(ZeroDivisionError):
        stepped.sleep(1.0)
    assert stepped.now() == BEGIN + 0.1


def test_a_wait_ends_with_its_event_or_with_its_patience(stepped):
    event = threading.Event()
    stepped.at(BEGIN + 0.3, event.set)
    assert not stepped.wait(event, 0.2)
    assert stepped.now() == BEGIN + 0.2
    assert stepped.wait(event, 5.0)
    assert stepped.now() == BEGIN + 0.3


def test_a_world_goes_on_while_somebody_waits_and_not_beyond():
    passed = []

    def pass_time(end):
        passed.append(end)
        clock.reach(end)

    clock = SteppedClock(0.0, pass_time)
    clock.at(0.1, lambda: passed.append("event"))
    clock.sleep(0.4)
    assert passed == [0.1, "event", 0.4]


def test_a_source_that_becomes_readable_ends_a_wait(stepped, pair):
    ours, theirs = pair
    assert stepped.readable([ours], 0.5) == []
    assert stepped.now() == pytest.approx(BEGIN + 0.5)
    stepped.at(BEGIN + 0.7, lambda: theirs.send(b"x"))
    assert stepped.readable([ours], 5.0) == [ours]
    assert stepped.now() == pytest.approx(BEGIN + 0.7, abs=0.011)


def test_an_act_is_repeated_at_its_times_and_once_more_at_the_end(stepped):
    seen, ends = [], []

    def act():
        seen.append(stepped.now())
        return 0.1

    repeated = stepped.repeat(act, name="test", last=lambda: ends.append(stepped.now()))
    stepped.sleep(0.35)
    assert seen == pytest.approx([BEGIN, BEGIN + 0.1, BEGIN + 0.2, BEGIN + 0.3])
    assert repeated.stop()
    assert repeated.stop()
    stepped.sleep(1.0)
    assert len(seen) == 4
    assert ends == pytest.approx([BEGIN + 0.35])


def test_an_act_that_has_had_enough_is_not_repeated(stepped):
    delays, ends = iter([0.1, None]), []
    stepped.repeat(lambda: next(delays), name="test", last=lambda: ends.append(stepped.now()))
    stepped.sleep(5.0)
    assert ends == pytest.approx([BEGIN + 0.1])


def test_a_socket_wakes_a_repeated_act(stepped, pair):
    ours, theirs = pair
    heard = []

    def act():
        if stepped.readable([ours], 0.0):
            heard.append((stepped.now(), ours.recv(10)))
        return 100.0

    stepped.repeat(act, name="test", wake=ours)
    stepped.at(BEGIN + 1.0, lambda: theirs.send(b"x"))
    stepped.sleep(2.0)
    assert heard == [(pytest.approx(BEGIN + 1.0, abs=0.011), b"x")]


def test_the_real_clock_repeats_in_a_thread_and_ends_with_the_last_act(pair):
    ours, theirs = pair
    threads, heard, ended = [], threading.Event(), []

    def act():
        threads.append(threading.current_thread().name)
        if REAL_CLOCK.readable([ours], 0.0):
            ours.recv(10)
            heard.set()
        return 1000.0  # only the socket wakes it

    repeated = REAL_CLOCK.repeat(act, name="a name", last=lambda: ended.append(True), wake=ours)
    theirs.send(b"x")
    assert REAL_CLOCK.wait(heard, 60.0)
    assert repeated.stop(60.0)
    assert repeated.stop(60.0)
    assert ended == [True]
    assert set(threads) == {"a name"}


def test_the_real_clock_does_not_wait_for_ever_for_an_act_that_hangs():
    begun, released = threading.Event(), threading.Event()

    def act():
        begun.set()
        released.wait(60.0)
        return None

    repeated = REAL_CLOCK.repeat(act, name="hangs")
    assert begun.wait(60.0)
    assert not repeated.stop(0.01)
    released.set()
    assert repeated.stop(60.0)


def test_the_real_clock_goes_on_while_it_sleeps():
    before = REAL_CLOCK.now()
    REAL_CLOCK.sleep(0.01)
    assert REAL_CLOCK.now() >= before + 0.01
