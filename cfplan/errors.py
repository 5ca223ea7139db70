"""Errors that a user can cause, and the exit codes that they end in."""

from enum import IntEnum
from unicodedata import category

_LONGEST = 600  # characters of a message, and of a hint


def printable(text: str) -> str:
    """Return one line without control characters, which names from files and networks may hold: they are escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or category(c) == "Zs" else c.encode("unicode_escape").decode() for c in text)


def _shortened(text: str) -> str:
    """Return a text that a terminal shows whole, where a file put very much into a message."""
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def _without_middle(place: str) -> str:
    """Return a place that a terminal shows whole, with its begin and its line."""
    return place if len(place) <= _LONGEST else f"{place[: _LONGEST // 2]}…{place[-_LONGEST // 2 :]}"


class ExitCode(IntEnum):
    """How a command ends."""

    OK = 0
    USAGE = 2
    INFEASIBLE = 3
    NOT_CERTIFIED = 4  # certificate or dry run failed
    PREFLIGHT = 5
    ENDED_BY_OPERATOR = 6
    ENDED_BY_SAFETY = 7
    LINK_LOST = 8


class CfplanError(Exception):
    """What went wrong, where, and what to do about it.

    `where` is a place that the user can go to: `file:line:column`, a waypoint, a key, a URI.
    The text is one line, so that it can stand alone in a terminal or a log.
    """

    exit_code = ExitCode.USAGE

    def __init__(self, what: str, *, where: str = "", hint: str = ""):
        self.what, self.where, self.hint = what, where, hint
        super().__init__(what)

    def __str__(self) -> str:
        place = f"{_without_middle(self.where)}: " if self.where else ""
        remedy = f" (hint: {_shortened(self.hint)})" if self.hint else ""
        return printable(f"{place}{_shortened(self.what)}{remedy}")

    def __reduce__(self):  # keyword-only arguments must survive the way between processes
        return _rebuild, (type(self), self.what, self.where, self.hint)


def _rebuild(kind: type[CfplanError], what: str, where: str, hint: str) -> CfplanError:
    return kind(what, where=where, hint=hint)


class InputError(CfplanError):
    """A file or an argument is wrong."""

    exit_code = ExitCode.USAGE


class InfeasibleError(CfplanError):
    """No flight can meet the limits."""

    exit_code = ExitCode.INFEASIBLE


class NotCertifiedError(CfplanError):
    """The certificate or the dry run failed."""

    exit_code = ExitCode.NOT_CERTIFIED


class PreflightError(CfplanError):
    """A preflight check failed; nothing was armed."""

    exit_code = ExitCode.PREFLIGHT


class LinkError(CfplanError):
    """The vehicle cannot be reached, or was lost."""

    exit_code = ExitCode.LINK_LOST


class RequestRefusedError(CfplanError):
    """A request to change the path in the air was refused, or came too late; the vehicle flies on as before."""

    exit_code = ExitCode.INFEASIBLE


class FlightEndedError(CfplanError):
    """The flight has ended, so nothing more can be asked of it; the exit code is that of the flight."""

    def __init__(self, what: str, *, where: str = "", hint: str = "", exit_code: ExitCode = ExitCode.ENDED_BY_OPERATOR):
        super().__init__(what, where=where, hint=hint)
        self.exit_code = exit_code

    def __reduce__(self):
        return _rebuild_ended, (self.what, self.where, self.hint, self.exit_code)


def _rebuild_ended(what: str, where: str, hint: str, exit_code: ExitCode) -> FlightEndedError:
    return FlightEndedError(what, where=where, hint=hint, exit_code=exit_code)
