"""Capture times: when a frame was taken, from its number and its arrival.

Network and computers delay frames by varying times. Frame numbers advance at the cameras' steady rate, so the earliest
arrival shows when each number is due. A frame that arrives later was delayed on its way, and its pose is older by as
much, however long the delay lasts. The announced rate is used once the frame numbers have been seen to advance at it.
"""

import math

_RATE_CHECK_PERIOD = 1.0  # s; the announced rate is checked over two such periods
_DRIFT = 5e-4  # relative difference of the two clocks, at which the earliest arrival is forgotten
_RATE_TOLERANCE = _DRIFT  # of the announced rate, from the earliest arrivals of both periods


class FrameClock:
    """Computes capture times. Without frame numbers or a confirmed rate, a frame counts as just taken.

    `latency`, s, is the time from exposure to arrival of a frame that is not delayed.
    """

    def __init__(self, latency: float):
        self._latency = latency
        self._number: int | None = None
        self._rate = math.nan
        # s, earliest arrival of frame 0 in the first and in the second check period; None once the rate is confirmed
        self._earliest_of_halves: list[float] | None = None
        self._check_begin = math.nan
        # s: arrival of frame 0 according to the earliest arrivals; the last arrival
        self._earliest = self._heard = math.inf

    @property
    def sure(self) -> bool:
        """Return whether delays are recognised."""
        return self._number is not None and self._earliest_of_halves is None

    def taken(self, received: float, number: int | None, rate: float, latency: float = math.nan) -> float:
        """Return when the frame was taken, s. `latency`, s, is the system's own figure; the larger one counts."""
        behind = max(self._latency, latency) if math.isfinite(latency) else self._latency
        if number is None or not (math.isfinite(rate) and rate > 0):
            return received - behind
        if self._number is None or number < self._number or rate != self._rate:
            self._begin(received)
        self._number, self._rate = number, rate
        start = received - number / rate
        self._earliest = min(self._earliest + _DRIFT * max(received - self._heard, 0.0), start)
        self._heard = received
        if self._earliest_of_halves is not None and not self._rate_confirmed(received, start):
            return received - behind
        return self._earliest + number / rate - behind

    def _begin(self, received: float) -> None:
        self._earliest_of_halves, self._check_begin = [math.inf, math.inf], received
        self._earliest, self._heard = math.inf, received

    def _rate_confirmed(self, received: float, start: float) -> bool:
        assert self._earliest_of_halves is not None
        half = int((received - self._check_begin) / _RATE_CHECK_PERIOD)
        if half < 2:
            self._earliest_of_halves[half] = min(self._earliest_of_halves[half], start)
            return False
        if not abs(self._earliest_of_halves[1] - self._earliest_of_halves[0]) < _RATE_TOLERANCE * _RATE_CHECK_PERIOD:
            self._begin(received)
            return False
        self._earliest_of_halves = None
        return True
