"""Export of a fleet: a file per vehicle, certified to keep their distance if all files are started at one time.

A vehicle that begins later than the others waits at its start, by its file. Where the polynomials of one vehicle must
be slower than its plan, all are slowed by the same factor: they pass the same pairs of places, so they keep apart.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from cfplan.errors import NotCertifiedError
from cfplan.flight.on_board.memory_format import MEMORY_SIZE, MOST_PIECES
from cfplan.flight.on_board.wait import WAIT_SIZE, WAIT_STEP, with_wait
from cfplan.numbers import shown
from cfplan.planning.fleet.fleet_file import FleetFile
from cfplan.planning.fleet.members import FleetMember
from cfplan.preparation.export_flight import ExportedFlight, Form, fit_polynomials, limits_for_polynomials, slowed
from cfplan.preparation.plan_fleet import (
    PlannedFleet,
    certify_separation,
    coordinate_fleet,
    load_fleet,
    plan_alone,
    require_allowed_deviation,
    steps_of,
)
from cfplan.preparation.plan_flight import FlightOptions, PlannedFlight
from cfplan.preparation.steps import OnStep, ignore_steps, step
from cfplan.safety.limits import Limits

_ATTEMPTS = 5  # to slow all together
_SLOWING_MARGIN = 0.005  # extra slowing, because every fit differs

Fit = Callable[[PlannedFlight, float, OnStep], ExportedFlight]  # of a flight that begins after a wait, s


@dataclass(frozen=True, slots=True)
class FittedFleet:
    """A fleet slowed to the pace of its polynomials, and the polynomials without waits."""

    fleet: PlannedFleet
    slowing: float  # times the duration as planned
    exported: tuple[ExportedFlight, ...]  # of each vehicle

    @property
    def waiting(self) -> tuple[ExportedFlight, ...]:
        """Return the polynomials of each vehicle with its wait before them."""
        pairs = zip(self.exported, self.fleet.members, strict=True)
        return tuple(replace(each, on_board=with_wait(each.on_board, member.delay)) for each, member in pairs)


def plan_fleet_to_export(
    source: Path | FleetFile,
    limits: Limits,
    options: FlightOptions | None = None,
    on_step: OnStep = ignore_steps,
    *,
    form: Form,
) -> PlannedFleet:
    """Plan a fleet for other tools. Lost vehicles are not considered: other tools do not brake for them.

    Raises as plan_fleet().
    """
    planned = limits if form is Form.SAMPLES else limits_for_polynomials(limits)
    fleet = load_fleet(source, on_step)
    alone = plan_alone(fleet, planned, options, on_step)
    return replace(coordinate_fleet(fleet, alone, planned, None, on_step, options=options), limits=limits)


def fit_fleet(fleet: PlannedFleet, fit: Fit, on_step: OnStep = ignore_steps) -> FittedFleet:
    """Fit polynomials to the plan of each vehicle, and certify that the vehicles keep apart with them.

    Raises NotCertifiedError if a fit does, if all cannot be slowed together, or if a pair comes too near.
    """
    fitted = _fitted_together(fleet, fit, on_step)
    slower = fitted.fleet
    slower = replace(slower, separations=certify_separation(slower, slower.members, None, on_step))
    dry_runs = {member.name: each.dry_run for member, each in zip(slower.members, fitted.exported, strict=True)}
    require_allowed_deviation(slower, dry_runs, on_step)
    return replace(fitted, fleet=slower)


def _fitted_together(fleet: PlannedFleet, fit: Fit, on_step: OnStep) -> FittedFleet:
    """Slow all vehicles by the factor at which the polynomials of all pass."""
    slowing = 1.0
    for _ in range(_ATTEMPTS):
        slower = replace(fleet, members=tuple(_slowed(member, slowing, fleet.limits) for member in fleet.members))
        exported = []
        for member, flight in zip(slower.members, slower.flights, strict=True):
            exported.append(fit(flight, member.delay, steps_of(member.name, on_step)))
        more = max(each.on_board.reference.slowing for each in exported)
        if more == 1.0:
            return FittedFleet(slower, slowing, tuple(exported))
        slowing *= more + _SLOWING_MARGIN
        with step(on_step, "slower together") as results:
            results.append(f"by {shown(100.0 * (slowing - 1.0), '.1f')} % for polynomials")
    raise NotCertifiedError(
        f"polynomials still exceed a limit after all were slowed together {_ATTEMPTS - 1} times",
        where=fleet.name,
        hint="plan with a lower --speed",
    )


def _slowed(member: FleetMember, slowing: float, limits: Limits) -> FleetMember:
    """Return the flight of a vehicle that takes, and waits, `slowing` times as long."""
    plan = slowed(PlannedFlight(member.name, member.plan, limits), slowing).plan
    return replace(member, plan=plan, delay=WAIT_STEP * math.ceil(slowing * member.delay / WAIT_STEP - 1e-6))


def export_fit(form: Form, *, leads: bool = True, most: int = MOST_PIECES) -> Fit:
    """Return the fit of a form, which leaves room for the wait."""

    def fit(flight: PlannedFlight, wait: float, on_step: OnStep) -> ExportedFlight:
        waits = wait > 0.0
        if most <= waits:
            raise NotCertifiedError("its wait takes the only piece", where=flight.name, hint="allow two pieces or more")
        room = MEMORY_SIZE - WAIT_SIZE * waits
        return fit_polynomials(flight, form, leads=leads, most=most - waits, room=room, on_step=on_step)

    return fit
