"""A run of encoded setpoints, sampled by the clock."""

import copy
from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from cfplan.flight.radio.link import GENERIC_PORT, packet
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.telemetry import SetpointSent, Triple


class Stream:
    """Setpoints at a fixed rate from a start on; before it the first, after its end the last.

    `payloads` (N, 29) uint8, the last of them at rest; `rate` in Hz; `start` in s on the clock of time.monotonic();
    `stop_from` returns (M, 29) uint8, a way to stop from one of the setpoints, and is None for a stop and a descent.
    Everything slow is done when the stream is made, so that sending is a look-up.
    """

    def __init__(
        self,
        payloads: NDArray,
        rate: float,
        start: float = 0.0,
        stop_from: Callable[[int], NDArray] | None = None,
    ):
        self.payloads, self.start, self.rate, self.stop_from = payloads, start, rate, stop_from
        self.packets: list[Any] = [packet(GENERIC_PORT, 0, row.tobytes()) for row in payloads]
        state = decode(payloads)
        fields = (state.position, state.velocity, state.acceleration, state.quaternion, state.body_rate)
        self.states = list(zip(*([tuple(row) for row in field.tolist()] for field in fields), strict=True))
        """(position, velocity, acceleration, quaternion, body rate) of each setpoint, as the vehicle decodes them."""
        self.last = len(self.packets) - 1

    def starting_at(self, start: float) -> "Stream":
        """Return the same setpoints with another start, s."""
        started = copy.copy(self)
        started.start = start
        return started

    @property
    def end(self) -> float:
        """Return when the last setpoint is due, s."""
        return self.start + self.last / self.rate

    def index(self, time: float) -> int:
        """Return the index of the setpoint that belongs to a time, s, so that a late packet carries the right state."""
        return min(max(round((time - self.start) * self.rate), 0), self.last)

    def position(self, time: float) -> Triple:
        """Return where the vehicle is asked to be, m, at a time, s."""
        place = min(max((time - self.start) * self.rate, 0.0), float(self.last))
        row = min(int(place), self.last - 1) if self.last else 0
        share = place - row
        (x, y, z), (x1, y1, z1) = self.states[row][0], self.states[min(row + 1, self.last)][0]
        return x + share * (x1 - x), y + share * (y1 - y), z + share * (z1 - z)

    def sent(self, index: int, time: float, due: float) -> SetpointSent:
        """Return the telemetry of a setpoint sent at `time` and due at `due`, s."""
        return SetpointSent(time, due, index, *self.states[index])
