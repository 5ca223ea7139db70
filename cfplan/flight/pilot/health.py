"""Health: how recently the pilot heard each of its sources, and the table of its reactions to each combination.

There are four sources: the uplink (answers to pings, which acknowledge that the vehicle hears), its two logs
(estimate and status), and the poses that reach the vehicle. Each is fresh, late or gone. The pilot computes the health
once a tick; the abort ladder, holding and landing react to silence by it.

Only acknowledgements show whether the vehicle can be steered. A vehicle that acknowledges while its logs are silent
follows its setpoints, so it brakes along its certified stop, lands by poses and is disarmed as usual.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, StrEnum
from operator import contains
from types import MappingProxyType

from cfplan.flight.firmware import Timeouts
from cfplan.flight.pilot.outcome import Rung
from cfplan.safety.limits import PoseLimits

UPLINK_LATE = 0.25  # s without an answer to pings, ten a second
UPLINK_GONE = Timeouts().level_out  # s; a vehicle without a setpoint for this long leaves its stream
LOG_GONE = 0.6  # s without a message of one of the vehicle's logs; if the radio is dead, the uplink is gone first
_LONGEST_STEP = 0.05  # s, longest silence counted between two ticks; beyond it this computer stalled


class Freshness(StrEnum):
    """How recently a source was heard."""

    FRESH = "fresh"
    LATE = "late"
    GONE = "gone"


FRESH, LATE, GONE = Freshness.FRESH, Freshness.LATE, Freshness.GONE


@dataclass(frozen=True, slots=True)
class Health:
    """The freshness of each source at one tick."""

    uplink: Freshness = FRESH
    poses: Freshness = FRESH
    estimate: Freshness = FRESH
    status: Freshness = FRESH

    @property
    def reaction(self) -> "Reaction":
        """Return the pilot's reaction."""
        return REACTIONS[self]

    @property
    def status_unknown(self) -> bool:
        """Return whether the vehicle acknowledges but does not report its status."""
        return self.status is GONE and self.uplink is not GONE


class Descent(Enum):
    """How the vehicle comes down."""

    BY_POSES = "its certified stop, then gently by poses until they show that it stands"
    BLIND = "its certified stop while sinking, then quickly until its estimate shows that it stands, or the time is up"
    HELD = "a hover where it was seen last until it acknowledges again; else link loss"


@dataclass(frozen=True, slots=True)
class Reaction:
    """The pilot's reaction to the health of one tick."""

    rung: Rung  # least rung of the abort ladder, from take-off to the hover after the plan
    descent: Descent  # how the vehicle comes down then; also during a landing


_Fits = tuple[Freshness, ...]
_ANY: _Fits = (FRESH, LATE, GONE)
_HEARD: _Fits = (FRESH, LATE)

# The first row that fits applies. None applies before lift-off: each phase waits for the source that it needs, and the
# vehicle does not take off without it.
_ROWS: tuple[tuple[_Fits, _Fits, _Fits, _Fits, Reaction], ...] = (
    # uplink, poses, estimate, status
    ((GONE,), _ANY, _ANY, _ANY, Reaction(Rung.LAND, Descent.HELD)),
    (_HEARD, (GONE,), _ANY, _ANY, Reaction(Rung.LAND, Descent.BLIND)),
    (_HEARD, _HEARD, (GONE,), _ANY, Reaction(Rung.LAND, Descent.BY_POSES)),
    (_HEARD, _HEARD, _HEARD, (GONE,), Reaction(Rung.LAND, Descent.BY_POSES)),
    (_HEARD, (LATE,), _HEARD, _HEARD, Reaction(Rung.BRAKE, Descent.BY_POSES)),
    (_HEARD, (FRESH,), _HEARD, _HEARD, Reaction(Rung.NONE, Descent.BY_POSES)),
)


def _reaction(health: Health) -> Reaction:
    seen = (health.uplink, health.poses, health.estimate, health.status)
    return next(reaction for *fits, reaction in _ROWS if all(map(contains, fits, seen)))


REACTIONS: Mapping[Health, Reaction] = MappingProxyType(
    {health: _reaction(health) for health in itertools.starmap(Health, itertools.product(Freshness, repeat=4))}
)


class HealthMonitor:
    """Computes the health at each tick."""

    def __init__(self, limits: PoseLimits):
        self._limits = limits
        self._looked = math.nan  # s, when the health was last computed
        self._silent = [0.0, 0.0, 0.0]  # s, how long uplink, estimate and status have been silent

    @property
    def uplink_silent(self) -> float:
        """Return how long, s, the vehicle has acknowledged nothing."""
        return self._silent[0]

    def look(self, now: float, *, uplink: float, estimate: float, status: float, poses: float) -> Health:
        """Return the health at the time `now`, s; the other arguments are when each source was last heard, s.

        A stall of this computer does not count as silence of uplink and logs, since it hears nothing meanwhile. Poses
        grow old all the same.
        """
        step = min(now - self._looked, _LONGEST_STEP) if self._looked == self._looked else math.inf
        self._looked = now
        heard = (uplink, estimate, status)
        self._silent = [min(now - time, before + step) for time, before in zip(heard, self._silent, strict=True)]
        uplink_silent, estimate_silent, status_silent = self._silent
        log_late = self._limits.age_warning
        return Health(
            uplink=_freshness(uplink_silent, UPLINK_LATE, UPLINK_GONE),
            poses=_freshness(now - poses, self._limits.age_brake, self._limits.age_land),
            estimate=_freshness(estimate_silent, log_late, LOG_GONE),
            status=_freshness(status_silent, log_late, LOG_GONE),
        )


def _freshness(silent: float, late: float, gone: float) -> Freshness:
    return FRESH if silent <= late else LATE if silent <= gone else GONE
