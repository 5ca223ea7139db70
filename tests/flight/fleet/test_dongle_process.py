"""The process of a shared dongle: pilots reach their vehicles through it, and notice if it dies or hangs."""

import os
import signal
import threading
from functools import partial

import pytest
from cflib.crtp.crtpstack import CRTPPacket
from inline_crazyradio import absent_radio, radio_of_echoing_vehicles, unmarked
from waiting import a_moment, until

from cfplan.errors import InputError, LinkError
from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.fleet.dongle_process import SharedDongles, shared_uri
from cfplan.flight.fleet.inline_radio import PACKETS_ON_BOARD, PACKETS_PER_VEHICLE, dongle_mode, require_capacity
from cfplan.flight.fleet.shared_dongle import NEVER_HEARD_AFTER
from cfplan.flight.radio.radio_lock import lock_radio
from cfplan.flight.radio.transport import start_receiver

pytestmark = pytest.mark.integration

URIS = {name: f"radio://0/80/2M/E7E7E7E70{number}" for number, name in enumerate(("left", "right"), start=1)}


@pytest.fixture(autouse=True)
def _own_locks(monkeypatch, tmp_path):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


class Pilot:
    """A pilot's link, and the reasons for which it was lost."""

    def __init__(self, dongles: SharedDongles, name: str, options: str = "", uris: dict[str, str] = URIS):
        (make,) = dongles.drivers(name)
        self.link, self.failures = make(), []
        assert until(lambda: self._connects(shared_uri(uris[name]) + options))

    def _connects(self, uri: str) -> bool:
        """Connect; return False while the process has not begun to run."""
        try:
            self.link.connect(uri, None, self.failures.append)
        except LinkError as error:
            if "does not answer" not in error.what:
                raise
            return False
        return True

    def answer_to(self, *content: int) -> bytes | None:
        """Send a packet until it comes back, and return it; None if the link is lost."""
        while not self.failures:
            self.link.send_packet(CRTPPacket(0x2E, bytearray(content)))
            packet = self.link.receive_packet(0.2)
            if packet is not None and bytes(packet.data) == bytes(content):
                return unmarked((packet.header, *packet.data))
        return None

    def loses_its_link(self) -> bool:
        return until(lambda: self.link.receive_packet(0.05) is None and self.failures)


@pytest.fixture
def dongles():
    with SharedDongles(URIS, radio_of_echoing_vehicles) as dongles:
        yield dongles


def pid(dongles) -> int:
    return dongles.processes["0"].pid


def test_each_of_two_pilots_reaches_its_own_vehicle_only(dongles):
    left, right = Pilot(dongles, "left"), Pilot(dongles, "right")
    for number in range(5):
        assert left.answer_to(1, number) == bytes((0x2E, 1, number))
        assert right.answer_to(2, number) == bytes((0x2E, 2, number))
    with pytest.raises(LinkError, match="another cfplan"):
        lock_radio("radio://0/90/2M")


def test_each_pilot_loses_its_link_at_once_when_the_process_dies(dongles):
    pilots = [Pilot(dongles, name) for name in URIS]
    os.kill(pid(dongles), signal.SIGKILL)
    for pilot in pilots:
        assert pilot.loses_its_link()
        assert pilot.failures == ["the dongle's process has ended"]
        pilot.link.send_packet(CRTPPacket(0x2E, bytearray(b"\1")))  # dropped without an error
        with pytest.raises(LinkError, match="has ended"):
            pilot.link.connect("shared://0", None, None)


def test_each_pilot_loses_its_link_when_the_process_hangs(dongles):
    pilots = [Pilot(dongles, name) for name in URIS]
    os.kill(pid(dongles), signal.SIGSTOP)
    try:
        for pilot in pilots:
            assert pilot.loses_its_link()
            assert "silent" in pilot.failures[0]
            for _ in range(10_000):  # never blocks, even when the process's socket is full
                pilot.link.send_packet(CRTPPacket(0x2E, bytearray(b"\1")))
    finally:
        os.kill(pid(dongles), signal.SIGCONT)


def test_the_process_survives_the_signals_that_end_a_session_and_pilots_go_on(dongles):
    pilot = Pilot(dongles, "left")
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        os.kill(pid(dongles), number)
    a_moment()
    assert pilot.answer_to(7) == b"\x2e\x07"


def test_the_process_ends_with_its_last_pilot(dongles):
    pilots = [Pilot(dongles, name) for name in URIS]
    pilots[0].link.close()
    assert pilots[1].answer_to(1)
    dongles.hand_over()
    assert until(lambda: not dongles.processes["0"].is_alive())
    lock_radio("radio://0/80").close()


def test_a_plain_link_after_another_hears_that_its_vehicle_acknowledged_a_packet(dongles):
    """cflib needs this to restart a vehicle; a link with safelink does not pass on empty acknowledgements."""
    pilot = Pilot(dongles, "left")
    assert pilot.answer_to(1)
    pilot.link.close()
    again = Pilot(dongles, "left", "?safelink=0&autoping=0&ackfilter=0")
    again.link.send_packet(CRTPPacket(0xFF, bytearray(b"\xfe\x02")))
    assert until(lambda: getattr(again.link.receive_packet(0.1), "header", 0) == 0xFF)


def test_the_reader_of_a_closed_link_takes_no_packet_of_the_next_link(dongles):
    first = Pilot(dongles, "left").link
    for _ in range(10):
        ended = threading.Event()
        start_receiver(first.receive_packet, lambda _: None, ended)
        a_moment(0.02)
        ended.set()
        first.close()
        (make,) = dongles.drivers("left")
        first = make()
        first.connect(shared_uri(URIS["left"]), None, None)


def test_the_loss_of_an_earlier_link_does_not_fail_the_next():
    """A reason that came after the earlier link had been closed waits in the socket."""
    uris = {"absent": "radio://0/80/2M/E7E7E7E709"}
    with SharedDongles(uris, radio_of_echoing_vehicles) as dongles:
        link = Pilot(dongles, "absent", uris=uris).link
        a_moment(NEVER_HEARD_AFTER + 0.5)
        link.close()
        assert not Pilot(dongles, "absent", uris=uris).failures


def test_a_link_whose_process_has_died_does_not_keep_its_reader_busy(dongles):
    pilot = Pilot(dongles, "left")
    os.kill(pid(dongles), signal.SIGKILL)
    assert pilot.loses_its_link()
    began = REAL_CLOCK.now()
    assert pilot.link.receive_packet(0.1) is None
    assert REAL_CLOCK.now() - began >= 0.1


def test_a_radio_that_cannot_be_opened_is_an_error_of_each_pilot():
    with SharedDongles(URIS, absent_radio) as dongles:
        for name in URIS:
            with pytest.raises(LinkError, match="Cannot find a Crazyradio"):
                Pilot(dongles, name)


@pytest.mark.parametrize(
    ("count", "packets", "firmware", "parts"),
    [
        (2, PACKETS_PER_VEHICLE, 0x0501, None),
        (4, PACKETS_PER_VEHICLE, 0x0504, None),
        (5, PACKETS_PER_VEHICLE, 0x0510, ("need 1100", "carries 975", "enough for 4 vehicles", "--on-board")),
        (2, PACKETS_PER_VEHICLE, 0x0500, ("need 440", "carries 225", "enough for 1 vehicle", "firmware 5.1")),
        (2, PACKETS_PER_VEHICLE, 0x0053, ("USB set-up",)),  # a Crazyradio PA
        (6, PACKETS_ON_BOARD, 0x0501, None),
        (2, PACKETS_ON_BOARD, 0x0053, ("need 240", "carries 225", "enough for 1 vehicle")),
    ],
)
def test_a_dongle_short_of_capacity_is_refused_with_need_and_capacity(count, packets, firmware, parts):
    names = [f"cf{number}" for number in range(count)]
    require = partial(require_capacity, "0", names, dongle_mode(firmware), packets)
    if parts is None:
        assert f"{packets * count:.0f} packets a second" in require()
        return
    with pytest.raises(InputError) as caught:
        require()
    for part in ("dongle 0", "cf0 and cf1", *parts):
        assert part in str(caught.value)
    assert caught.value.hint
