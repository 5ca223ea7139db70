"""Simulate where the vehicle comes down after link loss: path files at several speeds, with and without watchdog."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from cfplan.flight.setpoints.encoding import EncodedFlight, command_quaternion, motion_at
from cfplan.flight.setpoints.packets import encode
from cfplan.preparation.plan_flight import FlightOptions, PlannedFlight, plan_flight
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.link_loss import LinkLoss, link_loss_at_every_setpoint, simulate_link_loss
from studies.runner.result import Column, StudyResult, Table, collect
from cfplan.vehicle.trajectory import Trajectory

SPEEDS = (1.0, 0.6, 0.3)  # factors on the speed that the limits allow
COLUMNS = (
    Column("path", "path"),
    Column("speed_factor", "speed", "", "g", meaning="factor on the speed that the limits allow, as by `--speed`"),
    Column("moment", "worst moment", "s", ".1f", meaning="to lose the link, from the first setpoint"),
    Column(
        "rates_beyond",
        "beyond the walls, rates sent as rates",
        "m",
        ".1f",
        meaning="from the worst moment of the same plan, had its setpoints the planned body rates in them",
    ),
    Column("distance", "comes down", "m", ".1f", meaning="horizontally from the last setpoint, from the worst moment"),
    Column("beyond", "beyond the walls", "m", ".1f", meaning="negative inside"),
    Column("alone_distance", "without watchdog: comes down", "m", ".1f"),
    Column(
        "alone_beyond",
        "without watchdog: beyond the walls",
        "m",
        ".1f",
        meaning="of the same plan, which is for a vehicle with one; `firmware.watchdog: false` plans for one without",
    ),
)


def link_losses(
    path_files: Sequence[Path],
    find_safety_file: Callable[[Path], Path],
    *,
    speeds: Sequence[float] = SPEEDS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Lose the link at every setpoint of each path at each speed. An interrupt keeps what is done by then.

    Raises what planning and encoding raise.
    """

    def measure() -> Iterator[dict[str, Any]]:
        for done, (file, speed) in enumerate(product(path_files, speeds)):
            yield _row(file, find_safety_file(file), speed)
            progress(done + 1, len(path_files) * len(speeds))

    rows, interrupted = collect(measure())
    table = Table("link-loss", "Link loss at the worst moment", COLUMNS, tuple(rows))
    settings = {"paths": [file.stem for file in path_files], "speeds": list(speeds)}
    return StudyResult("link-loss", settings, (table,), interrupted=interrupted)


def _row(path_file: Path, safety_file: Path, speed: float) -> dict[str, Any]:
    limits = load_limits(safety_file)
    planned = plan_flight(path_file, limits, FlightOptions(speed_factor=speed))
    encoded = encode_flight(planned)
    as_rates = link_loss_at_every_setpoint(_with_rates(encoded, planned.plan.trajectory), limits)
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
    """Return the worst moment to lose the link of a flight, with setpoints for this."""
    limits = replace(planned.limits, firmware=replace(planned.limits.firmware, watchdog=watchdog))
    return simulate_link_loss(encode_flight(replace(planned, limits=limits)).payloads, limits)


def _with_rates(encoded: EncodedFlight, trajectory: Trajectory) -> NDArray:
    """Return the payloads of a flight with its planned attitudes and body rates, none of them traded."""
    motion = motion_at(trajectory, encoded.times + encoded.lead)
    return encode(replace(motion, quaternion=command_quaternion(motion.quaternion)))
