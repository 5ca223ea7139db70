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

Table = Mapping[str, tuple[int, int]]  # by full name: number in packets, and type as the wire has it
Ask = Callable[[Port, int, bytes, int], bytes]  # as `Session.ask`


class TableCache:
    """Known tables by port and checksum, which changes with each table; also in a folder, if one is given."""

    def __init__(self, folder: Path | None = None):
        self._folder = folder
        self._known: dict[str, Table] = {}

    def add(self, port: Port, checksum: int, table: Table) -> None:
        """Add a table; where the folder cannot be written, for this process alone."""
        name = _name(port, checksum)
        self._known[name] = table
        if self._folder is not None:
            with suppress(OSError), atomic_write(self._folder / name) as file:
                file.write_text(json.dumps(table))

    def find(self, port: Port, checksum: int) -> Table | None:
        """Return a table that was added, also by another process; None if there is none that can be read."""
        name = _name(port, checksum)
        if name not in self._known and self._folder is not None:
            with suppress(OSError, ValueError, TypeError, AttributeError):
                read = json.loads((self._folder / name).read_text())
                self._known[name] = {each: (int(number), int(kind)) for each, (number, kind) in read.items()}
        return self._known.get(name)


def _name(port: Port, checksum: int) -> str:
    return f"{port.name.lower()}-{checksum:08X}.json"


def disk_table_cache() -> TableCache:
    """Return the tables that are cached between connections; where no folder can be made, for this process alone."""
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
    """Return the full name in an item: after command, number and type, group and name end with a zero each."""
    group, name = item[4:].split(b"\0")[:2]
    return f"{group.decode('ascii')}.{name.decode('ascii')}"
