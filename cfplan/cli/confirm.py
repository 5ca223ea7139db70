"""The confirmation prompt before hardware flies."""

import json
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cfplan.errors import ExitCode, InputError
from cfplan.numbers import shown
from cfplan.safety.space import inside
from cfplan.steering.starting_vehicle import SIMULATED

if TYPE_CHECKING:
    from collections.abc import Mapping

    from cfplan.cli.recorded_flight import Prepared

FIRST_SPEED = 0.3  # speed factor at which a path should be flown first


def confirmed(prepared: "Mapping[str, Prepared]", name: str, records: Path, *, yes: bool) -> bool:
    """Return whether to fly: always for virtual vehicles or with --yes, otherwise as the user answers.

    `prepared` has the flight of each vehicle by its URI. Raises InputError if standard input is not a terminal.
    """
    if yes or all(uri.startswith(SIMULATED) for uri in prepared):
        return True
    for uri, each in prepared.items():
        click.echo(describe(each, uri), err=True)
    fast = any(each.planned.plan.speed_factor > FIRST_SPEED for each in prepared.values())
    if fast and not flown_before(name, records):
        click.echo(
            f"No flight of {name!r} on hardware is in {records}: fly it with --speed {FIRST_SPEED} first.", err=True
        )
    if not sys.stdin.isatty():
        raise InputError("not a terminal: cannot ask for confirmation", where=", ".join(prepared), hint="--yes")
    if click.confirm("Fly?", err=True):
        return True
    click.echo("not flown", err=True)
    return False


def describe(prepared: "Prepared", uri: str) -> str:
    """Describe how long, how fast and where the vehicle will fly, how to end the flight, and where link loss would."""
    import numpy as np

    from cfplan.flight.setpoints.packets import decode

    mission, lost = prepared.mission, prepared.link_loss
    speed = float(np.linalg.norm(decode(mission.payloads).velocity, axis=1).max())
    space = mission.limits.space
    walls = ", ".join(
        f"{axis} {shown(low, '.2f')} to {shown(high, '.2f')} m"
        for axis, low, high in zip("xyz", space.low, space.high, strict=True)
    )
    remedy = "a lower --speed" if mission.limits.firmware.watchdog else "a lower --speed, or firmware.watchdog,"
    advice = f" With {remedy} it would not come so far." if not inside(lost.beyond) else ""
    alone, lasts = "it stops its motors by itself", prepared.planned.duration
    if mission.on_board is not None:
        lasts = mission.motion_ends
        alone = "it flies on for a second, blind; then its watchdog stops its motors"
    return (
        f"{uri} will take off to {mission.take_off_height:g} m, go to the start of {prepared.planned.name!r}, fly it "
        f"in {lasts:.1f} s at up to {speed:.1f} m/s, and land where it ends.\n"
        f"Keep everybody out of {walls}. Space lands it, Esc cuts the motors.\n"
        f"If the pilot's process or the radio dies, {alone}: {lost}.{advice}"
    )


def flown_before(name: str, records: Path) -> bool:
    """Return whether there is a record of a complete flight on hardware along a path of this name."""
    from cfplan.recording.record import SUMMARY_FILE

    for file in [*records.glob(f"*/{SUMMARY_FILE}"), *records.glob(f"*/*/{SUMMARY_FILE}")]:  # the latter of a fleet
        flight = file.relative_to(records).parts[0]
        if not re.search(rf"-{re.escape(name)}(-\d+)?$", flight):
            continue
        try:
            summary = json.loads(file.read_text(encoding="utf-8"))
            flown = summary["outcome"]["exit_code"] == ExitCode.OK and not summary["uri"].startswith(SIMULATED)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue
        if flown:
            return True
    return False
