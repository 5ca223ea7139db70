"""Simulate where the vehicle comes down after link loss at the worst moment along each PATH, by speed and watchdog."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from cfplan.flight.setpoints.encoding import LEAD, command_quaternion, motion_at
from cfplan.flight.setpoints.packets import FullStateSetpoints, encode
from cfplan.preparation.plan_flight import FlightOptions, PlannedFlight, plan_flight
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.simulation.link_loss import LinkLoss, link_loss_at_every_setpoint, simulate_link_loss
from studies.runner.limits import limits_for
from studies.runner.options import argument, option
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work


@dataclass(frozen=True, slots=True)
class Settings:
    """The paths to fly, and how fast."""

    path_files: tuple[Path, ...] = argument()
    speeds: tuple[float, ...] = option((1.0, 0.6, 0.3), "Factor on the speed that the limits allow.")


COLUMNS = (
    Column("path", "path"),
    Column("speed_factor", "speed", "", "g", meaning="factor on the speed that the limits allow, as by `--speed`"),
    Column("moment", "worst moment", "s", ".1f", meaning="to lose the link, from the first setpoint"),
    Column("rates_beyond", "beyond the walls, rates sent as rates", "m", ".1f",
           meaning="from the worst moment of the same plan, had its setpoints the planned body rates in them"),
    Column("distance", "comes down", "m", ".1f", meaning="horizontally from the last setpoint, from the worst moment"),
    Column("beyond", "beyond the walls", "m", ".1f", meaning="negative inside"),
    Column("alone_distance", "without watchdog: comes down", "m", ".1f"),
    Column("alone_beyond", "without watchdog: beyond the walls", "m", ".1f",
           meaning="of the same plan, which is for a vehicle with one; `firmware.watchdog: false` plans for one "
           "without"),
)  # fmt: skip


def work(settings: Settings, run: Run) -> Work:
    """Return one case per path and speed."""
    cases = product(settings.path_files, settings.speeds)
    return Work({f"{file} at {speed:g}": (file, speed) for file, speed in cases}, measure)


def measure(case: tuple[Path, float]) -> dict[str, Any]:
    """Simulate link loss at every setpoint of a path at a speed. Raises what planning and encoding raise."""
    path_file, speed = case
    planned = plan_flight(path_file, limits_for(path_file), FlightOptions(speed_factor=speed))
    encoded = encode_flight(planned)
    motion = motion_at(planned.plan.trajectory, encoded.times + LEAD)
    as_rates = link_loss_at_every_setpoint(with_rates(motion), planned.limits)
    watched, alone = (_lost(planned, watchdog) for watchdog in (True, False))
    return {
        "path": path_file.stem,
        "speed_factor": speed,
        "moment": watched.moment,
        "rates_beyond": as_rates.worst.beyond,
        "distance": watched.distance,
        "beyond": watched.beyond,
        "alone_distance": alone.distance,
        "alone_beyond": alone.beyond,
    }


def _lost(planned: PlannedFlight, watchdog: bool) -> LinkLoss:
    """Return the worst link loss of a flight, with setpoints encoded for a vehicle with or without watchdog."""
    limits = replace(planned.limits, firmware=replace(planned.limits.firmware, watchdog=watchdog))
    return simulate_link_loss(encode_flight(replace(planned, limits=limits)).payloads, limits)


def with_rates(motion: FullStateSetpoints) -> NDArray:
    """Return the payloads of a motion with attitudes and body rates as planned, without trading rates for turns."""
    return encode(replace(motion, quaternion=command_quaternion(motion.quaternion)))


def tables(settings: Settings, rows: list[dict[str, Any]]) -> Iterator[Table]:
    """Yield a table with one row per path and speed."""
    yield table("link-loss", "Link loss at the worst moment", COLUMNS, rows)


STUDY = Study(Settings, work, tables, "flights/line.yaml flights/helix.yaml -o results/link-loss.json")
