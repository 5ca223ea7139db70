"""The interface of a flight in progress to the program that steers it: in real time, or on a stepped clock."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from cfplan.air.requests import PathAnswer, Wish
from cfplan.air.timeline import Timeline
from cfplan.errors import CfplanError
from cfplan.flight.clock import Clock
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import FlightOutcome
from cfplan.flight.telemetry import Telemetry, Triple


@dataclass(frozen=True, slots=True)
class Listeners:
    """The listeners of a flight; called from any thread, one after the other."""

    telemetry: Callable[[Telemetry], None]
    answer: Callable[[PathAnswer], None]


class FlightInProgress(Protocol):
    """One flight, which is started once."""

    @property
    def clock(self) -> Clock:
        """Return the clock of the flight."""

    outcome: FlightOutcome | CfplanError | None  # how it ended; None until then

    def first_pose(self) -> tuple[Triple, float]:
        """Return where the vehicle stands, m, and its yaw, rad, before the flight. Raises a CfplanError."""

    def start(self, mission: Mission, timeline: Timeline, listeners: Listeners) -> None:
        """Fly a mission from now on; `timeline` is what it was made from. Returns at once."""

    def ask(self, wish: Wish, waypoints: Sequence[Triple]) -> int:
        """Ask the planner for a change; return the number of the answer."""

    def order(self, order: Order) -> None:
        """Give the pilot an order."""

    def typed(self) -> list[str]:
        """Return the keys that were typed since the last call and are no orders."""

    def wait(self, done: Callable[[], bool], patience: float) -> bool:
        """Let time pass until `done`, asked after each message, or the flight's end, at most for `patience`, s.

        Returns whether it is done.
        """

    def close(self) -> None:
        """Release the vehicle; a flight in progress is landed first. May be called twice."""
