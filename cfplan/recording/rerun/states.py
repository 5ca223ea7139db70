"""The states of a flight that are drawn as coloured bars: the pilot's phase and the vehicle's supervisor."""

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.telemetry import Phase

_GROUND, _AIR, _PATH, _HELD, _DOWN = (98, 108, 122), (60, 120, 180), (46, 160, 110), (222, 160, 50), (120, 90, 170)

PHASE_COLOURS = {
    Phase.CONNECT: _GROUND,
    Phase.RELEASE: _GROUND,
    Phase.CONFIGURE: _GROUND,
    Phase.UPLOAD: _GROUND,
    Phase.FEED: _GROUND,
    Phase.CONVERGE: _GROUND,
    Phase.PREFLIGHT: _GROUND,
    Phase.ARM: _HELD,
    Phase.TAKE_OFF: _AIR,
    Phase.GO_TO_START: _AIR,
    Phase.STREAM: _PATH,
    Phase.HOLD: _HELD,
    Phase.LAND: _DOWN,
    Phase.DISARM: _GROUND,
    Phase.CLOSED: _GROUND,
}

# The bits of supervisor.info that are shown, the gravest first (crazyflie-firmware, supervisor.c).
_SUPERVISOR_BITS = (("crashed", 7), ("locked", 6), ("tumbled", 5), ("flying", 4), ("armed", 1), ("can be armed", 0))
SUPERVISOR_COLOURS = {
    "crashed": (200, 50, 50),
    "locked": (200, 50, 50),
    "tumbled": (200, 50, 50),
    "flying": (46, 160, 110),
    "armed": (222, 160, 50),
    "can be armed": (98, 108, 122),
    "not ready": (60, 66, 76),
}


def supervisor_states(bits: NDArray) -> NDArray:
    """Return (N,) str for (N,) supervisor.info: the gravest of its bits that is set."""
    flags = [(bits >> place) & 1 == 1 for _, place in _SUPERVISOR_BITS]
    return np.select(flags, [name for name, _ in _SUPERVISOR_BITS], default="not ready")
