"""Messages between the pilots of a fleet and their conductor. A single vehicle has no conductor.

The conductor clears each vehicle to arm, to take off and to begin its plan; the pilot waits in ticks until then, so
poses flow and the abort monitor watches. From the order to brake on, or after a silence, the pilot brakes along its
path and lands.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from cfplan.flight.pilot.abort_reasons import Abort
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.telemetry import Phase

CONDUCTOR_SILENT = 1.0  # s without a message of the conductor, which sends twenty a second


@dataclass(frozen=True, slots=True)
class ConductorMessage:
    """All that the conductor has told a vehicle so far; each message replaces the one before."""

    cleared: Mapping[Phase, float]  # when each phase may begin, s on the flight's clock
    brakes: str = ""  # why the fleet brakes; empty while it flies


@dataclass(frozen=True, slots=True)
class ClearanceAsked:
    """A vehicle is ready for a phase, and waits until it is cleared."""

    phase: Phase


@dataclass(frozen=True, slots=True)
class PlanLeft:
    """A vehicle leaves its plan, or goes to a graver rung of the abort ladder."""

    rung: Rung
    reason: str


PilotMessage = ClearanceAsked | PlanLeft


class ConductorSource(Protocol):
    """The conductor as the pilot sees it. Nothing here may wait."""

    def ask(self, phase: Phase) -> None:
        """Tell the conductor that the vehicle is ready for a phase."""

    def clearance(self, phase: Phase) -> float:
        """Return when the phase may begin, s; infinity while that is not known."""

    def brakes(self, now: float) -> str:
        """Return why the vehicle must brake and land, empty while it may fly."""

    def leave(self, abort: Abort) -> None:
        """Tell the conductor that the vehicle leaves its plan."""


class NoConductor:
    """No fleet: every phase begins at once."""

    def ask(self, phase: Phase) -> None:
        pass

    def clearance(self, phase: Phase) -> float:
        return -math.inf

    def brakes(self, now: float) -> str:
        return ""

    def leave(self, abort: Abort) -> None:
        pass


NO_CONDUCTOR = NoConductor()


@dataclass
class HeldConductor:
    """The conductor's newest message, given by code in the pilot's process; `tell` passes messages the other way."""

    tell: Callable[[PilotMessage], None]
    now: Callable[[], float]  # s
    newest: ConductorMessage = field(default_factory=lambda: ConductorMessage({}))
    heard: float = field(init=False)  # s, when the conductor was last heard

    def __post_init__(self) -> None:
        self.heard = self.now()

    def give(self, message: ConductorMessage) -> None:
        """Take a message."""
        self.newest, self.heard = message, self.now()

    def ask(self, phase: Phase) -> None:
        self.tell(ClearanceAsked(phase))

    def clearance(self, phase: Phase) -> float:
        return self.newest.cleared.get(phase, math.inf)

    def brakes(self, now: float) -> str:
        if not self.newest.brakes and now - self.heard > CONDUCTOR_SILENT:
            return f"its conductor has been silent for {CONDUCTOR_SILENT:g} s"
        return self.newest.brakes

    def leave(self, abort: Abort) -> None:
        self.tell(PlanLeft(abort.rung, abort.text))
