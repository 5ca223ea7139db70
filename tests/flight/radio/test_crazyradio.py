"""A Crazyradio at the boundary of USB: what cflib and pyusb make of one that is absent, forbidden or another's."""

import errno
from types import SimpleNamespace

import pytest
import usb.backend
import usb.core

from cfplan.errors import LinkError
from cfplan.flight.radio.connection import connect
from cfplan.flight.radio.crazyradio import CRAZYRADIO, OTHER_FIRMWARE, check_radio

URI = "radio://0/80/2M/E7E7E7E7E7"


class Bus(usb.backend.IBackend):
    """What libusb shows: radios, and what it answers to whoever opens or takes one."""

    def __init__(self, *kinds: tuple[int, int], opening: int = 0, taking: int = 0):
        self.kinds, self.opening, self.taking = kinds, opening, taking
        self.done: list[str] = []

    def enumerate_devices(self):
        return list(self.kinds)

    def get_device_descriptor(self, device):
        vendor, product = device
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=vendor, idProduct=product, bcdDevice=0x0053, iManufacturer=0, iProduct=0,
            iSerialNumber=0, bNumConfigurations=1, bus=1, address=4, port_number=1, port_numbers=(1,), speed=2,
        )  # fmt: skip

    def get_configuration_descriptor(self, device, number):
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=9, bNumInterfaces=0, bConfigurationValue=1, iConfiguration=0,
            bmAttributes=0x80, bMaxPower=50, extra_descriptors=b"",
        )  # fmt: skip

    def open_device(self, device):
        self._answer("open", self.opening)
        return device

    def close_device(self, handle):
        self.done.append("close")

    def set_configuration(self, handle, value):
        self._answer("configure", self.taking)

    def claim_interface(self, handle, number):
        self._answer("take", self.taking)

    def release_interface(self, handle, number):
        self.done.append("release")

    def _answer(self, what: str, number: int) -> None:
        self.done.append(what)
        if number:
            texts = {errno.EACCES: "Access denied (insufficient permissions)", errno.EBUSY: "Resource busy"}
            raise usb.core.USBError(texts.get(number, "Input/Output Error"), None, number)


@pytest.fixture
def plugged_in(monkeypatch):
    """Put a bus in libusb's place."""

    def put(*kinds, **answers) -> Bus:
        bus = Bus(*kinds, **answers)
        monkeypatch.setattr("libusb_package.get_libusb1_backend", lambda: bus)
        return bus

    return put


def refused(function) -> LinkError:
    with pytest.raises(LinkError) as caught:
        function()
    assert caught.value.where == URI
    assert "\n" not in str(caught.value)
    return caught.value


def connecting() -> None:
    connect(URI, lambda message: None)


@pytest.mark.parametrize("way", [lambda: check_radio(URI), connecting], ids=["beforehand", "connecting"])
class TestEitherWay:
    def test_an_absent_radio_is_to_be_plugged_in(self, plugged_in, way):
        plugged_in()
        assert "plug" in refused(way).hint

    def test_a_forbidden_radio_comes_with_the_rule_to_paste(self, plugged_in, way):
        plugged_in(CRAZYRADIO, opening=errno.EACCES, taking=errno.EACCES)
        error = refused(way)
        assert "Access denied" in error.what
        for part in ("/etc/udev/rules.d/99-bitcraze.rules", "1915 35f0 0483", "udevadm control --reload-rules"):
            assert part in error.hint

    def test_a_busy_radio_is_another_programs(self, plugged_in, way):
        plugged_in(CRAZYRADIO, taking=errno.EBUSY)
        error = refused(way)
        assert "busy" in error.what
        assert "another program" in error.hint


def test_a_radio_that_is_free_is_let_go_again(plugged_in):
    bus = plugged_in(CRAZYRADIO)
    check_radio(URI)
    assert bus.done == ["open", "take", "release", "close"]


def test_the_second_of_one_radio_is_named(plugged_in):
    plugged_in(CRAZYRADIO)
    with pytest.raises(LinkError, match="no radio 1") as caught:
        check_radio("radio://1/80/2M")
    assert "1 are plugged in" in caught.value.hint


def test_a_crazyradio_with_other_firmware_is_told_from_none(plugged_in):
    plugged_in(OTHER_FIRMWARE)
    assert "emulates" in refused(lambda: check_radio(URI)).hint


def test_usb_that_cannot_be_read_is_an_error_too(monkeypatch):
    monkeypatch.setattr("libusb_package.get_libusb1_backend", lambda: None)
    monkeypatch.setattr("usb.backend.libusb1.get_backend", lambda: None)
    monkeypatch.setattr("usb.backend.openusb.get_backend", lambda: None)
    monkeypatch.setattr("usb.backend.libusb0.get_backend", lambda: None)
    with pytest.raises(LinkError, match="USB cannot be read"):
        check_radio(URI)


@pytest.mark.parametrize("uri", ["sim://0", "udp://127.0.0.1:19850", "radio://E7E7E7E7E7E7/80/2M"])
def test_what_has_no_numbered_radio_is_not_looked_for(plugged_in, uri):
    bus = plugged_in()
    check_radio(uri)
    assert not bus.done
