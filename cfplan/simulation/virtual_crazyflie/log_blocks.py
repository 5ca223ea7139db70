"""Log blocks: the table of variables, and packets of their values at set periods (CRTP port 5)."""

import errno
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from math import copysign, inf
from struct import Struct, calcsize, unpack_from
from struct import pack as bytes_of

from cfplan.simulation.virtual_crazyflie.catalogue import LOG_VARIABLES
from cfplan.simulation.virtual_crazyflie.toc import Toc, Variable, make_toc, read_catalogue

_TYPES = {
    "u8": (1, "B"), "u16": (2, "H"), "u32": (3, "I"), "i8": (4, "b"), "i16": (5, "h"), "i32": (6, "i"), "f32": (7, "f"),
}  # fmt: skip
_FORMATS = dict(_TYPES.values()) | {8: "e"}
_FLOATING = "fe"
_HEAD = "BHB"  # number of the block; stamp, 24 bits
_TYPE_MASK = 0x0F
_TOC, _SETTINGS, DATA_CHANNEL = range(3)
_CREATE, _APPEND, _DELETE, _START, _STOP, _RESET, _CREATE_2, _APPEND_2, _START_2 = range(9)
_NO_VARIABLE = 0xFFFF  # means an address in memory, which is not simulated

MAX_BLOCKS = 16
MAX_VARIABLES = 128
MAX_BYTES = 26

Getter = Callable[[], float]


def log_toc(without: Collection[str] = ()) -> Toc:
    """Return the table of all log variables except those that this firmware lacks."""
    variables = [
        Variable(group, name, *_TYPES[kind])
        for group, kind, name in read_catalogue(LOG_VARIABLES)
        if f"{group}.{name}" not in without
    ]
    return make_toc(tuple(variables), trailer=bytes((MAX_BLOCKS, MAX_VARIABLES)))


@dataclass(slots=True)
class _Block:
    layout: Struct = field(default_factory=lambda: Struct("<" + _HEAD))
    getters: list[Getter] = field(default_factory=list)  # of numbers that the layout takes, but for large floats
    names: list[str] = field(default_factory=list)  # of its variables
    period: int = 0  # ms; 0 while it is stopped
    due: int = 0  # tick of the next packet

    @property
    def size(self) -> int:
        """Return the bytes of its variables."""
        return self.layout.size - calcsize("<" + _HEAD)


def _zero() -> float:
    return 0


class LogBlocks:
    """The log blocks of a client. `getters` return the values, by name; a variable without one stays zero."""

    def __init__(self, getters: Mapping[str, Getter], *, without: Collection[str] = ()):
        self.toc = log_toc(without)
        known = self.toc.index()
        unknown = set(getters) - set(known) - set(without)
        if unknown:
            raise KeyError(f"not in the table: {sorted(unknown)}")
        self._getters = [getters.get(entry.full_name, _zero) for entry in self.toc.variables]
        self._blocks: dict[int, _Block] = {}

    def receive(self, channel: int, payload: bytes, tick: int) -> bytes | None:
        """Take a packet; return the answer's payload, on the same channel, None where the firmware is silent."""
        if channel == _TOC:
            return self.toc.answer(payload)
        if channel != _SETTINGS or not payload:
            return None
        command, block, rest = payload[0], payload[1] if len(payload) > 1 else 0, payload[2:]
        return bytes((command, block, self._command(command, block, rest, tick)))

    def _command(self, command: int, number: int, rest: bytes, tick: int) -> int:
        if command == _RESET:
            self.clear()
            return 0
        if command == _CREATE_2:
            if number in self._blocks:
                return errno.EEXIST
            if len(self._blocks) >= MAX_BLOCKS:
                return errno.ENOMEM
            self._blocks[number] = _Block()
            return self._append(self._blocks[number], rest)
        if command not in (_APPEND_2, _DELETE, _START, _STOP, _START_2):
            return errno.ENOEXEC
        if number not in self._blocks:
            return errno.ENOENT
        block = self._blocks[number]
        if command == _APPEND_2:
            return self._append(block, rest)
        if command == _DELETE:
            del self._blocks[number]
        elif command == _STOP:
            block.period = 0
        elif command == _START and rest:
            block.period = rest[0] * 10
            block.due = tick + block.period
        elif command == _START_2 and len(rest) >= 2:
            block.period = unpack_from("<H", rest)[0]
            block.due = tick + block.period
        return 0

    def _append(self, block: _Block, settings: bytes) -> int:
        for offset in range(0, len(settings) - 2, 3):
            code, number = unpack_from("<BH", settings, offset)
            layout = _FORMATS.get(code & _TYPE_MASK)
            if layout is None or number == _NO_VARIABLE or number >= len(self._getters):
                return errno.ENOENT
            if block.size + calcsize("<" + layout) > MAX_BYTES:
                return errno.E2BIG
            if sum(len(each.getters) for each in self._blocks.values()) >= MAX_VARIABLES:
                return errno.ENOMEM
            getter, layout = self._getters[number], layout if layout in _FLOATING else layout.upper()
            block.layout = Struct(block.layout.format + layout)
            largest = (1 << 8 * calcsize("<" + layout)) - 1
            block.getters.append(getter if layout in _FLOATING else partial(_bits, getter, largest))
            block.names.append(self.toc.variables[number].full_name)
        return 0

    def clear(self) -> None:
        """Delete all blocks."""
        self._blocks.clear()

    def due(self, tick: int, silent: Collection[str] = ()) -> list[bytes]:
        """Return the payloads, on DATA_CHANNEL, of the blocks that are due, without those with a `silent` variable."""
        return [
            self._sample(number, block, tick)
            for number, block in self._blocks.items()
            if self._is_due(block, tick) and not (silent and any(name in silent for name in block.names))
        ]

    @staticmethod
    def _is_due(block: _Block, tick: int) -> bool:
        if not block.period or tick < block.due:
            return False
        block.due = max(block.due + block.period, tick + 1)
        return True

    @staticmethod
    def _sample(number: int, block: _Block, tick: int) -> bytes:
        head, values = (number, tick & 0xFFFF, tick >> 16 & 0xFF), [get() for get in block.getters]
        try:
            return block.layout.pack(*head, *values)
        except OverflowError:
            layouts = block.layout.format[1 + len(_HEAD) :]
            return block.layout.pack(*head, *map(_in_range, layouts, values))


def _bits(getter: Getter, largest: int) -> int:
    """Return a value as an integer, cut to the bits of the largest one, as in C; 0 where it is not finite."""
    try:
        return int(getter()) & largest
    except (ValueError, OverflowError):
        return 0


def _in_range(layout: str, value: float) -> float:
    """Return a value, infinite where its type is too small for it, as in C."""
    try:
        bytes_of("<" + layout, value)
    except OverflowError:
        return copysign(inf, value)
    return value
