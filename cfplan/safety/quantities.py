"""Table of limited quantities: what each limit bounds, its unit and side, and how the quantity is computed.

Everything that checks motion against limits reads this table: the certificate, the expert's constraints and their check
between nodes, the checks of bytes and of stops, the dry run, feasibility. A new limit needs a row of QUANTITIES, a
field of PlanLimits and a key in safety.yaml; then plans, certificates and bytes are held to it.

A quantity is computed from a full state through its measure (see vehicle/measures.py), which is smooth and increases
with it. The optimiser bounds `row(measure)`, scaled so that each limit is 1, or -1 and 1 where there are two.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.safety.limits import Limits, PlanLimits
from cfplan.vehicle import measures
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.rotations import Scalar

AT_MOST, AT_LEAST = 1, -1  # sides of a limit
PACKET_ROUNDING = 1e-3  # m/s² and smaller units, largest rounding in packets


def _identity(value: Any) -> Any:
    return value


def _zero(_: Airframe) -> float:
    return 0.0


@dataclass(frozen=True, slots=True)
class Quantity:
    """One row of the table."""

    name: str  # in certificates and messages
    unit: str
    limit: str  # field of PlanLimits
    key: str  # of that limit in safety.yaml, section plan
    side: int  # AT_MOST or AT_LEAST
    measure: int  # the first of its measures
    count: int = 1  # number of measures, all of which must keep the limit
    value: Callable[[Any], Any] = _identity  # the quantity, of its measure
    measured: Callable[[Any], Any] = _identity  # the measure, of its quantity
    row: Callable[[Any], Any] = _identity  # the optimiser's bounded expression, of the measure
    hover: Callable[[Airframe], float] = _zero  # the quantity in hover
    remedy: str = "loosen that limit"  # if hovering exceeds it
    jumps: bool = False
    """Whether it jumps between intervals, like h''' and ψ''; a boundary state or setpoint alone cannot determine it."""
    power: int = 2  # of speed, with which it scales if a whole flight is slowed
    ladder: str = ""  # field of FlightLimits, if measured motion is limited too
    in_stop: Callable[[Limits], float] | None = None
    """Limit of stops, as braking adds to a turn at its limit; None if stops are not limited."""

    @property
    def noun(self) -> str:
        """Return the name without its side."""
        return self.name.split(",")[0]

    @property
    def which(self) -> slice:
        """Return the rows of its measures."""
        return slice(self.measure, self.measure + self.count)

    def allowed(self, limits: PlanLimits) -> float:
        """Return its limit for planned motion."""
        return float(getattr(limits, self.limit))

    def unused(self, airframe: Airframe) -> float:
        """Return the value of usage 0: zero, or for a lower limit the value in hover."""
        return 0.0 if self.side == AT_MOST else self.hover(airframe)

    def worst(self, measured: NDArray) -> NDArray:
        """Return its worst value over its measures, of (MEASURES, ...) of full states."""
        return np.asarray(self.value(self.side * np.max(self.side * measured[self.which], axis=0)))

    def excess(self, value: Any, limit: float) -> Any:
        """Return by how much a value exceeds a limit; negative within it."""
        return self.side * (value - limit)


def _tilt(squared_tangent_of_half: Any) -> Any:
    return 2.0 * np.arctan(np.sqrt(squared_tangent_of_half))


def _squared_tangent_of_half(tilt: Any) -> Any:
    return np.tan(tilt / 2.0) ** 2


def _versine(squared_tangent_of_half: Any) -> Any:
    """Return 1 - cos of the tilt, which stays finite upside down, where the measure does not."""
    return 2.0 * squared_tangent_of_half / (1.0 + squared_tangent_of_half)


QUANTITIES = (
    Quantity(
        "speed", "m/s", "speed", "speed", AT_MOST, measures.SPEED, value=np.sqrt, measured=np.square,
        power=1, ladder="speed", in_stop=lambda limits: limits.flight.speed.brake,
    ),
    Quantity(
        "acceleration", "m/s²", "acceleration", "acceleration", AT_MOST, measures.ACCELERATION, value=np.sqrt,
        measured=np.square, ladder="acceleration", in_stop=lambda limits: limits.flight.acceleration.brake,
    ),
    Quantity(
        "angular velocity", "rad/s", "angular_velocity", "angular_velocity", AT_MOST, measures.BODY_RATE,
        value=np.sqrt, measured=np.square, power=1, ladder="angular_velocity",
        in_stop=lambda limits: limits.flight.angular_velocity.brake,
    ),
    Quantity(
        "angular acceleration", "rad/s²", "angular_acceleration", "angular_acceleration", AT_MOST,
        measures.ANGULAR_ACCELERATION, value=np.sqrt, measured=np.square, jumps=True,
    ),
    Quantity(
        "tilt", "rad", "tilt", "tilt_deg", AT_MOST, measures.TILT, value=_tilt,
        measured=_squared_tangent_of_half, row=_versine, in_stop=lambda limits: limits.flight.stop_tilt,
    ),
    Quantity(
        "motor thrust, most", "N", "motor_thrust_max", "motor_reserve", AT_MOST, measures.MOTOR_THRUST, 4, jumps=True,
        remedy="choose a stronger vehicle or a smaller reserve",
        hover=lambda airframe: airframe.hover_thrust, in_stop=lambda limits: limits.airframe.thrust_range[1],
    ),
    Quantity(
        "motor thrust, least", "N", "motor_thrust_min", "motor_reserve", AT_LEAST, measures.MOTOR_THRUST, 4, jumps=True,
        remedy="choose a stronger vehicle or a smaller reserve",
        hover=lambda airframe: airframe.hover_thrust, in_stop=lambda limits: limits.airframe.thrust_range[0],
    ),
    Quantity(
        "specific thrust, least", "m/s²", "specific_thrust_min", "specific_thrust", AT_LEAST, measures.SPECIFIC_THRUST,
        remedy="half of that keeps clear of the firmware's tumble rule",
        hover=lambda _: GRAVITY, in_stop=lambda limits: limits.plan.specific_thrust_min - PACKET_ROUNDING,
    ),
)  # fmt: skip
INSTANT = tuple(quantity for quantity in QUANTITIES if not quantity.jumps)  # determined by a boundary state or setpoint
ON_LADDER = tuple(quantity for quantity in QUANTITIES if quantity.ladder)  # monitored by the pilot

# The optimiser's rows, one per measure: bounds in units of its scale, and which of them jump.
LOWER, UPPER = np.full(measures.MEASURES, -np.inf), np.full(measures.MEASURES, np.inf)
JUMPS = np.zeros(measures.MEASURES, dtype=bool)
_ROWS: list[Callable[[Any], Any]] = [_identity] * measures.MEASURES
for _quantity in QUANTITIES:
    JUMPS[_quantity.which] = _quantity.jumps
    _ROWS[_quantity.which] = [_quantity.row] * _quantity.count
    (UPPER if _quantity.side == AT_MOST else LOWER)[_quantity.which] = 1.0
LOWER[np.isfinite(LOWER) & np.isfinite(UPPER)] = -1.0  # scaled about the middle of both


@lru_cache(maxsize=16)
def scales(limits: PlanLimits) -> tuple[NDArray, NDArray]:
    """Return offset and scale of each of the optimiser's rows, (MEASURES,) each; see rows_of."""
    low, high = np.full(measures.MEASURES, np.nan), np.full(measures.MEASURES, np.nan)
    for quantity in QUANTITIES:
        of_side = high if quantity.side == AT_MOST else low
        of_side[quantity.which] = quantity.row(quantity.measured(quantity.allowed(limits)))
    both = np.isfinite(LOWER) & np.isfinite(UPPER)
    offset = np.where(both, 0.5 * (high + low), 0.0)
    scale = np.where(both, 0.5 * (high - low), np.where(np.isfinite(UPPER), high, low))
    for array in (offset, scale):
        array.setflags(write=False)
    return offset, scale


def rows_of(measured: Sequence[Scalar], offset: Sequence[Scalar], scale: Sequence[Scalar]) -> list[Scalar]:
    """Return the optimiser's rows, which LOWER and UPPER bound, of the measures of a state, as CasADi symbols too."""
    return [(row(m) - o) / s for row, m, o, s in zip(_ROWS, measured, offset, scale, strict=True)]


def scaled(measured: NDArray, limits: PlanLimits) -> NDArray:
    """Return the optimiser's rows, (MEASURES, N), of the measures of N states."""
    offset, scale = scales(limits)
    rows = measured - offset[:, None]
    for quantity in QUANTITIES:
        if quantity.row is not _identity:
            rows[quantity.which] = quantity.row(measured[quantity.which]) - offset[quantity.which, None]
    rows /= scale[:, None]
    return rows
