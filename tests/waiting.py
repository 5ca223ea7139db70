"""Wait for what another process or thread does. A verdict never depends on how long that took."""

import time
from collections.abc import Callable

PATIENCE = 200.0  # s of the computer's time, spent only where something never happens
_LOOK_PERIOD = 0.005  # s


def until(condition: Callable[[], object], patience: float = PATIENCE) -> bool:
    """Wait for a condition; return whether it came."""
    end = time.monotonic() + patience
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(_LOOK_PERIOD)
    return True


def a_moment(seconds: float = 0.1) -> None:
    """Give other processes a chance to do what they must not do."""
    time.sleep(seconds)
