"""Health: which of its sources the pilot still hears, and the table of what it does about each combination.

There are four sources: the uplink, by answers to cflib's pings, which acknowledge that the vehicle hears; the
vehicle's two logs, estimate and status; and the poses that reach the vehicle. Each is fresh, late or gone. The pilot
computes that once a tick; abort ladder, landing, holding and link loss read it.

Acknowledgements alone say whether the vehicle can be steered. A vehicle whose logs are silent while it acknowledges
flies what it is sent, so it brakes along its certified stop, lands by poses and is disarmed like any other.
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

UPLINK_LATE = 0.25  # s without an answer to cflib's pings, ten a second
UPLINK_GONE = Timeouts().level_out  # s; a vehicle that has had no setpoint for so long leaves its stream
LOG_GONE = 0.5  # s without a message of one of the vehicle's logs
_LONGEST_STEP = 0.05  # s between two ticks that count as silence; beyond it this computer stood still


class Freshness(StrEnum):
    """How long ago a source was heard."""

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
        """Return what the pilot does."""
        return REACTIONS[self]

    @property
    def status_unknown(self) -> bool:
        """Return whether the vehicle hears the pilot and does not tell its status."""
        return self.status is GONE and self.uplink is not GONE


class Descent(Enum):
    """How the vehicle comes down."""

    BY_POSES = "its certified stop, then gently by poses until they show that it stands"
    BLIND = "its certified stop, sinking meanwhile, then quickly until its estimate or the time says that it stands"
    HELD = "a hover where it was seen last until it acknowledges again; without that it comes down by link loss"


@dataclass(frozen=True, slots=True)
class Reaction:
    """What the pilot does by the health of one tick."""

    rung: Rung  # that its flight takes at least: from take-off to the hover behind the plan
    descent: Descent  # how it then lands, and how a landing that has begun goes on


_Fits = tuple[Freshness, ...]
_ANY: _Fits = (FRESH, LATE, GONE)
_HEARD: _Fits = (FRESH, LATE)

# The first row that fits counts. Before lift-off none does: each phase waits for the source that it needs, and without
# it the vehicle does not take off.
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
        self._looked = math.nan  # s, when it was last computed
        self._silent = [0.0, 0.0, 0.0]  # s, of uplink, estimate and status

    @property
    def uplink_silent(self) -> float:
        """Return how long, s, nothing has been acknowledged."""
        return self._silent[0]

    def look(self, now: float, *, uplink: float, estimate: float, status: float, poses: float) -> Health:
        """Return the health at a tick; each argument is in s on its clock, when that source was last heard.

        While this computer stands still it hears nothing, so that does not count as silence of uplink and logs. Poses
        grow old meanwhile.
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
