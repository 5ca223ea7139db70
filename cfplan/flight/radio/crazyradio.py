"""Check of the Crazyradio on USB: is it plugged in, permitted and free?"""

from typing import Any

from cfplan.errors import LinkError

CRAZYRADIO = (0x1915, 0x7777)  # vendor and product; also of a Crazyradio 2.0 that emulates a Crazyradio PA
OTHER_FIRMWARE = (0x35F0, 0xBAD2)  # Crazyradio 2.0 with its own firmware
_DENIED, _BUSY = 13, 16

# For Crazyradio, Crazyradio 2.0 and the Crazyflie over USB, as documented by Bitcraze.
UDEV_RULES = (
    """printf 'SUBSYSTEM=="usb", ATTRS{idVendor}=="%s", MODE="0664", GROUP="plugdev"\\n' 1915 35f0 0483 """
    "| sudo tee /etc/udev/rules.d/99-bitcraze.rules && sudo udevadm control --reload-rules"
)


def find_radios(kind: tuple[int, int] = CRAZYRADIO) -> list[Any]:
    """Return the radios that are plugged in, by the library that cflib uses. Raises LinkError if USB cannot be read."""
    import libusb_package
    import usb.core

    try:
        found = usb.core.find(
            find_all=True, idVendor=kind[0], idProduct=kind[1], backend=libusb_package.get_libusb1_backend()
        )
        return list(found or ())
    except (usb.core.USBError, usb.core.NoBackendError) as error:
        raise LinkError(f"USB cannot be read: {error}", hint="install libusb") from error


def check_radio(uri: str) -> None:
    """Raise LinkError with a hint if the radio of a URI is absent, not permitted or used by another program.

    Claims the radio for a moment, as cflib will. A URI without the radio's number is left to cflib.
    """
    number = uri.removeprefix("radio://").partition("/")[0]
    if not uri.startswith("radio://") or not number.isdecimal() or len(number) >= 10:
        return
    radios = find_radios()
    if len(radios) <= int(number):
        other = find_radios(OTHER_FIRMWARE) if not radios else []
        if other:
            raise LinkError(
                "cflib does not support the firmware of this Crazyradio 2.0",
                where=uri,
                hint="flash the firmware that emulates a Crazyradio PA",
            )
        if radios:
            raise LinkError(
                f"there is no radio {number}",
                where=uri,
                hint=f"radios are numbered from 0, and {len(radios)} are plugged in",
            )
        raise LinkError("no Crazyradio is plugged in", where=uri, hint="plug one in; `lsusb` lists it as 1915:7777")
    _take(radios[int(number)], uri)


def _take(radio: Any, uri: str) -> None:
    import usb.core
    import usb.util

    try:
        usb.util.claim_interface(radio, 0)
        usb.util.release_interface(radio, 0)
    except usb.core.USBError as error:
        hint = usb_hint(error.errno, str(error)) or "unplug the radio and plug it in again"
        raise LinkError(f"the radio cannot be opened: {error.strerror or error}", where=uri, hint=hint) from error
    finally:
        usb.util.dispose_resources(radio)


def usb_hint(number: int | None, text: str) -> str:
    """Return a hint for a USB error; "" if there is none."""
    text = text.lower()
    if number == _DENIED or "denied" in text or "permission" in text:
        return f"allow it once: {UDEV_RULES}; then unplug and plug in"
    if number == _BUSY or "busy" in text:
        return "another program has the radio: close cfclient and others"
    return ""
