"""Parameters: the table, reading, writing, defaults and storing (CRTP port 2)."""

import errno
from collections.abc import Callable, Collection, Mapping
from struct import calcsize, error, unpack_from
from struct import pack as bytes_of

from cfplan.simulation.virtual_crazyflie.catalogue import PARAMETERS
from cfplan.simulation.virtual_crazyflie.toc import Toc, Variable, make_toc, read_catalogue

_TYPES = {
    "u8": (0x08, "<B"), "u16": (0x09, "<H"), "u32": (0x0A, "<I"), "i8": (0x00, "<b"), "i16": (0x01, "<h"),
    "i32": (0x02, "<i"), "f32": (0x06, "<f"),
}  # fmt: skip
_EXTENDED, _READ_ONLY = 0x10, 0x40
_TOC, _READ, _WRITE, _MISC = range(4)
(
    _SET_BY_NAME, _VALUE_UPDATED, _EXTENDED_TYPE, _STORE, _STORED_STATE, _CLEAR, _DEFAULT, _EXTENDED_TYPE_2, _DEFAULT_2,
) = range(9)  # fmt: skip
_IS_STORED_TYPE = 1


def parameter_toc(without: Collection[str] = ()) -> Toc:
    """Return the table of all parameters except those that this firmware lacks."""
    variables = []
    for group, kind, marked in read_catalogue(PARAMETERS):
        code, layout = _TYPES[kind]
        if f"{group}.{marked.rstrip('*!')}" in without:
            continue
        stored, read_only = "*" in marked, "!" in marked
        code |= (_EXTENDED if stored else 0) | (_READ_ONLY if read_only else 0)
        variables.append(Variable(group, marked.rstrip("*!"), code, layout, stored, read_only))
    return make_toc(tuple(variables))


class Parameters:
    """The values of the parameters, by name; `watch` tells when a client writes one.

    `without` are parameters that this firmware lacks, `stubborn` those that writing does not change.
    """

    def __init__(self, defaults: Mapping[str, float], *, without: Collection[str] = (), stubborn: Collection[str] = ()):
        self.toc = parameter_toc(without)
        self._ids = self.toc.index()
        self._values: list[float] = [0] * len(self.toc.variables)
        for name, value in defaults.items():
            if name not in without:
                self[name] = value
        self._stubborn = {self._ids[name] for name in stubborn}
        self._defaults = list(self._values)
        self._stored: dict[int, float] = {}
        self._watchers: dict[int, Callable[[float], None]] = {}

    def __getitem__(self, name: str) -> float:
        return self._values[self._ids[name]]

    def __setitem__(self, name: str, value: float) -> None:
        number = self._ids[name]
        layout = self.toc.variables[number].format
        self._values[number] = unpack_from(layout, bytes_of(layout, value if layout == "<f" else int(value)))[0]

    def watch(self, name: str, changed: Callable[[float], None]) -> None:
        """Call `changed` with the new value whenever a client writes it; ignored if this firmware lacks it."""
        if name in self._ids:
            self._watchers[self._ids[name]] = changed

    def restore(self, stored: Mapping[str, float]) -> None:
        """Take values over that were stored before power-up; a name that this firmware lacks is ignored."""
        for name, value in stored.items():
            if name in self._ids:
                self[name] = value
                number = self._ids[name]
                self._stored[number] = self._values[number]
                if number in self._watchers:
                    self._watchers[number](self._values[number])

    def receive(self, channel: int, payload: bytes) -> bytes | None:
        """Take a packet; return the answer's payload, on the same channel, None where the firmware is silent."""
        if channel == _TOC:
            return self.toc.answer(payload)
        if channel == _MISC:
            return self._misc(payload)
        if len(payload) < 2:
            return None
        (number,) = unpack_from("<H", payload)
        if number >= len(self._values):
            return payload[:2] + bytes((errno.ENOENT,))
        return self._read(number) if channel == _READ else self._write(number, payload)

    def _encoded(self, number: int, values: list[float]) -> bytes:
        return bytes_of(self.toc.variables[number].format, values[number])

    def _read(self, number: int) -> bytes:
        return bytes_of("<HB", number, 0) + self._encoded(number, self._values)

    def _write(self, number: int, payload: bytes) -> bytes | None:
        entry = self.toc.variables[number]
        if entry.read_only:
            return None
        try:
            (value,) = unpack_from(entry.format, payload, 2)
        except error:  # too short: the firmware takes what its buffer holds; here nothing changes
            return None
        self._set(number, value)
        return payload

    def _set(self, number: int, value: float) -> None:
        if number in self._stubborn:
            return
        self._values[number] = value
        if number in self._watchers:
            self._watchers[number](value)

    def _misc(self, payload: bytes) -> bytes | None:
        command = payload[0] if payload else -1
        if command == _SET_BY_NAME:
            return self._set_by_name(payload)
        if command not in range(_EXTENDED_TYPE, _DEFAULT_2 + 1) or len(payload) < 3:
            return None
        (number,) = unpack_from("<H", payload, 1)
        known = number < len(self._values)
        failed = payload[:3] + bytes((errno.ENOENT,))
        entry = self.toc.variables[number] if known else None
        if command in (_DEFAULT, _DEFAULT_2):
            if entry is None or entry.read_only:
                return failed
            return payload[:3] + (b"\0" if command == _DEFAULT_2 else b"") + self._encoded(number, self._defaults)
        if entry is None or not entry.stored:
            return failed
        if command == _EXTENDED_TYPE:
            return payload[:3] + bytes((_IS_STORED_TYPE,))
        if command == _EXTENDED_TYPE_2:
            return payload[:3] + bytes((0, _IS_STORED_TYPE))
        if command == _STORED_STATE:
            return payload[:3] + self._stored_state(number)
        if command == _STORE:
            self._stored[number] = self._values[number]
        else:
            self._stored.pop(number, None)
        return payload[:3] + b"\0"

    def _stored_state(self, number: int) -> bytes:
        default = self._encoded(number, self._defaults)
        if number not in self._stored:
            return b"\0" + default
        return b"\1" + default + bytes_of(self.toc.variables[number].format, self._stored[number])

    def _set_by_name(self, payload: bytes) -> bytes | None:
        parts = payload[1:].split(b"\0", 2)
        if len(parts) < 3 or not parts[2]:
            return None
        name = b".".join(parts[:2]).decode("latin-1")
        head = payload[: len(payload) - len(parts[2])]
        number = self._ids.get(name)
        if number is None:
            return head + bytes((errno.ENOENT,))
        entry = self.toc.variables[number]
        if parts[2][0] != entry.code & ~(_EXTENDED | _READ_ONLY):
            return head + bytes((errno.EINVAL,))
        if entry.read_only:
            return head + bytes((errno.EACCES,))
        if len(parts[2]) < 1 + calcsize(entry.format):
            return None
        self._set(number, unpack_from(entry.format, parts[2], 1)[0])
        return head + b"\0"
