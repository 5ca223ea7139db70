"""`cfplan fly` on a fleet file: plan, certify and rehearse all vehicles, fly them together, and record each."""

import contextlib
import math
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from cfplan.cli import options
from cfplan.cli.confirm import confirmed
from cfplan.cli.output import Steps, print_json, print_table, styled
from cfplan.errors import CfplanError, ExitCode, printable
from cfplan.flight.fleet.fly_together import FleetOutcome
from cfplan.flight.telemetry import Event, Level, Phase, PhaseEntered, Telemetry
from cfplan.planning.fleet.fleet_file import load_fleet_file
from cfplan.steering.connected_fleet import ConnectedFleet
from cfplan.steering.fleet_addresses import fleet_addresses, look_at_fleet

_SHOWN = (Phase.ARM, Phase.TAKE_OFF, Phase.STREAM, Phase.LAND)


def fly_fleet(
    file: Path,
    safety_file: Path | None,
    mocap: str | None,
    records: Path,
    planning: dict[str, Any],
    steps: Steps,
    *,
    on_board: bool,
    yes: bool,
) -> int:
    """Fly a fleet; return its exit code. Raises a CfplanError where nothing flies."""
    fleet_file = load_fleet_file(file)
    addresses = fleet_addresses(fleet_file, mocap, on_board=on_board)
    limits = options.read_limits(safety_file, file, steps, compiled=True)
    look_at_fleet(addresses, limits.pose, steps, on_board=on_board)
    choices = options.flight_options(planning, safety_file, file)
    shown = _Shown(steps)
    with ConnectedFleet(
        fleet_file, addresses, limits, choices, on_board=on_board, records=records, on_step=steps, listen=shown.show
    ) as fleet:
        prepared = {each.address.uri: each.prepared for each in fleet.vehicles}
        if not confirmed(prepared, fleet.plan.name, records, yes=yes):
            return int(ExitCode.ENDED_BY_OPERATOR)
        with contextlib.suppress(CfplanError):  # the outcome has the reason
            fleet.take_off()
            fleet.finish()
    outcome = fleet.outcome
    if outcome is None:
        raise fleet.failure or CfplanError("there was no flight", where="flight", hint="see the lines above")
    _report(fleet, outcome, steps)
    return int(outcome.exit_code)


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


def _report(fleet: ConnectedFleet, outcome: FleetOutcome, steps: Steps) -> None:
    """Print how the flight ended, per vehicle and together."""
    rows, folder = list(_rows(fleet, outcome)), fleet.record
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


def _rows(fleet: ConnectedFleet, outcome: FleetOutcome) -> Iterator[tuple[str, int, str, float, float, float]]:
    """Yield name, exit code, reason, lateness of the start, s, largest deviation, m, and lateness, s."""
    for vehicle in fleet.vehicles:
        end, flown = outcome.ends[vehicle.name], outcome.outcomes.get(vehicle.name)
        late = math.nan
        if flown is not None and flown.first_setpoint:
            late = flown.first_setpoint - outcome.begins - vehicle.member.delay
        off = fleet.summary.get(vehicle.name, {}).get("max_deviation")
        lateness = flown.lateness.p99 if flown else math.nan
        yield vehicle.name, int(end.exit_code), end.reason, late, math.nan if off is None else off, lateness


def _text(value: float, scale: float, unit: str) -> str:
    return f"{scale * value:.2f} {unit}" if math.isfinite(value) else "–"
