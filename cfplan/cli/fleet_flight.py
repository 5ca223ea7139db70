"""`cfplan fly` on a fleet file: plan, certify and rehearse all vehicles, fly them together, and record each."""

import math
import shlex
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json, print_table, styled
from cfplan.errors import ExitCode, InputError, printable
from cfplan.flight.fleet.conductor import ConductedFlight
from cfplan.flight.fleet.fly_together import FleetOutcome, FleetPilot, fly_together
from cfplan.flight.pilot.keys import Keyboard
from cfplan.flight.pilot.process import PilotProcess, start_pilot
from cfplan.flight.telemetry import Event, Level, Phase, PhaseEntered, Telemetry
from cfplan.planning.fleet.fleet_file import FleetFile, load_fleet_file
from cfplan.planning.fleet.members import FleetMember
from cfplan.planning.plan_file import save_plan
from cfplan.preparation.plan_fleet import PlannedFleet, plan_fleet, prepare_fleet
from cfplan.preparation.prepare_flight import PreparedFlight
from cfplan.recording.fleet_record import write_fleet_file
from cfplan.recording.header import header_of_plan
from cfplan.recording.reader import read_record
from cfplan.recording.record import PLAN_FILE
from cfplan.recording.summary import FlightSummary, summarise
from cfplan.recording.writer import RecordWriter, new_record_folder, wall_time_at_zero, write_summary
from cfplan.simulation.lab.sim_driver import SimDriver
from cfplan.steering.fleet_room import FleetRoom, VehiclePlace, virtual_addresses

_SHOWN = (Phase.ARM, Phase.TAKE_OFF, Phase.STREAM, Phase.LAND)


@dataclass(frozen=True, slots=True)
class _Vehicle:
    """A vehicle that is about to fly."""

    member: FleetMember
    prepared: PreparedFlight
    place: VehiclePlace
    source: Path  # its path file
    folder: Path  # of its record

    @property
    def name(self) -> str:
        return self.member.name


def fly_fleet(
    file: Path, safety_file: Path | None, records: Path, planning: dict[str, Any], steps: Steps
) -> int:  # fmt: skip
    """Fly a fleet of virtual vehicles; return its exit code. Raises a CfplanError where nothing flies."""
    fleet_file = load_fleet_file(file)
    addresses, bodies = virtual_addresses(fleet_file), _bodies(fleet_file)
    limits = options.read_limits(safety_file, file, steps, compiled=True)
    with ExitStack() as starting:
        pilots = {name: starting.enter_context(start_pilot([SimDriver])) for name in addresses}
        fleet = plan_fleet(fleet_file, limits, options.flight_options(planning, safety_file, file), steps)
        prepared = prepare_fleet(fleet, steps)
        folder = new_record_folder(records, fleet.name)
        vehicles = []
        for member, each, listed in zip(fleet.members, prepared, fleet_file.vehicles, strict=True):
            (x, y, _), yaw = each.mission.start
            place = VehiclePlace(addresses[member.name], bodies[member.name], (x, y), yaw)
            vehicles.append(
                _Vehicle(member, each, place, listed.path_file.source, new_record_folder(folder, member.name))
            )
        write_fleet_file(folder, fleet.name, fleet.apart, {vehicle.name: vehicle.folder for vehicle in vehicles})
        outcome = _fly(vehicles, fleet, pilots, steps)
    _report(vehicles, outcome, folder, _summarised(vehicles, outcome), steps)
    return int(outcome.exit_code)


def _bodies(fleet: FleetFile) -> dict[str, str]:
    """Return the body of each vehicle by its name: that of the file, or its own name."""
    found: dict[str, str] = {}
    for vehicle in fleet.vehicles:
        body = vehicle.body or vehicle.name
        if body in found.values():
            raise InputError(f"two vehicles have the body {body!r}", where=fleet.name, hint="give each its own")
        found[vehicle.name] = body
    return found


def _fly(vehicles: list[_Vehicle], fleet: PlannedFleet, pilots: dict[str, PilotProcess], steps: Steps) -> FleetOutcome:
    """Fly in a virtual room, and record each vehicle."""
    with ExitStack() as stack:
        with steps.step("lab") as results:
            room = stack.enter_context(FleetRoom([vehicle.place for vehicle in vehicles], fleet.limits))
            results.append(f"{len(vehicles)} virtual Crazyflies in one room")
        writers = {vehicle.name: stack.enter_context(_writer(vehicle)) for vehicle in vehicles}
        keyboard = stack.enter_context(Keyboard())
        shown = _Shown(steps)

        def listen(name: str, message: Telemetry) -> None:
            writers[name].write(message)
            shown.show(name, message)

        return fly_together(
            [
                FleetPilot(
                    ConductedFlight(vehicle.name, vehicle.prepared.mission.start[0], vehicle.member.delay),
                    vehicle.prepared.mission,
                    vehicle.place.uri,
                    room.poses(vehicle.place.body),
                    pilots[vehicle.name],
                )
                for vehicle in vehicles
            ],
            fleet.apart,
            listen=listen,
            keyboard=keyboard,
        )


def _writer(vehicle: _Vehicle) -> RecordWriter:
    """Return the writer of a vehicle's record, beside its plan."""
    plan, name = vehicle.prepared.plan, vehicle.name
    save_plan(plan, vehicle.folder / PLAN_FILE, {"name": name, "path file": str(vehicle.source)})
    header = header_of_plan(
        plan, name=name, uri=vehicle.place.uri, source=vehicle.source, wall_time_at_zero=wall_time_at_zero()
    )
    return RecordWriter(vehicle.folder, header)


class _Shown:
    """Prints a line where a vehicle enters a phase that people wait for, or warns."""

    def __init__(self, steps: Steps):
        self._steps, self._began = steps, math.nan

    def show(self, name: str, message: Telemetry) -> None:
        if isinstance(message, PhaseEntered) and message.phase in _SHOWN:
            self._say(message.time, name, str(message.phase))
        elif isinstance(message, Event) and message.level is not Level.INFO:
            self._say(message.time, name, printable(message.text))

    def _say(self, time: float, name: str, text: str) -> None:
        if math.isnan(self._began):
            self._began = time
        self._steps.print(f"  {time - self._began:6.2f} s  {name}: {text}")


def _summarised(vehicles: list[_Vehicle], outcome: FleetOutcome) -> dict[str, FlightSummary]:
    """Write the summary of each record of a pilot that ended in order; return them by name."""
    found = {}
    for vehicle in vehicles:
        flown = outcome.outcomes.get(vehicle.name)
        if flown is not None:
            found[vehicle.name] = summary = summarise(read_record(vehicle.folder))
            write_summary(
                vehicle.folder, {"uri": vehicle.place.uri, "outcome": flown.to_dict(), **summary.to_json()}
            )  # fmt: skip
    return found


def _report(
    vehicles: list[_Vehicle], outcome: FleetOutcome, folder: Path, summaries: dict[str, FlightSummary], steps: Steps
) -> None:
    """Print how the flight ended, per vehicle and together."""
    rows = list(_rows(vehicles, outcome, summaries))
    if steps.as_json:
        keys = ("vehicle", "exit_code", "reason", "start_late", "max_deviation", "lateness_p99")
        document = {"record": str(folder), "exit_code": int(outcome.exit_code), "brakes": outcome.brakes}
        nearest = {"nearest": outcome.nearest}
        print_json(document | nearest | {"vehicles": [dict(zip(keys, row, strict=True)) for row in rows]})
    else:
        columns = ["vehicle", "ended", "started late", "largest deviation", "lateness p99"]
        table = [
            [name, reason, _text(late, 1e3, "ms"), _text(off, 1e2, "cm"), _text(p99, 1e3, "ms")]
            for name, _, reason, late, off, p99 in rows
        ]
        print_table("Fleet", columns, table)
        click.echo(f"nearest, as measured: {_text(outcome.nearest, 1.0, 'm')} between columns")
        click.echo(f"records: {folder}")
        click.echo(f"replay: cfplan replay {shlex.quote(str(folder))}")
    if outcome.exit_code is not ExitCode.OK:
        click.echo(f"{styled('error:', 'red')} {outcome.brakes}", err=True)


def _rows(
    vehicles: list[_Vehicle], outcome: FleetOutcome, summaries: dict[str, FlightSummary]
) -> Iterator[tuple[str, int, str, float, float, float]]:
    """Yield name, exit code, reason, lateness of the start, s, largest deviation, m, and lateness, s."""
    for vehicle in vehicles:
        end, flown, summary = (
            outcome.ends[vehicle.name],
            outcome.outcomes.get(vehicle.name),
            summaries.get(vehicle.name),
        )
        late = math.nan
        if flown is not None and flown.first_setpoint:
            late = flown.first_setpoint - outcome.begins - vehicle.member.delay
        off = summary.max_deviation if summary is not None else math.nan
        yield vehicle.name, int(end.exit_code), end.reason, late, off, flown.lateness.p99 if flown else math.nan


def _text(value: float, scale: float, unit: str) -> str:
    return f"{scale * value:.2f} {unit}" if math.isfinite(value) else "–"
