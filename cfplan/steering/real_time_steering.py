"""A steered flight in real time: by the pilot's and the planner's processes, served by threads of this one."""

import contextlib
import sys
import threading
import types
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence

from cfplan.air.process import AirPlanner
from cfplan.air.requests import Wish
from cfplan.air.timeline import Timeline
from cfplan.errors import CfplanError
from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.mocap.poses import PoseSource
from cfplan.flight.pilot.keys import Keyboard, Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import FlightOutcome
from cfplan.flight.pilot.process import fly
from cfplan.flight.telemetry import Telemetry, Triple
from cfplan.preparation.steps import OnStep
from cfplan.safety.limits import Limits
from cfplan.steering.flight_in_progress import Listeners
from cfplan.steering.starting_vehicle import StartingVehicle
from cfplan.vehicle.rotations import yaw_of

_LISTEN_PERIOD = 0.05  # s
_LANDING = 120.0  # s, longest landing
_PLANNER_STARTS = 60.0  # s, longest start of its process, with compiling


class RealTimeSteering:
    """A flight by processes; a FlightInProgress. Make it in the main thread, so that Ctrl-C lands."""

    clock = REAL_CLOCK

    def __init__(
        self,
        uri: str,
        mocap_uri: str | None,
        limits: Limits,
        on_step: OnStep,
        *,
        keys: bool,
        more_orders: Callable[[], Iterable[Order]] = tuple,
    ):
        """Start the pilot's process, and a virtual vehicle's lab. `keys`: read keys of the terminal.

        Raises a CfplanError if vehicle or poses are not available.
        """
        self.outcome: FlightOutcome | CfplanError | None = None
        self._open = contextlib.ExitStack()
        self._change = threading.Condition()
        self._orders: deque[Order] = deque()
        self._more_orders = more_orders
        self._abandoned = False  # the program's main thread has ended, and the vehicle was told to land
        self._fault: BaseException | None = None  # in the thread that listens to the planner
        self.planner: AirPlanner | None = None
        self._thread: threading.Thread | None = None
        try:
            with main_module_hidden():
                self._vehicle = self._open.enter_context(StartingVehicle(uri, mocap_uri, limits))
            self._source: PoseSource = self._vehicle.poses(on_step)
            self._keyboard = self._open.enter_context(Keyboard(keys=keys))
        except BaseException:
            self._open.close()
            raise

    def first_pose(self) -> tuple[Triple, float]:
        try:
            self._source.open()
            pose = self._source.poses()[-1]
        finally:
            self._source.close()
        return pose.position, yaw_of(pose.quaternion)

    def start(self, mission: Mission, timeline: Timeline, listeners: Listeners) -> None:
        with main_module_hidden():
            self.planner = self._open.enter_context(AirPlanner(timeline, mission.limits, self._vehicle.pilot.proposals))
        self._thread = threading.Thread(target=self._fly, args=(mission, listeners), name="flight")
        self._thread.start()
        threading.Thread(target=self._hear_planner, args=(listeners,), name="planner's answers", daemon=True).start()
        self.wait(lambda: self.planner is not None and self.planner.ready, _PLANNER_STARTS)

    def _fly(self, mission: Mission, listeners: Listeners) -> None:
        def tell(message: Telemetry) -> None:
            with self._change:
                listeners.telemetry(message)
                self._change.notify_all()

        outcome: FlightOutcome | CfplanError
        try:
            outcome = fly(
                mission,
                uri=self._vehicle.uri,
                pose_source=self._source,
                pilot=self._vehicle.pilot,
                on_telemetry=tell,
                more_orders=self._next_orders,
                keyboard=self._keyboard,
            )
        except CfplanError as error:
            outcome = error
        except BaseException as error:  # a fault of a listener, which has landed the vehicle
            outcome = _fault(error)
        if self._fault is not None and not isinstance(outcome, CfplanError):
            outcome = _fault(self._fault)
        with self._change:
            self.outcome = outcome
            self._change.notify_all()

    def _hear_planner(self, listeners: Listeners) -> None:
        """Pass the planner's answers on until the flight has ended; a fault here lands the vehicle."""
        try:
            self._listen(listeners)
        except BaseException as error:
            self._fault = error
            self.order(Order.LAND)

    def _listen(self, listeners: Listeners) -> None:
        """Pass the planner's answers to the listeners until the flight has ended."""
        planner = self.planner
        assert planner is not None
        while self.outcome is None:
            answers = planner.answers(_LISTEN_PERIOD)
            with self._change:
                for answer in answers:
                    listeners.answer(answer)
                self._change.notify_all()
            if not planner.alive:  # `answers` returns at once then
                REAL_CLOCK.sleep(_LISTEN_PERIOD)

    def _next_orders(self) -> Iterator[Order]:
        if not self._abandoned and not threading.main_thread().is_alive():
            self._abandoned = True
            yield Order.LAND
        while self._orders:
            yield self._orders.popleft()
        yield from self._more_orders()

    def ask(self, wish: Wish, waypoints: Sequence[Triple]) -> int:
        assert self.planner is not None
        return self.planner.request(wish, waypoints)

    def order(self, order: Order) -> None:
        self._orders.append(order)

    def typed(self) -> list[str]:
        return self._keyboard.typed()

    def wait(self, done: Callable[[], bool], patience: float) -> bool:
        with self._change:
            self._change.wait_for(lambda: done() or self.outcome is not None, timeout=patience)
            return done()

    def close(self) -> None:
        if self._thread is not None:
            if self.outcome is None:
                self.order(Order.LAND)
            self._thread.join(_LANDING)
        self._open.close()


def _fault(error: BaseException) -> CfplanError:
    return CfplanError(f"fault in the flight: {error!r}", hint="please report this")


@contextlib.contextmanager
def main_module_hidden() -> Iterator[None]:
    """Start processes without the program's own module in them: else they would run it again, and steer too.

    This concerns programs without `if __name__ == "__main__"`.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
