"""Check of a vehicle's URI: cflib silently misreads some wrong ones."""

import re

from cfplan.errors import InputError

EXAMPLES = "radio://0/80/2M/E7E7E7E7E7, usb://0, udp://127.0.0.1:19850 or sim://0"
_HIGHEST_CHANNEL = 125
_RATES = ("250K", "1M", "2M")
_SOCKET = re.compile(r"(?:udp|tcp)://(?:[^/\s:]+|\[[0-9A-Fa-f:]+\]):(\d+)")


def check_vehicle_uri(uri: str) -> None:
    """Raise InputError if a vehicle's URI is wrong, saying how."""
    kind = uri.partition("://")[0] if "://" in uri else ""
    if kind == "radio":
        _check_radio(uri)
    elif kind in ("udp", "tcp"):
        port = _SOCKET.fullmatch(uri)
        if port is None or not 0 < int(port[1]) < 1 << 16:
            raise InputError("host and port are needed", where=uri, hint=f"write it as {kind}://127.0.0.1:19850")
    elif kind == "usb":
        if not re.fullmatch(r"usb://\d+", uri):
            raise InputError("the number of the USB device is needed", where=uri, hint="write it as usb://0")
    elif kind == "sim":
        if not re.fullmatch(r"sim://\d{1,3}", uri):
            raise InputError("no such virtual vehicle", where=uri, hint="sim://0, sim://1, …")
    else:
        raise InputError("not the URI of a vehicle", where=uri, hint=f"a URI looks like {EXAMPLES}")


def _check_radio(uri: str) -> None:
    """Check a radio's URI: cflib takes an unknown rate for 2M, and fills a short address with zeros."""
    radio, _, rest = uri.removeprefix("radio://").partition("/")
    channel, rate, address, *more = [*rest.partition("?")[0].split("/"), "", ""]
    form = "write it as radio://0/80/2M/E7E7E7E7E7: radio, channel, rate, address"
    if not radio or any(more):
        raise InputError("not the URI of a radio", where=uri, hint=form)
    if not channel.isdecimal() or int(channel) > _HIGHEST_CHANNEL:
        raise InputError(f"{channel or 'nothing'!r} is not a channel: 0 to {_HIGHEST_CHANNEL}", where=uri, hint=form)
    if rate and rate not in _RATES:
        raise InputError(f"{rate!r} is not a rate: {', '.join(_RATES)}", where=uri, hint=form)
    if address and not re.fullmatch(r"[0-9A-Fa-f]{10}", address):
        raise InputError(f"{address!r} is not an address: ten hexadecimal digits", where=uri, hint=form)
