"""A run of encoded setpoints, sampled by the clock."""

import copy
from collections.abc import Callable
from typing import cast

from numpy.typing import NDArray

from cfplan.flight.radio.crtp import Port, pack
from cfplan.flight.setpoints.commitment import Commitment
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.telemetry import Quaternion, SetpointSent, Triple

State = tuple[Triple, Triple, Triple, Quaternion, Triple]


class Stream:
    """Setpoints at a fixed rate from a start time; before it the first one, after the end the last one.

    `payloads` (N, 29) uint8, the last of them at rest; `rate` in Hz; `start` in s on the flight's clock;
    `stop_from` returns (M, 29) uint8, a stop from one of the setpoints; None for a stop and a descent.
    Setpoints have numbers, from `first` to `last`; number 0 is due at the start. Everything slow is done when the
    stream is made. If the vehicle flies `on_board`, nothing is sent: the setpoints describe its planned motion.
    """

    def __init__(
        self,
        payloads: NDArray,
        rate: float,
        start: float = 0.0,
        stop_from: Callable[[int], NDArray] | None = None,
        first: int = 0,
        *,
        on_board: bool = False,
    ):
        self.payloads, self.start, self.rate, self.stop_from = payloads, start, rate, stop_from
        self.on_board = on_board
        self.first, self.last = first, first + len(payloads) - 1
        state = decode(payloads)
        fields = (state.position, state.velocity, state.acceleration, state.quaternion, state.body_rate)
        self._fields = fields

    def starting_at(self, start: float) -> "Stream":
        """Return the same setpoints with another start, s."""
        started = copy.copy(self)
        started.start = start
        return started

    @property
    def end(self) -> float:
        """Return when the last setpoint is due, s."""
        return self.start + self.last / self.rate

    def number(self, time: float) -> int:
        """Return the number of the setpoint due at a time, s, also beyond the last one."""
        return round((time - self.start) * self.rate)

    def index(self, time: float) -> int:
        """Return the number of the setpoint for a time, s, so that a late packet carries the right state."""
        return min(max(self.number(time), self.first), self.last)

    def packet(self, index: int) -> bytes:
        """Return a setpoint as a radio packet."""
        return pack(Port.SETPOINT, 0, self.payloads[index - self.first].tobytes())

    def state(self, index: int) -> State:
        """Return position, velocity, acceleration, quaternion and body rate as the vehicle decodes them."""
        row = index - self.first
        return cast(State, tuple(tuple(field[row].tolist()) for field in self._fields))

    def position(self, time: float) -> Triple:
        """Return the position, m, of the setpoint at a time, s."""
        place = min(max((time - self.start) * self.rate, float(self.first)), float(self.last))
        before = min(int(place), self.last)
        share = place - before
        (x, y, z), (x1, y1, z1) = self.state(before)[0], self.state(min(before + 1, self.last))[0]
        return x + share * (x1 - x), y + share * (y1 - y), z + share * (z1 - z)

    def sent(self, index: int, time: float, due: float) -> SetpointSent:
        """Return the telemetry of a setpoint sent at `time` and due at `due`, s."""
        return SetpointSent(time, due, index, *self.state(index))


def stream_of(commitment: Commitment, rate: float, start: float = 0.0, *, on_board: bool = False) -> Stream:
    """Return the stream of a commitment whose setpoint 0 is due at `start`, s."""
    first, stops = commitment.first, commitment.stops
    return Stream(commitment.payloads, rate, start, lambda number: stops[number - first], first, on_board=on_board)
