"""A run of encoded setpoints, sampled by the clock."""

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from cfplan.flight.radio.link import GENERIC_PORT, packet
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.telemetry import SetpointSent, Triple


class Stream:
    """Setpoints at a fixed rate from a start on; before it the first, after its end the last.

    Everything slow is done here at once, so that sending is a look-up.
    """

    def __init__(
        self,
        payloads: NDArray,
        rate: float,
        start: float = 0.0,
        stop_from: Callable[[int], NDArray] | None = None,
    ):
        # payloads (N, 29) uint8, the last of them at rest; start in s on the clock of time.monotonic();
        # stop_from gives (M, 29) uint8, a way to stop from one of them; None where it is a stop itself
        self.start, self.rate, self.stop_from = start, rate, stop_from
        self.packets: list[Any] = [packet(GENERIC_PORT, 0, row.tobytes()) for row in payloads]
        state = decode(payloads)
        fields = (state.position, state.velocity, state.acceleration, state.quaternion, state.body_rate)
        # (position, velocity, acceleration, quaternion, body rate) of each, as the vehicle decodes them
        self.states = list(zip(*([tuple(row) for row in field.tolist()] for field in fields), strict=True))
        self.last = len(self.packets) - 1

    @property
    def end(self) -> float:
        """s, when the last setpoint is due."""
        return self.start + self.last / self.rate

    def index(self, time: float) -> int:
        """The setpoint that belongs to a time: a late packet carries the right state."""
        return min(max(round((time - self.start) * self.rate), 0), self.last)

    def position(self, time: float) -> Triple:
        """Where the vehicle is asked to be at a time."""
        place = min(max((time - self.start) * self.rate, 0.0), float(self.last))
        row = min(int(place), self.last - 1) if self.last else 0
        share = place - row
        (x, y, z), (x1, y1, z1) = self.states[row][0], self.states[min(row + 1, self.last)][0]
        return x + share * (x1 - x), y + share * (y1 - y), z + share * (z1 - z)

    def sent(self, index: int, time: float, due: float) -> SetpointSent:
        return SetpointSent(time, due, index, *self.states[index])
