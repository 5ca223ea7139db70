"""A motion capture URI: the system, its address, and which body is the vehicle (`vicon://192.168.1.2/cf1`)."""

import difflib
from collections.abc import Collection
from dataclasses import dataclass
from urllib.parse import unquote, urlsplit

from cfplan.errors import InputError, LinkError

VICON_PORT = 801
# Scheme and default port; 0 if the vendor's client takes none.
SYSTEMS = {
    "vicon": VICON_PORT,  # cfplan's own client of Vicon's DataStream
    "vicon-sdk": VICON_PORT,  # the same server through Vicon's own client
    "qualisys": 22222,
    "optitrack": 1510,
    "optitrack-sdk": 1510,
    "nokov": 0,
    "motionanalysis": 0,
    "vrpn": 3883,
}
EXAMPLE = "vicon://192.168.1.2/cf1"
_LISTED, _LONGEST_NAME = 12, 40  # most names in an error message, and most characters of each


@dataclass(frozen=True, slots=True)
class MocapUri:
    """A motion capture system and a body in it."""

    system: str  # one of SYSTEMS
    host: str
    port: int  # 0 if the vendor's client takes none
    subject: str  # "" if no body is named

    def __str__(self) -> str:
        return f"{self.system}://{self.address}/{self.subject}".rstrip("/")

    @property
    def address(self) -> str:
        """Return the host, with its port unless that is the default."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return host if self.port == SYSTEMS[self.system] else f"{host}:{self.port}"


def parse_uri(text: str, *, subject_needed: bool) -> MocapUri:
    """Return the parts of a URI. Raises InputError, saying what is wrong."""
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
    except ValueError as why:
        raise InputError(
            f"not the URI of a motion capture system: {why}", where=text, hint=f"write it as {EXAMPLE}"
        ) from why
    usual = SYSTEMS.get(parts.scheme)
    if usual is None:
        raise InputError(
            f"unknown motion capture system {parts.scheme!r}"
            if parts.scheme
            else "not the URI of a motion capture system",
            where=text,
            hint=f"write it as {EXAMPLE}; systems: {', '.join(SYSTEMS)}",
        )
    if not host or parts.query or parts.fragment or parts.username is not None:
        raise InputError(
            "not the URI of a motion capture system" if host else "the computer is not named",
            where=text,
            hint=f"write it as {EXAMPLE}",
        )
    subject = unquote(parts.path).strip("/")
    if "/" in subject or not subject.isprintable() or not host.isprintable() or any(c.isspace() for c in host):
        raise InputError(
            "one body must follow the computer's name, and nothing else", where=text, hint=f"write it as {EXAMPLE}"
        )
    if subject_needed and not subject:
        raise InputError(
            "which body is the vehicle?", where=text, hint=f"write it as {EXAMPLE}; `cfplan mocap {text}` lists them"
        )
    if port == 0 or (port and not usual):
        message = "there is no port 0" if port == 0 else f"the client of {parts.scheme} takes no port"
        raise InputError(message, where=text, hint=f"leave it out for {usual}" if usual else "leave it out")
    return MocapUri(parts.scheme, host, port or usual, subject)


def nothing_by_vrpn(uri: MocapUri, seconds: float) -> LinkError:
    """Return the error of a silent VRPN: its client cannot distinguish a missing server from one without trackers."""
    whose = f" of {uri.subject!r}" if uri.subject else ""
    return LinkError(
        f"nothing{whose} came within {seconds:.1f} s",
        where=str(uri),
        hint="is the VRPN server running there, does it have a tracker of that name, and is the tracker in view?",
    )


def no_such_body(uri: MocapUri, there: Collection[str]) -> InputError:
    """Return the error of an unknown body, listing the known ones."""
    close = difflib.get_close_matches(uri.subject, there, 1)
    meant = f"did you mean {close[0]!r}? " if close else ""
    return InputError(
        f"there is no body named {uri.subject!r}",
        where=str(uri),
        hint=f"{meant}there are: {_listed(there)}" if there else "no body is defined or enabled there",
    )


def _listed(names: Collection[str]) -> str:
    shown = [name[:_LONGEST_NAME] for name in sorted(names)[:_LISTED]]
    return ", ".join(shown) + (f" and {len(names) - _LISTED} more" if len(names) > _LISTED else "")
