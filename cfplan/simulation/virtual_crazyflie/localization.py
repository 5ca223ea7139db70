"""External positions and poses (CRTP port 6), collected for the filter."""

from struct import iter_unpack, unpack

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.setpoints.packets import decompress_quaternion

_POSITION, _GENERIC, _PACKED_POSITIONS = range(3)
_EMERGENCY_STOP, _KEEP_ALIVE, _POSE, _PACKED_POSES = 3, 4, 8, 9

OWN_ID = 0xE7  # the last byte of the radio address
_NO_TURN = (0.0, 0.0, 0.0, 0.0)


class Localization:
    """Collects measurements until the filter takes them."""

    def __init__(self) -> None:
        self.tick = 0  # of the last packet
        self.latest = np.zeros(7)  # (7,) position and quaternion as last received
        self.emergency_stop = False
        self.kept_alive = False
        self._waiting: list[tuple[float, ...]] = []

    @property
    def waits(self) -> bool:
        """Return whether a measurement has come since the last call of `take`."""
        return bool(self._waiting)

    def take(self, position_deviation: float, attitude_deviation: float) -> NDArray:
        """Return the measurements (n, 9) since the last call, for the filter."""
        rows = [(*row, position_deviation, attitude_deviation) for row in self._waiting]
        self._waiting.clear()
        return np.array(rows, dtype=float).reshape(-1, 9)

    def receive(self, channel: int, payload: bytes, tick: int) -> None:
        """Read a packet; nothing answers."""
        if channel == _POSITION and len(payload) >= 12:
            self._note((*unpack("<fff", payload[:12]), *_NO_TURN), tick)
        elif channel == _PACKED_POSITIONS:
            for item in iter_unpack("<Bhhh", payload[: len(payload) // 7 * 7]):
                if item[0] == OWN_ID:
                    self._note((*(value / 1000 for value in item[1:]), *_NO_TURN), tick)
        elif channel == _GENERIC and payload:
            self._generic(payload[0], payload[1:], tick)

    def _generic(self, kind: int, content: bytes, tick: int) -> None:
        if kind == _EMERGENCY_STOP:
            self.emergency_stop = True
        elif kind == _KEEP_ALIVE:
            self.kept_alive = True
        elif kind == _POSE and len(content) >= 28:
            self._note(unpack("<7f", content[:28]), tick)
        elif kind == _PACKED_POSES:
            for item in iter_unpack("<BhhhI", content[: len(content) // 11 * 11]):
                if item[0] == OWN_ID:
                    turn = decompress_quaternion(np.array([item[4]]))[0]
                    self._note((*(value / 1000 for value in item[1:4]), *(float(value) for value in turn)), tick)

    def _note(self, row: tuple[float, ...], tick: int) -> None:
        self._waiting.append(row)
        self.latest[: 3 if row[3:] == _NO_TURN else 7] = row[: 3 if row[3:] == _NO_TURN else 7]
        self.tick = tick
