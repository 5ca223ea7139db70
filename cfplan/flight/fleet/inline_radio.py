"""A Crazyradio in inline mode: channel, rate and address travel with each packet, so each may go to another vehicle.

A Crazyradio 2.0 has inline mode from firmware 5.1 on. Any other Crazyradio must be set up over USB whenever the vehicle
changes. That leaves too little time for the packets of two vehicles, so it serves only one. The format is documented in
docs/development/compatible-usb-protocol.md of bitcraze/crazyradio2-firmware.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from cfplan.errors import InputError
from cfplan.flight.radio.session import PING_PERIOD
from cfplan.flight.setpoints.encoding import RATE

PACKETS_ON_BOARD = RATE + 2.0 / PING_PERIOD  # a second: poses, pings and keep-alive packets, the last two alike
PACKETS_PER_VEHICLE = RATE + PACKETS_ON_BOARD  # a second: setpoints too
USABLE_FRACTION = 0.75  # of a dongle's capacity; the rest is for repetitions and for packets that vehicles send
_INLINE_SINCE = 0x0501  # firmware version of a Crazyradio 2.0, as in its USB descriptor
_SERIAL_DIGITS = 10  # of the serial number of a dongle, whose place in the list has fewer
_HIGHEST_CHANNEL, _SLOWEST_RATE = 100, "250K"  # a Crazyradio 2.0 ignores higher channels, and this rate
_VENDOR_REQUEST, _SET_INLINE_MODE = 0x40, 0x23
_OUT, _IN, _MAX_ANSWER, _ANSWER_HEADER = 0x01, 0x81, 64, 2  # USB endpoints; bytes
_ACKNOWLEDGE, _ACKNOWLEDGED = 0x10, 0x01  # bits in the second byte of a header and of an answer
_TIMEOUT, _DRAIN_TIMEOUT = 100, 50  # ms; an exchange takes 1 ms, or 4 ms without an acknowledgement


@dataclass(frozen=True, slots=True)
class DongleMode:
    """How a Crazyradio switches between vehicles."""

    name: str
    capacity: float  # packets a second, to several vehicles in turn

    @property
    def usable(self) -> float:
        """Return the packets a second that all vehicles together may need."""
        return USABLE_FRACTION * self.capacity


# A packet takes 0.7 ms, and its set-up 2.5 ms; a prototype in inline mode carried 1,270 to 1,370 packets a second.
INLINE, USB_SET_UP = DongleMode("inline mode", 1300.0), DongleMode("USB set-up", 300.0)


def dongle_mode(firmware: int) -> DongleMode:
    """Return the mode of a Crazyradio from its firmware version, `bcdDevice` of its USB descriptor."""
    return INLINE if firmware >= _INLINE_SINCE else USB_SET_UP


def require_capacity(
    dongle: str, vehicles: Sequence[str], mode: DongleMode, packets: float = PACKETS_PER_VEHICLE
) -> str:
    """Return a message with the packets that the vehicles need and the dongle carries; raise InputError if too few.

    `packets` is the rate that each vehicle needs, 1/s.
    """
    need, most = packets * len(vehicles), int(mode.usable / packets)
    if need <= mode.usable:
        return f"{len(vehicles)} vehicles need {need:.0f} packets a second, and {mode.name} carries {mode.usable:.0f}"
    cure = "plug in more dongles, and number them 0, 1, … after radio://"
    if packets > PACKETS_ON_BOARD and PACKETS_ON_BOARD * len(vehicles) <= mode.usable:
        cure += "; or fly with --on-board, which streams only poses"
    if mode is USB_SET_UP:
        cure += "; or use a Crazyradio 2.0 with firmware 5.1 or newer, which has inline mode"
    raise InputError(
        f"{' and '.join(vehicles)} need {need:.0f} packets a second of dongle {dongle}, which carries "
        f"{mode.usable:.0f} with {mode.name}, enough for {most} vehicle{'s' if most != 1 else ''}",
        where=f"radio://{dongle}",
        hint=cure,
    )


def require_inline_settings(uri: str) -> None:
    """Raise InputError if a valid radio URI has a serial number, or a channel or rate that inline mode lacks."""
    dongle, channel, rate, *_ = [*uri.removeprefix("radio://").partition("?")[0].split("/"), "", ""]
    if not dongle.isdecimal() or len(dongle) >= _SERIAL_DIGITS:
        raise InputError(f"the shared dongle {dongle} is named by its serial number", where=uri,
                         hint="name a shared dongle by its number, as in radio://0")  # fmt: skip
    if int(channel) > _HIGHEST_CHANNEL or rate == _SLOWEST_RATE:
        raise InputError(
            f"a shared dongle does not transmit on channel {channel} at {rate or '2M'}",
            where=uri,
            hint=f"choose a channel up to {_HIGHEST_CHANNEL}, and the rate 1M or 2M",
        )


@dataclass(frozen=True, slots=True)
class RadioAddress:
    """The channel, rate and address of a vehicle's radio."""

    channel: int
    rate: int  # 1 for 1 Mbit/s, 2 for 2 Mbit/s
    address: tuple[int, ...]  # 5 bytes


class InlineRadio:
    """A Crazyradio 2.0 in inline mode."""

    def __init__(self, radio: Any):
        """Switch a `cflib.drivers.crazyradio.Crazyradio` to inline mode. Raises the errors of pyusb."""
        self._radio, self._usb = radio, radio.handle
        self._usb.ctrl_transfer(_VENDOR_REQUEST, _SET_INLINE_MODE, wValue=1, wIndex=0, timeout=1000, data_or_wLength=())

    def exchange(self, to: RadioAddress, frame: bytes) -> bytes | None:
        """Transmit a frame; return the content of the acknowledgement, or None if there is none.

        Raises OSError, also as usb.core.USBError. Late answers are discarded first: they have no address, and would be
        taken for the answer to the next frame.
        """
        header = bytes((8 + len(frame), _ACKNOWLEDGE | to.rate, to.channel, *to.address))
        try:
            self._usb.write(_OUT, header + frame, _TIMEOUT)
            answer = bytes(self._usb.read(_IN, _MAX_ANSWER, _TIMEOUT))
            if len(answer) < _ANSWER_HEADER:
                raise OSError(f"an answer of {len(answer)} bytes")
        except OSError:
            with suppress(OSError):
                while True:
                    self._usb.read(_IN, _MAX_ANSWER, _DRAIN_TIMEOUT)
            raise
        return answer[_ANSWER_HEADER : answer[0]] if answer[1] & _ACKNOWLEDGED else None

    def close(self) -> None:
        self._radio.close()


def open_inline_radio(dongle: str) -> InlineRadio:
    """Open a Crazyradio by its number. Raises the errors of cflib and pyusb."""
    from cflib.drivers.crazyradio import Crazyradio

    return InlineRadio(Crazyradio(devid=int(dongle)))
