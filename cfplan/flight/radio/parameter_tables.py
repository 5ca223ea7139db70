"""The vehicle's tables of parameters and log variables, cached on disk by their checksums."""

import json
import os
import struct
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from cfplan.files.atomic import atomic_write
from cfplan.flight.radio.crtp import Port

_CHANNEL = 0
_ITEM, _INFO = b"\2", b"\3"

Table = Mapping[str, tuple[int, int]]  # full name: (number, type code), as in packets
Ask = Callable[[Port, int, bytes, int], bytes]  # as `Session.ask`


class TableCache:
    """Known tables by port and checksum, in memory and, if a folder is given, on disk."""

    def __init__(self, folder: Path | None = None):
        self._folder = folder
        self._known: dict[str, Table] = {}

    def add(self, port: Port, checksum: int, table: Table) -> None:
        """Add a table; if the folder cannot be written, only for this process."""
        name = _name(port, checksum)
        self._known[name] = table
        if self._folder is not None:
            with suppress(OSError), atomic_write(self._folder / name) as file:
                file.write_text(json.dumps(table))

    def find(self, port: Port, checksum: int) -> Table | None:
        """Return a cached table, also of another process; None if there is none that can be read."""
        name = _name(port, checksum)
        if name not in self._known and self._folder is not None:
            with suppress(OSError, ValueError, TypeError, AttributeError):
                read = json.loads((self._folder / name).read_text())
                self._known[name] = {each: (int(number), int(kind)) for each, (number, kind) in read.items()}
        return self._known.get(name)


def _name(port: Port, checksum: int) -> str:
    return f"{port.name.lower()}-{checksum:08X}.json"


def disk_table_cache() -> TableCache:
    """Return the cache that is kept between connections; if no folder can be made, only for this process."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "cfplan" / "tables"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return TableCache()
    return TableCache(folder)


def read_table(port: Port, ask: Ask, tables: TableCache) -> Table:
    """Return the vehicle's table of a port, read item by item unless it is known.

    Raises LinkError as `ask` does, and ValueError, IndexError or struct.error if an answer is damaged.
    """
    count, checksum = struct.unpack_from("<HI", ask(port, _CHANNEL, _INFO, 1), 1)
    table = tables.find(port, checksum)
    if table is None or len(table) != count:
        items = (ask(port, _CHANNEL, _ITEM + struct.pack("<H", number), 3) for number in range(count))
        table = {_full_name(item): (number, item[3]) for number, item in enumerate(items)}
        tables.add(port, checksum, table)
    return table


def _full_name(item: bytes) -> str:
    """Return the full name in an item: command, number, type, then group and name, each ended by a zero."""
    group, name = item[4:].split(b"\0")[:2]
    return f"{group.decode('ascii')}.{name.decode('ascii')}"
