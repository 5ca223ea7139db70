"""What a vehicle's URI must look like: cflib takes some that mean something else than they say."""

import re

from cfplan.errors import InputError

EXAMPLES = "radio://0/80/2M/E7E7E7E7E7, usb://0, udp://127.0.0.1:19850 or sim://0"
_HIGHEST_CHANNEL = 125
_RATES = ("250K", "1M", "2M")
_SOCKET = re.compile(r"(?:udp|tcp)://(?:[^/\s:]+|\[[0-9A-Fa-f:]+\]):(\d+)")


def check_vehicle_uri(uri: str) -> None:
    """Raises InputError with what is wrong about it."""
    kind = uri.partition("://")[0] if "://" in uri else ""
    if kind == "radio":
        _check_radio(uri)
    elif kind in ("udp", "tcp"):
        port = _SOCKET.fullmatch(uri)
        if port is None or not 0 < int(port[1]) < 1 << 16:
            raise InputError("a computer and its port are needed", where=uri, hint=f"as {kind}://127.0.0.1:19850")
    elif kind == "usb":
        if not re.fullmatch(r"usb://\d+", uri):
            raise InputError("the number of the vehicle on a cable is needed", where=uri, hint="as usb://0")
    elif kind == "sim":
        if not re.fullmatch(r"sim://\d{1,3}", uri):
            raise InputError("no such virtual vehicle", where=uri, hint="sim://0, sim://1, …")
    else:
        raise InputError("no URI of a vehicle", where=uri, hint=f"a URI looks like {EXAMPLES}")


def _check_radio(uri: str) -> None:
    """cflib takes a rate that it does not know for 2M, and fills a short address up with zeros."""
    radio, _, rest = uri.removeprefix("radio://").partition("/")
    channel, rate, address, *more = [*rest.partition("?")[0].split("/"), "", ""]
    as_such = "as radio://0/80/2M/E7E7E7E7E7: radio, channel, rate, address"
    if not radio or any(more):
        raise InputError("no URI of a radio", where=uri, hint=as_such)
    if not channel.isdecimal() or int(channel) > _HIGHEST_CHANNEL:
        raise InputError(f"{channel or 'nothing'!r} is no channel: 0 to {_HIGHEST_CHANNEL}", where=uri, hint=as_such)
    if rate and rate not in _RATES:
        raise InputError(f"{rate!r} is no rate: {', '.join(_RATES)}", where=uri, hint=as_such)
    if address and not re.fullmatch(r"[0-9A-Fa-f]{10}", address):
        raise InputError(f"{address!r} is no address: ten hexadecimal digits", where=uri, hint=as_such)
