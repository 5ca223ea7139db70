"""A steered flight on a stepped clock: the virtual vehicle, whose time passes only while the program waits.

The pilot's code runs in a thread that takes turns with the program's: the other one stands still. So a program
flies the same on every run, however fast the computer is, and minutes of flight take seconds.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence

from cfplan.air.requests import PathAnswer, Wish
from cfplan.air.stepped import PLANNING, SteppedPlanner
from cfplan.air.timeline import Timeline
from cfplan.errors import CfplanError
from cfplan.flight.pilot.keys import HeldOrders, Keyboard, Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import FlightOutcome
from cfplan.flight.pilot.pilot import Pilot
from cfplan.flight.pilot.process import Attendant
from cfplan.flight.telemetry import Telemetry, Triple
from cfplan.safety.limits import Limits
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.lab.stepped_link import SteppedPoses, connect
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.steering.flight_in_progress import Listeners
from cfplan.vehicle.rotations import yaw_of

_LANDING = 120.0  # s, longest landing


class SteppedSteering:
    """A flight in the stepped lab; a FlightInProgress."""

    def __init__(
        self,
        limits: Limits,
        *,
        planning: float = PLANNING,
        seed: int = 0,
        vehicle: VehicleSettings | None = None,
        more_orders: Callable[[], Iterable[Order]] = tuple,
    ):
        """Stand on the lab's floor. A plan takes `planning`, s. `more_orders` is called at every step of the flight."""
        self.lab = SteppedLab(limits.airframe, seed=seed, vehicle=vehicle)
        self.clock = self.lab.clock
        self.outcome: FlightOutcome | CfplanError | None = None
        self.planner: SteppedPlanner | None = None
        self._limits, self._planning, self._more_orders = limits, planning, more_orders
        self._orders, self._asked_orders = HeldOrders(), deque[Order]()
        self._answers: list[PathAnswer] = []
        self._ours, self._theirs = threading.Semaphore(0), threading.Semaphore(0)
        self._done: Callable[[], bool] = bool
        self._until = self.clock.now()
        self._thread: threading.Thread | None = None

    def first_pose(self) -> tuple[Triple, float]:
        x, y, z, *_, qx, qy, qz, qw = self.lab.vehicle.truth.tolist()[:10]
        return (x, y, z), yaw_of((qx, qy, qz, qw))

    def start(self, mission: Mission, timeline: Timeline, listeners: Listeners) -> None:
        self.planner = SteppedPlanner(timeline, mission.limits, self.clock, listeners.answer, planning=self._planning)
        attendant = Attendant(self._orders.give, Keyboard(), listeners.telemetry, self._next_orders)

        def report(message: Telemetry) -> None:
            attendant.tell([message])
            attendant.pass_orders()
            if self.clock.now() >= self._until or self._done():
                self._ours.release()
                self._theirs.acquire()

        pilot = Pilot(
            mission,
            connect=lambda _: connect(self.lab, report),
            source=SteppedPoses(self.lab, mission.limits.pose),
            report=report,
            orders=self._orders,
            proposals=self.planner,
            clock=self.clock,
        )
        self._thread = threading.Thread(target=self._fly, args=(pilot, attendant), name="stepped pilot", daemon=True)
        self._until = self.clock.now()
        self._thread.start()  # it waits for its turn

    def _fly(self, pilot: Pilot, attendant: Attendant) -> None:
        self._theirs.acquire()
        try:
            self.outcome = attendant.conclude(pilot.fly())
        except CfplanError as error:
            self.outcome = error
        except BaseException as error:  # a fault of a listener, which has landed the vehicle, or of the pilot
            self.outcome = CfplanError(f"fault in the flight: {error!r}", hint="please report this")
        finally:
            self._ours.release()

    def _next_orders(self) -> Iterator[Order]:
        while self._asked_orders:
            yield self._asked_orders.popleft()
        yield from self._more_orders()

    def ask(self, wish: Wish, waypoints: Sequence[Triple]) -> int:
        assert self.planner is not None
        return self.planner.request(wish, waypoints)

    def order(self, order: Order) -> None:
        self._asked_orders.append(order)

    def typed(self) -> list[str]:
        return []  # its clock runs only while the program waits

    def wait(self, done: Callable[[], bool], patience: float) -> bool:
        if self._thread is None or self.outcome is not None or done() or patience <= 0.0:
            return done()
        self._done, self._until = done, self.clock.now() + patience
        self._theirs.release()
        self._ours.acquire()
        return done()

    def close(self) -> None:
        if self._thread is not None and self.outcome is None:
            self.order(Order.LAND)
            self.wait(lambda: False, _LANDING)
