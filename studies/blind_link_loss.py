"""Lose link and poses on drawn vehicles that fly on their estimate, along each PATH; compare with the swept boxes.

Planning keeps a vehicle that knows its state inside the walls, and widens the box that the vehicle sweeps by the
allowances of `link_loss` in safety.yaml for errors of the estimate. Here the errors are those of the simulated Kalman
filter on vehicles drawn as for the dry run, from evenly spaced moments of each flight.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError
from cfplan.preparation.plan_flight import plan_flight
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.safety.space import inside
from cfplan.simulation.draws import draw_vehicles
from cfplan.simulation.dry_run import fly_drawn, rehearsed_flight
from cfplan.simulation.link_loss import link_loss_at_every_setpoint
from studies.runner.limits import limits_for
from studies.runner.options import argument, option
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

_NEAR = 0.02  # m, out of the box; planning keeps the same distance inside the walls
_WITHOUT_DRAG = 2025, 12  # a firmware whose filter has no model of rotor drag
_LONGEST = 4.0  # s from the last setpoint until every vehicle lies on the floor


@dataclass(frozen=True, slots=True)
class Settings:
    """The paths to fly, and how often link and poses are lost."""

    path_files: tuple[Path, ...] = argument()
    moments: int = option(24, "Moments of each flight at which link and poses are lost.")
    draws: int = option(32, "Vehicles drawn for each moment.")


COLUMNS = (
    Column("path", "path"),
    Column("knows_drag", "models drag", meaning="whether the firmware's filter models rotor drag, as from 2026.04 on"),
    Column("flights", "flights", "", ".0f", meaning="drawn vehicles times moments"),
    Column("within", "within the box", "%", ".1f", meaning=f"of flights, within {100 * _NEAR:g} cm of it"),
    Column("p95", "out of the box, 95 %", "m", ".2f", meaning="95th percentile over all flights; negative inside"),
    Column("most", "out of the box, at most", "m", ".2f"),
    Column("beyond", "beyond the walls, at most", "m", ".2f", meaning="negative inside"),
    Column("outside", "beyond the walls", "", ".0f", meaning="flights that end beyond a wall"),
)  # fmt: skip


REFUSED_COLUMNS = (*COLUMNS[:2], Column("refused", "reason"))


def work(settings: Settings, run: Run) -> Work:
    """Return one case per path and kind of firmware."""
    kinds = product(settings.path_files, ("yes", "no"))
    cases = {
        f"{file}, {knows_drag}": (file, knows_drag, settings.moments, settings.draws) for file, knows_drag in kinds
    }
    return Work(cases, measure)


def measure(case: tuple[Path, str, int, int]) -> dict[str, Any]:
    """Lose link and poses at some moments of a path's flight, or return why it is not planned or sent."""
    path_file, knows_drag, moments, draws = case
    limits = limits_for(path_file)
    if knows_drag == "no":
        limits = replace(limits, firmware=replace(limits.firmware, oldest=_WITHOUT_DRAG))
    try:
        planned = plan_flight(path_file, limits)
        encoded = encode_flight(planned)
    except CfplanError as error:
        return {"path": path_file.stem, "knows_drag": knows_drag, "refused": str(error)}
    boxes, flight = link_loss_at_every_setpoint(encoded.payloads, limits), rehearsed_flight(
        encoded, planned.plan.trajectory
    )  # fmt: skip
    out, beyond = [], []
    for at in np.linspace(0, len(encoded.times) - 1, moments).round().astype(int):
        lost = float(encoded.times[at])
        for draw in draw_vehicles(limits.airframe, limits.pose, draws):
            flown = fly_drawn(replace(flight, duration=lost + _LONGEST), draw, limits, lost)
            way = _to_the_floor(flown.position[round(1000 * lost) :], limits.space.low[2])
            low, high = boxes.low[at], boxes.high[at]
            out.append(max((low - way)[:, :2].max(), (way - high).max()))
            swept = np.stack([way.min(axis=0), way.max(axis=0)])[None, None]
            beyond.append(float(limits.space.swept(swept)[0][0]))
    return {
        "path": path_file.stem,
        "knows_drag": knows_drag,
        "flights": len(out),
        "within": float(np.mean(np.array(out) <= _NEAR)),
        "p95": float(np.quantile(out, 0.95)),
        "most": max(out),
        "beyond": max(beyond),
        "outside": sum(not inside(each) for each in beyond),
    }


def _to_the_floor(way: NDArray, floor: float) -> NDArray:
    """Return the positions, (N, 3) m, of a vehicle until it touches the floor."""
    down = np.flatnonzero(way[:, 2] <= floor)
    return way[: down[0]] if len(down) else way


def tables(settings: Settings, rows: list[dict[str, Any]]) -> Iterator[Table]:
    """Yield a table with one row per path and kind of firmware; then the paths that are refused, if there are any."""
    flown = [row for row in rows if "refused" not in row]
    yield table("blind-link-loss", "Link and poses lost, flown on the estimate", COLUMNS, flown)
    if refused := [row for row in rows if "refused" in row]:
        yield table("refused", "Neither planned nor flown", REFUSED_COLUMNS, refused)


STUDY = Study(Settings, work, tables, "flights/*.yaml -o results/blind-link-loss.json")
