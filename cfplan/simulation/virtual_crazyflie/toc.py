"""Tables of contents of log variables and parameters, and the packets (version 2) by which a client reads them."""

import zlib
from dataclasses import dataclass
from struct import pack as bytes_of
from struct import unpack_from

_GET_ITEM, _GET_INFO = 2, 3


@dataclass(frozen=True, slots=True)
class Variable:
    """One entry: its place in the table is its id on the wire."""

    group: str
    name: str
    code: int  # the type as the wire has it, flags included
    format: str  # of the struct module, little-endian
    stored: bool = False  # a parameter that can be kept over a restart
    read_only: bool = False

    @property
    def full_name(self) -> str:
        return f"{self.group}.{self.name}"


@dataclass(frozen=True, slots=True)
class Toc:
    """A table with its checksum, the key of clients' caches."""

    variables: tuple[Variable, ...]
    checksum: int
    trailer: bytes = b""  # what follows the checksum in the answer about the table

    def answer(self, request: bytes) -> bytes | None:
        """Return the payload that answers a request on channel 0, None where the firmware is silent."""
        if request[:1] == bytes((_GET_INFO,)):
            return bytes_of("<BHI", _GET_INFO, len(self.variables), self.checksum) + self.trailer
        if request[:1] == bytes((_GET_ITEM,)) and len(request) >= 3:
            (index,) = unpack_from("<H", request, 1)
            if index >= len(self.variables):
                return bytes((_GET_ITEM,))
            entry = self.variables[index]
            return bytes_of("<BHB", _GET_ITEM, index, entry.code) + _names(entry)
        return None

    def index(self) -> dict[str, int]:
        """Return the ids by full name."""
        return {entry.full_name: number for number, entry in enumerate(self.variables)}


def make_toc(variables: tuple[Variable, ...], trailer: bytes = b"") -> Toc:
    """Return the table of these variables."""
    text = b"".join(bytes((entry.code,)) + _names(entry) for entry in variables)
    return Toc(variables, zlib.crc32(text), trailer)


def _names(entry: Variable) -> bytes:
    return entry.group.encode() + b"\0" + entry.name.encode() + b"\0"


def read_catalogue(text: str) -> list[tuple[str, str, str]]:
    """Return (group, type, name with marks) of every entry of a text like those in `catalogue`."""
    entries = []
    group = ""
    kind = ""
    for word in text.split():
        if word.endswith(":"):
            group, kind = word[:-1], ""
        elif not kind:
            kind = word
        else:
            entries.append((group, kind, word.rstrip(";")))
            if word.endswith(";"):
                kind = ""
    return entries
