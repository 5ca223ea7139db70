"""When a frame was taken, from when it came.

A frame comes late by what the network and the computers add at that moment. Frame numbers count at the cameras' steady
rate, so the earliest arrival seen lately tells when each number should have come, and what is later than that was
delayed on its way: its pose is older than it looks.
"""

import math

_WINDOW = 5.0  # s; between one and two of these are remembered, so that clocks may drift apart


class FrameClock:
    """Dates frames back. Without frame numbers or rate, a frame counts as just taken."""

    def __init__(self, latency: float):
        # latency in s from the exposure to this computer where nothing delays it
        self._latency = latency
        self._number: int | None = None
        self._rate = math.nan
        self._earliest = [math.inf, math.inf]
        self._window_end = -math.inf

    def taken(self, received: float, number: int | None, rate: float, latency: float = math.nan) -> float:
        """When the frame was taken, s. `latency` is the system's own figure and counts where it is the larger one."""
        behind = max(self._latency, latency) if math.isfinite(latency) else self._latency
        if number is None or not (math.isfinite(rate) and rate > 0):
            return received - behind
        if self._number is None or number < self._number or rate != self._rate:
            self._earliest, self._window_end = [math.inf, math.inf], received + _WINDOW
        self._number, self._rate = number, rate
        start = received - number / rate
        if received > self._window_end:
            self._earliest, self._window_end = [start, self._earliest[0]], received + _WINDOW
        self._earliest[0] = min(self._earliest[0], start)
        return min(self._earliest) + number / rate - behind
