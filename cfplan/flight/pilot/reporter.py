"""The reporter sends telemetry out of the pilot's process without ever delaying the stream."""

import threading
from collections import deque
from multiprocessing.connection import Connection

from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.telemetry import Telemetry

CAPACITY = 20_000  # messages: half a minute of a flight
_PERIOD = 0.02  # s between batches
_CLOSING_TIME = 2.0  # s to wait for a slow reader at the end of a flight


class Reporter:
    """Takes messages at once and sends them in batches from its own thread.

    If the reader is slow or stuck, the oldest messages are dropped and counted.
    """

    def __init__(self, connection: Connection, capacity: int = CAPACITY, clock: Clock = REAL_CLOCK):
        self._connection, self._clock = connection, clock
        self._waiting: deque[Telemetry] = deque(maxlen=capacity)
        self.dropped = 0
        self._sending = clock.repeat(self._send, name="telemetry")

    def __call__(self, message: Telemetry) -> None:
        if len(self._waiting) == self._waiting.maxlen:
            self.dropped += 1
        self._waiting.append(message)

    def _send(self) -> float | None:
        batch = []
        while self._waiting:
            batch.append(self._waiting.popleft())
        try:
            if batch:
                self._connection.send(batch)
        except OSError:
            return None  # the reader is gone; the pilot learns that from its orders
        except Exception:  # drop only the messages that cannot be sent
            self.dropped += len(batch)
        return _PERIOD

    def close(self, last: object) -> None:
        """Send the waiting messages, then `last`, for at most 2 s."""
        end = self._clock.now() + _CLOSING_TIME
        if not self._sending.stop(_CLOSING_TIME):
            return
        sending = threading.Thread(target=self._send_last, args=(last,), daemon=True)
        sending.start()
        sending.join(max(0.1, end - self._clock.now()))

    def _send_last(self, last: object) -> None:
        try:
            self._connection.send(list(self._waiting))
            self._connection.send(last)
        except OSError:
            return
