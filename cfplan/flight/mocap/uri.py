"""Where motion capture is found, and which body in it is the vehicle: `vicon://192.168.1.2/cf1`."""

import difflib
from collections.abc import Collection
from dataclasses import dataclass
from urllib.parse import unquote, urlsplit

from cfplan.errors import InputError, LinkError

VICON_PORT = 801
# What stands before :// and the default port, None where the port cannot be chosen.
SYSTEMS: dict[str, int | None] = {
    "vicon": VICON_PORT,  # cfplan's own client of Vicon's DataStream
    "vicon-sdk": VICON_PORT,  # the same server through Vicon's own client
    "qualisys": 22222,
    "optitrack": 1510,
    "vrpn": 3883,
}
EXAMPLE = "vicon://192.168.1.2/cf1"


@dataclass(frozen=True, slots=True)
class MocapUri:
    """A motion capture system and a body in it."""

    system: str  # one of SYSTEMS
    host: str
    port: int
    subject: str  # "" where no body is named

    def __str__(self) -> str:
        return f"{self.system}://{self.address}/{self.subject}".rstrip("/")

    @property
    def address(self) -> str:
        """The host, with its port where that is not the usual one."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return host if self.port == SYSTEMS[self.system] else f"{host}:{self.port}"


def parse_uri(text: str, *, subject_needed: bool) -> MocapUri:
    """Read a URI. Raises InputError, with what is wrong about it."""
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
    except ValueError as why:
        raise InputError(f"no URI of motion capture: {why}", where=text, hint=f"write it as {EXAMPLE}") from why
    usual = SYSTEMS.get(parts.scheme)
    if usual is None:
        raise InputError(
            f"there is no motion capture of kind {parts.scheme!r}" if parts.scheme else "no URI of motion capture",
            where=text,
            hint=f"write it as {EXAMPLE}; known are {', '.join(SYSTEMS)}",
        )
    if not host or parts.query or parts.fragment or parts.username is not None:
        raise InputError(
            "no URI of motion capture" if host else "the computer is not named",
            where=text,
            hint=f"write it as {EXAMPLE}",
        )
    subject = unquote(parts.path).strip("/")
    if "/" in subject or not subject.isprintable() or not host.isprintable() or any(c.isspace() for c in host):
        raise InputError("one body behind the computer's name, and no more", where=text, hint=f"write it as {EXAMPLE}")
    if subject_needed and not subject:
        raise InputError(
            "which body is the vehicle?", where=text, hint=f"write it as {EXAMPLE}; `cfplan mocap {text}` lists them"
        )
    if port == 0:
        raise InputError("port 0 is none", where=text, hint=f"leave it out for {usual}")
    return MocapUri(parts.scheme, host, port or usual, subject)


def nothing_by_vrpn(uri: MocapUri, seconds: float) -> LinkError:
    """The error where VRPN is silent: its client does not tell a server that is not there from one without trackers."""
    whose = f" of {uri.subject!r}" if uri.subject else ""
    return LinkError(
        f"nothing{whose} comes within {seconds:.1f} s",
        where=str(uri),
        hint="is the VRPN server running there, has it a tracker of that name, and is that in view?",
    )


def no_such_body(uri: MocapUri, there: Collection[str]) -> InputError:
    """The error of a body that is not there, with what is."""
    close = difflib.get_close_matches(uri.subject, there, 1)
    meant = f"did you mean {close[0]!r}? " if close else ""
    return InputError(
        f"there is no body named {uri.subject!r}",
        where=str(uri),
        hint=f"{meant}there are: {', '.join(sorted(there))}" if there else "no body is defined or enabled there",
    )
