"""A fleet that a program flies: take off, begin all paths at one time, land.

The paths stand in the fleet file. They are planned, certified to keep apart and rehearsed before anything takes off,
and none changes in the air: a new path would have to be certified against all others.
"""

import math
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

from cfplan.errors import (
    CfplanError,
    ExitCode,
    FlightEndedError,
    InputError,
    LinkError,
    PreflightError,
    RequestRefusedError,
)
from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.fleet.conductor import ConductedFlight, Conductor
from cfplan.flight.fleet.dongle_process import SharedDongles
from cfplan.flight.fleet.fly_together import FleetOutcome, FleetPilot, Listen, fly_together
from cfplan.flight.mocap.poses import PoseSource
from cfplan.flight.mocap.source import pose_source
from cfplan.flight.pilot.keys import Keyboard, Order
from cfplan.flight.pilot.process import PilotProcess, start_pilot
from cfplan.flight.telemetry import Telemetry, Triple
from cfplan.planning.fleet.fleet_file import FleetFile, load_fleet_file
from cfplan.planning.fleet.members import FleetMember
from cfplan.planning.plan_file import save_plan
from cfplan.preparation.on_board_fleet import prepare_fleet_on_board
from cfplan.preparation.on_board_flight import PreparedOnBoard
from cfplan.preparation.plan_fleet import PlannedFleet, plan_fleet, prepare_fleet
from cfplan.preparation.plan_flight import FlightOptions
from cfplan.preparation.prepare_flight import PreparedFlight
from cfplan.preparation.steps import OnStep, ignore_steps, step
from cfplan.recording.fleet_record import write_fleet_file
from cfplan.recording.header import FLOWN, header_of_plan
from cfplan.recording.reader import read_record
from cfplan.recording.record import PLAN_FILE
from cfplan.recording.summary import summarise
from cfplan.recording.writer import RecordWriter, new_record_folder, wall_time_at_zero, write_summary
from cfplan.safety.limits import Limits
from cfplan.simulation.lab.sim_driver import SimDriver
from cfplan.steering.connect import RECORDS, find_limits
from cfplan.steering.fleet_addresses import VehicleAddress, fleet_addresses, look_at_fleet
from cfplan.steering.fleet_room import FleetRoom, VehiclePlace
from cfplan.steering.real_time_steering import main_module_hidden

_Prepare = Callable[..., tuple[PlannedFleet, tuple[PreparedFlight | PreparedOnBoard, ...]]]
_LOOK_PERIOD = 0.02  # s between checks of an awaited condition
_TAKE_OFF_TIMEOUT = 240.0  # s; vehicles take off one after another
_LAND_TIMEOUT = 120.0  # s


@dataclass(frozen=True, slots=True)
class ReadyVehicle:
    """A vehicle that is about to fly."""

    member: FleetMember
    prepared: PreparedFlight | PreparedOnBoard
    address: VehicleAddress
    source: Path  # its path file

    @property
    def name(self) -> str:
        return self.member.name

    @property
    def place(self) -> VehiclePlace:
        """Return where it stands in a virtual room."""
        (x, y, _), yaw = self.prepared.mission.start
        return VehiclePlace(self.address.uri, self.address.body, (x, y), yaw)


class ConnectedFleet:
    """One flight of a fleet; a context manager that lands and disarms all vehicles at its end.

    `cfplan.connect_fleet` makes it. Its methods raise a FlightEndedError once the flight has ended by anything but
    `land` or the ends of the paths; the error has the reason.
    """

    def __init__(
        self,
        fleet: FleetFile,
        addresses: dict[str, VehicleAddress],
        limits: Limits,
        options: FlightOptions | None = None,
        *,
        on_board: bool = False,
        records: Path | None = None,
        keys: bool = True,
        on_step: OnStep = ignore_steps,
        listen: Listen = lambda name, message: None,
    ):
        """Plan, certify and rehearse a fleet, and start its pilots, and its room if it is virtual.

        Args:
            fleet: the paths, and how far vehicles keep apart.
            addresses: of each vehicle, by its name.
            limits: that every vehicle keeps.
            options: of planning.
            on_board: whether each vehicle flies an uploaded trajectory by its own commander.
            records: the folder in which a folder with the flight's records is written; None writes none.
            keys: whether keys of the terminal count.
            on_step: hears of the steps of preparing.
            listen: hears the telemetry of each vehicle in flight, with the vehicle's name, in another thread.

        Raises a CfplanError if the fleet is not certified, or a virtual room does not start.
        """
        self._records, self._keys, self._listen = records, keys, listen
        self._open = ExitStack()
        self._orders: deque[Order] = deque()
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()
        self.failure: CfplanError | None = None  # why there is no outcome, once the flight is over
        self._closed = False
        self.outcome: FleetOutcome | None = None  # how the flight ended; None until then
        self.record: Path | None = None  # the folder with a record per vehicle; None before take-off, or if none
        self.summary: dict[str, dict[str, Any]] = {}  # figures of `cfplan report` by vehicle, once the flight is over
        try:
            self._pilots = self._start_pilots(addresses)
            prepare: _Prepare = prepare_fleet_on_board if on_board else _prepare_streamed
            self.plan, prepared = prepare(fleet, limits, options, on_step)
            self.vehicles = tuple(
                ReadyVehicle(member, each, addresses[member.name], listed.path_file.source)
                for member, each, listed in zip(self.plan.members, prepared, fleet.vehicles, strict=True)
            )
            self._poses = self._pose_sources(on_step)
        except BaseException:
            self._open.close()
            raise
        flights = [
            ConductedFlight(each.name, each.prepared.mission.start[0], each.member.delay) for each in self.vehicles
        ]
        self._conductor = Conductor(flights, self.plan.apart, self.plan.skew, holds=True)

    def _start_pilots(self, addresses: dict[str, VehicleAddress]) -> dict[str, PilotProcess]:
        """Start the processes of shared dongles and then the pilots, so that the dongles' processes end last."""
        shared = {name: address.uri for name, address in addresses.items() if address.dongle}
        with main_module_hidden():
            dongles = self._open.enter_context(SharedDongles(shared))
            pilots = {}
            for name, address in addresses.items():
                drivers = dongles.drivers(name) if address.dongle else [SimDriver] if address.virtual else []
                pilots[name] = self._open.enter_context(start_pilot(drivers))
            dongles.hand_over()
        return pilots

    def _pose_sources(self, on_step: OnStep) -> dict[str, PoseSource]:
        """Return the poses of each vehicle, after starting the room of virtual ones."""
        limits = self.plan.limits
        if not self.vehicles[0].address.virtual:
            return {each.name: pose_source(each.address.mocap, limits.pose) for each in self.vehicles}
        with step(on_step, "lab") as results:
            room = self._open.enter_context(FleetRoom([each.place for each in self.vehicles], limits))
            results.append(f"{len(self.vehicles)} virtual Crazyflies in one room")
        return {each.name: room.poses(each.address.body) for each in self.vehicles}

    # State.

    @property
    def positions(self) -> dict[str, Triple]:
        """Return where each vehicle was seen last, m, by its name; without those that were not seen yet."""
        seen = {each.name: self._conductor.position(each.name) for each in self.vehicles}
        return {name: position for name, position in seen.items() if position is not None}

    @property
    def time(self) -> float:
        """Return the time, s, on the flight's clock, whose zero is arbitrary."""
        return REAL_CLOCK.now()

    @property
    def begun(self) -> bool:
        """Return whether `fly` has begun the paths."""
        return not self._conductor.holds

    # The flight.

    def take_off(self) -> None:
        """Check all vehicles, arm them, let them take off one after another, and return once all hover at their starts.

        Raises a CfplanError if one cannot take off: a check failed, it does not stand under its start, or it has no
        link or no poses. None was armed then, unless the reason came later; all are down and disarmed in any case.
        """
        if self._thread is not None:
            raise InputError("it has taken off already", where="take_off", hint="connect again for another flight")
        keyboard = self._open.enter_context(Keyboard(keys=self._keys))
        writers = self._start_records()
        self._thread = threading.Thread(target=self._run, args=(keyboard, writers), name="fleet")
        self._thread.start()
        if not self._wait_for(lambda: self._conductor.ready, _TAKE_OFF_TIMEOUT):
            self._require_flying()
            self._end(Order.LAND, _LAND_TIMEOUT)
            raise PreflightError(
                f"not all hovered within {_TAKE_OFF_TIMEOUT:.0f} s, and all were landed",
                where=self.plan.name,
                hint="see the records' events",
            )

    def fly(self, *waypoints: object) -> None:
        """Begin all paths at one time, and return at once; each vehicle lands at its end.

        Raises RequestRefusedError for waypoints.
        """
        if waypoints:
            self.replace()
        self._require_flying()
        self._conductor.holds = False

    def replace(self, *request: object) -> NoReturn:
        """Raise RequestRefusedError: no path of a fleet changes in the air. So do all methods that would change one."""
        raise RequestRefusedError(
            "planning in the air is for one vehicle; a fleet flies the certified paths of its fleet file",
            where=self.plan.name,
            hint="write paths in the fleet file, and call land() to end the flight; cfplan.connect steers one vehicle",
        )

    extend = stop = slower = faster = ask = request = replace

    def wait(self, patience: float = math.inf) -> bool:
        """Wait until all vehicles are down, for at most `patience`, s; return whether they are."""
        self._require_started()
        ended = self._wait_for(self._ended.is_set, patience)
        if ended:
            self._require_good_end()
        return ended

    def sleep(self, duration: float) -> None:
        """Let `duration`, s, of the flight pass."""
        self._require_flying()
        self._wait_for(lambda: False, duration)
        self._require_flying()

    def land(self) -> None:
        """Let all vehicles brake along their paths, land and disarm, and return when that is done.

        Raises a FlightEndedError if a safety rule or a fault of one vehicle ended the flight instead.
        """
        self._end(Order.LAND, _LAND_TIMEOUT)
        self._require_good_end()

    def finish(self) -> None:
        """Fly the paths to their ends, land, disarm, and return. Raises like `land`."""
        if self._thread is not None and not self._ended.is_set():
            self.fly()
            self._wait_for(lambda: False, self.plan.end + _LAND_TIMEOUT)
        self.land()

    def cut(self) -> None:
        """Cut all motors at once, at any height: the vehicles fall."""
        self._end(Order.CUT, _LAND_TIMEOUT)

    def close(self) -> None:
        """Land the vehicles that fly, release them, and end their records. May be called twice; does not raise."""
        if self._closed:
            return
        self._closed = True
        if self._thread is not None:
            if not self._ended.is_set():
                self._orders.append(Order.LAND)
            self._thread.join(_LAND_TIMEOUT)
        self._open.close()

    def __enter__(self) -> "ConnectedFleet":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None and self._thread is not None and not self._ended.is_set():
                self.finish() if self.begun else self.land()
        finally:
            self.close()

    # Internal.

    def _start_records(self) -> dict[str, RecordWriter]:
        """Make the folder of the flight and a record in it for each vehicle; return their writers."""
        if self._records is None:
            return {}
        self.record = folder = new_record_folder(self._records, self.plan.name)
        folders = {each.name: new_record_folder(folder, each.name) for each in self.vehicles}
        write_fleet_file(folder, self.plan.name, self.plan.apart, folders)
        return {each.name: self._open.enter_context(_writer(each, folders[each.name])) for each in self.vehicles}

    def _run(self, keyboard: Keyboard, writers: dict[str, RecordWriter]) -> None:
        """Fly, in a thread, from preflight until all are down."""

        def listen(name: str, message: Telemetry) -> None:
            if name in writers:
                writers[name].write(message)
            self._listen(name, message)

        pilots = [
            FleetPilot(
                flight, each.prepared.mission, each.address.pilot_uri, self._poses[each.name], self._pilots[each.name]
            )
            for flight, each in zip(self._conductor.flights, self.vehicles, strict=True)
        ]
        try:
            self.outcome = fly_together(
                pilots, self._conductor, listen=listen, keyboard=keyboard, more_orders=self._next_orders
            )
            self._summarise(writers)
        except CfplanError as error:
            self.failure = error
        except BaseException as error:  # a fault of a listener, after which all have landed
            self.failure = CfplanError(f"fault in the flight: {error!r}", hint="please report this")
        finally:
            self._ended.set()

    def _summarise(self, writers: dict[str, RecordWriter]) -> None:
        """End the records, and write the summary of each vehicle whose pilot ended in order."""
        assert self.outcome is not None
        for each in self.vehicles:
            if each.name not in writers:
                continue
            writers[each.name].close()
            flown = self.outcome.outcomes.get(each.name)
            if flown is not None:
                folder = writers[each.name].folder
                self.summary[each.name] = summary = summarise(read_record(folder)).to_json()
                write_summary(folder, {"uri": each.address.uri, "outcome": flown.to_dict(), **summary})

    def _next_orders(self) -> Iterator[Order]:
        while self._orders:
            yield self._orders.popleft()

    def _wait_for(self, done: Callable[[], bool], patience: float) -> bool:
        """Wait until `done` or the end of the flight, at most for `patience`, s; return whether it is done."""
        until = REAL_CLOCK.now() + patience
        while not done() and not self._ended.is_set() and REAL_CLOCK.now() < until:
            REAL_CLOCK.wait(self._ended, _LOOK_PERIOD)
        return done()

    def _end(self, order: Order, patience: float) -> None:
        """Give an order that ends the flight, and wait until it has ended. Raises LinkError if it does not."""
        if self._thread is not None and not self._ended.is_set():
            self._orders.append(order)
            self._wait_for(self._ended.is_set, patience)
            if not self._ended.is_set():
                raise LinkError(
                    f"the flight has not ended {patience:.0f} s after the order to",
                    where=self.plan.name,
                    hint="keep away from the vehicles until they lie still",
                )

    def _require_started(self) -> None:
        if self._thread is None:
            raise InputError("it has not taken off", where="fleet", hint="call take_off() first")

    def _require_flying(self) -> None:
        self._require_started()
        if self._ended.is_set():
            raise self.failure or self._end_as_error()

    def _require_good_end(self) -> None:
        """Raise unless the flight ended as its paths or the operator had it, or there was none."""
        if self.failure is not None:
            raise self.failure
        good = (ExitCode.OK, ExitCode.ENDED_BY_OPERATOR)
        if self.outcome is not None and self.outcome.exit_code not in good:
            raise self._end_as_error()

    def _end_as_error(self) -> FlightEndedError:
        assert self.outcome is not None
        return FlightEndedError(
            self.outcome.brakes or "all vehicles have landed",
            where="fleet",
            hint="connect again for another flight; the records tell what happened",
            exit_code=self.outcome.exit_code,
        )


def connect_fleet(
    fleet: Path | str,
    *,
    mocap: str | None = None,
    on_board: bool = False,
    safety: Limits | Path | str | None = None,
    records: Path | str | None = RECORDS,
    speed_factor: float | None = None,
    keys: bool = True,
    on_step: OnStep = ignore_steps,
) -> ConnectedFleet:
    """Plan, certify and rehearse a fleet, connect to it and return it, on the ground; use it in a `with` block.

    Args:
        fleet: the fleet file.
        mocap: the motion capture system that sees all vehicles, as vicon://192.168.1.2; virtual ones have poses
            already.
        on_board: whether each vehicle flies an uploaded trajectory by its own commander, so that only poses are
            streamed.
        safety: the limits, or the file with them; else the nearest safety.yaml in or above the working folder.
        records: the folder in which the flight's records are written, as a new folder; None writes none.
        speed_factor: of the speed that the limits allow, above 0 and at most 1; None takes each path's own.
        keys: whether keys of the terminal count: space lands all, Esc cuts all motors. Ctrl-C lands, twice cuts,
            anyway.
        on_step: hears of the steps of preparing.

    Raises a CfplanError, with place and hint, if a file or an argument is wrong, the fleet is not certified, or a
    dongle or a body is missing.
    """
    file = load_fleet_file(Path(fleet))
    addresses, limits = fleet_addresses(file, mocap, on_board=on_board), find_limits(safety)
    look_at_fleet(addresses, limits.pose, on_step, on_board=on_board)
    folder = Path(records) if records is not None else None
    options = FlightOptions(speed_factor=speed_factor)
    return ConnectedFleet(
        file, addresses, limits, options, on_board=on_board, records=folder, keys=keys, on_step=on_step
    )


def _prepare_streamed(
    fleet: FleetFile, limits: Limits, options: FlightOptions | None, on_step: OnStep
) -> tuple[PlannedFleet, tuple[PreparedFlight, ...]]:
    planned = plan_fleet(fleet, limits, options, on_step)
    return planned, prepare_fleet(planned, on_step)


def _writer(vehicle: ReadyVehicle, folder: Path) -> RecordWriter:
    """Return the writer of a vehicle's record, beside its plan."""
    plan, name = vehicle.prepared.plan, vehicle.name
    save_plan(plan, folder / PLAN_FILE, {"name": name, "path file": str(vehicle.source)})
    header = header_of_plan(
        plan, name=name, uri=vehicle.address.uri, source=vehicle.source, wall_time_at_zero=wall_time_at_zero()
    )
    if vehicle.prepared.mission.on_board is not None:
        header = replace(header, provenance={**header.provenance, FLOWN: "on board"})
    return RecordWriter(folder, header)
