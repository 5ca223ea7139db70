"""A vehicle that cannot be reached is an error with a hint, soon."""

import threading

import pytest
from cflib import crtp
from cflib.crtp.crtpdriver import CRTPDriver
from cflib.crtp.exceptions import WrongUriType
from cflib.crtp.radiodriver import RadioDriver
from cflib.crtp.udpdriver import UdpDriver

from cfplan.errors import LinkError
from cfplan.flight.clock import SteppedClock
from cfplan.flight.radio.connection import FIRST_ANSWER_TIMEOUT, connect
from cfplan.flight.radio.radio_lock import lock_radio


class SilentDriver(CRTPDriver):
    """Connects, and then nothing ever comes."""

    needs_resending = False

    def connect(self, uri, statistics, error):
        if not uri.startswith("silent://"):
            raise WrongUriType("not mine")

    def send_packet(self, packet):
        pass

    def receive_packet(self, wait=0):
        threading.Event().wait(max(wait, 0.0))

    def close(self):
        pass


class BrokenDriver(SilentDriver):
    """Cannot even open."""

    def connect(self, uri, statistics, error):
        if not uri.startswith("broken://"):
            raise WrongUriType("not mine")
        raise OSError("the wire is cut")


@pytest.mark.parametrize(
    ("reason", "hint"),
    [
        ("[Errno 13] Access denied (insufficient permissions)", "udev"),
        ("[Errno 16] Resource busy", "another program"),
    ],
)
def test_a_radio_that_cannot_be_opened_says_what_to_do(reason, hint):
    class Refused(SilentDriver):
        def connect(self, uri, statistics, error):
            if not uri.startswith("refused://"):
                raise WrongUriType("not mine")
            raise OSError(reason)

    with pytest.raises(LinkError) as caught:
        connect("refused://0", lambda message: None, [Refused])
    assert hint in caught.value.hint
    assert "\n" not in str(caught.value)


def test_cflibs_own_drivers_are_there_also_where_another_was_registered_before(monkeypatch):
    monkeypatch.setattr(crtp, "CLASSES", [SilentDriver])
    with pytest.raises(LinkError):
        connect("broken://0", lambda message: None, [BrokenDriver])
    assert {RadioDriver, UdpDriver, SilentDriver, BrokenDriver} <= set(crtp.CLASSES)
    assert len(crtp.CLASSES) == len(set(crtp.CLASSES))


def test_a_second_pilot_on_the_same_radio_is_refused_and_the_first_keeps_it(monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    first = lock_radio("radio://0/80/2M/E7E7E7E7E7")
    assert first is not None
    for again in ("radio://0/80/2M/E7E7E7E7E7", "radio://0/90/1M/E7E7E7E701"):
        with pytest.raises(LinkError, match="another cfplan") as caught:
            connect(again, lambda message: None)
        assert caught.value.hint
    other = lock_radio("radio://1/80/2M/E7E7E7E7E7")
    assert other is not None
    other.close()
    first.close()
    freed = lock_radio("radio://0/80/2M/E7E7E7E7E7")
    assert freed is not None
    freed.close()


def test_what_nothing_else_can_reach_needs_no_lock():
    assert lock_radio("sim://0") is None


@pytest.mark.parametrize(
    ("uri", "what"),
    [
        ("broken://0", "the wire is cut"),
        ("nonsense", "No driver found"),
        ("radio://0/80/2M/E7E7E7E7E7", "cannot connect"),
        ("udp://127.0.0.1:9", "cannot connect|nothing answers"),
    ],
)
def test_an_unreachable_uri_is_refused(uri, what):
    with pytest.raises(LinkError, match=what) as caught:
        connect(uri, lambda message: None, [SilentDriver, BrokenDriver])
    assert caught.value.where == uri
    assert caught.value.hint
    assert "\n" not in str(caught.value)


def test_where_nothing_answers_that_is_known_after_four_seconds():
    clock = SteppedClock()
    began = clock.now()
    with pytest.raises(LinkError, match="nothing answers") as caught:
        connect("silent://0", lambda message: None, [SilentDriver], clock=clock)
    assert clock.now() - began == pytest.approx(FIRST_ANSWER_TIMEOUT, abs=0.05)
    assert caught.value.where == "silent://0"
    assert caught.value.hint
    assert "\n" not in str(caught.value)


def test_waiting_can_be_given_up():
    def give_up():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        connect("silent://0", lambda message: None, [SilentDriver], waiting=give_up)
