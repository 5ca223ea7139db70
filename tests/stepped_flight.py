"""A whole flight in the stepped lab: the pilot's and the main process's code in one thread, message by message."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from cfplan.errors import CfplanError
from cfplan.flight.pilot.conducted import NO_CONDUCTOR, ConductorSource
from cfplan.flight.pilot.keys import HeldOrders, Keyboard, Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import FlightOutcome
from cfplan.flight.pilot.pilot import Pilot
from cfplan.flight.pilot.process import Attendant
from cfplan.flight.pilot.proposals import NO_PROPOSALS, ProposalSource
from cfplan.flight.telemetry import Event, Phase, PhaseEntered, SetpointSent, Telemetry
from cfplan.simulation.lab.lab import Truth
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.lab.stepped_link import SteppedPoses, connect

React = Callable[[Telemetry], None]


@dataclass
class Flight:
    """What a flight left behind."""

    outcome: FlightOutcome
    telemetry: list[Telemetry]
    truth: Truth

    def of(self, kind: type) -> list[Telemetry]:
        return [message for message in self.telemetry if isinstance(message, kind)]

    @property
    def phases(self) -> list[Phase]:
        return [message.phase for message in self.of(PhaseEntered)]

    @property
    def said(self) -> list[str]:
        return [message.text for message in self.of(Event)]


def at_setpoint(index: int, action: Callable[[], None]) -> React:
    """A reaction that acts once, when that setpoint of the plan has been sent."""
    done, streaming = False, False

    def react(message: Telemetry) -> None:
        nonlocal done, streaming
        if isinstance(message, PhaseEntered):
            streaming = message.phase is Phase.STREAM
        if streaming and not done and isinstance(message, SetpointSent) and message.index >= index:
            done = True
            action()

    return react


def fly_stepped(
    mission: Mission,
    react: React = lambda _: None,
    *,
    lab: SteppedLab | None = None,
    orders: HeldOrders | None = None,
    more_orders: Callable[[], Sequence[Order]] = tuple,
    proposals: ProposalSource = NO_PROPOSALS,
    conductor: ConductorSource = NO_CONDUCTOR,
) -> Flight:
    """Fly; `react` sees each message as it comes. What the main process would raise is raised."""
    lab, orders = lab or SteppedLab(mission.limits.airframe), orders or HeldOrders()
    telemetry: list[Telemetry] = []

    def note(message: Telemetry) -> None:
        telemetry.append(message)
        react(message)

    def report(message: Telemetry) -> None:
        attendant.tell([message])
        attendant.pass_orders()

    with Keyboard() as keyboard:
        attendant = Attendant(orders.give, keyboard, note, more_orders)
        pilot = Pilot(
            mission,
            connect=lambda _: connect(lab, report),
            source=SteppedPoses(lab, mission.limits.pose),
            report=report,
            orders=orders,
            proposals=proposals,
            conductor=conductor,
            clock=lab.clock,
        )
        last: FlightOutcome | CfplanError
        try:
            last = pilot.fly()
        except CfplanError as error:
            last = error
        return Flight(attendant.conclude(last), telemetry, lab.truth())
