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
    """How a command ends: the code that the shell sees, and its meaning."""

    meaning: str

    def __new__(cls, code: int, meaning: str = "") -> "ExitCode":
        member = int.__new__(cls, code)
        member._value_, member.meaning = code, meaning
        return member

    OK = 0, "ok"
    USAGE = 2, "a file, an option or the set-up is wrong"
    INFEASIBLE = 3, "no flight keeps the limits"
    NOT_CERTIFIED = 4, "certificate, dry run or link loss failed"
    PREFLIGHT = 5, "a preflight check failed; nothing has flown"
    ENDED_BY_OPERATOR = 6, "the operator ended the flight"
    ENDED_BY_SAFETY = 7, "a safety rule ended the flight"
    LINK_LOST = 8, "no connection to the vehicle or to motion capture, or the link was lost"


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
