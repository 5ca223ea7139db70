"""An airframe: mass, inertia, motors and motor mixing, drag."""

import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from typing import Annotated, Any, get_args, get_type_hints

import numpy as np
from annotated_types import Ge, Gt, Le, Len
from numpy.typing import NDArray

GRAVITY = 9.81  # m/s², as in the firmware

# Motors 1 front right, 2 back right, 3 back left, 4 front left: the sign of each motor's torque about x, y, z.
MOTOR_TORQUE_SIGNS = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]], dtype=float)

# What an airframe's file may state: far more than vehicles that fly indoors have. Larger values would lose digits, or
# have a wrong unit.
_Fraction = Annotated[float, Ge(0.0), Le(1.0)]
_Inertia = Annotated[float, Ge(1e-8), Le(1.0)]
_Drag = Annotated[float, Ge(0.0), Le(10.0)]
_Moment = Annotated[float, Ge(0.0), Le(0.1)]
_Coefficient = Annotated[float, Ge(-10.0), Le(10.0)]


@dataclass(frozen=True, slots=True)
class Spread:
    """Spread of vehicles of one kind around their airframe: half the width of the 95 % interval, as fractions.

    From public flights of four vehicles, and from repeated flights of one vehicle.
    """

    mass: _Fraction = 0.02  # decks and markers
    thrust_scale: _Fraction = 0.06
    drag: _Fraction = 0.15
    velocity_moment: _Fraction = 0.15
    motor_time_constant: _Fraction = 0.15


@dataclass(frozen=True, slots=True)
class Airframe:
    """A quadrotor in X configuration."""

    name: Annotated[str, Len(1, 100)]
    mass: Annotated[float, Ge(1e-3), Le(10.0)]  # kg, as flown
    inertia: tuple[_Inertia, _Inertia, _Inertia]  # kg m², diagonal, body axes
    arm: Annotated[float, Ge(1e-3), Le(1.0)]  # m, distance of a motor from the x and from the y axis
    thrust_to_torque: Annotated[float, Ge(1e-6), Le(1.0)]  # m, yaw torque per thrust
    motor_thrust_min: Annotated[float, Ge(0.0), Le(100.0)]  # N, least thrust of a running motor
    motor_thrust_max: Annotated[float, Gt(0.0), Le(100.0)]  # N, most thrust of one motor
    motor_time_constant: Annotated[float, Ge(1e-4), Le(1.0)]  # s, first-order lag of thrust
    drag: tuple[_Drag, _Drag]  # N s/m, linear rotor drag in the rotor plane and along the thrust axis
    source: Annotated[str, Len(1, 1000)]
    rotor_reaction: _Fraction = 0.0
    """N m s/N, yaw torque per rate of change of thrust: a rotor's inertia over the slope of its thrust by its speed."""
    velocity_moment: tuple[_Moment, _Moment] = (0.0, 0.0)
    """N m per m/s, moment about x by velocity along y, and about -y by velocity along x, in body axes."""
    thrust_scale: Annotated[float, Ge(0.2), Le(5.0)] = 1.0
    """Actual over commanded thrust in hover; the controller knows it and commands less of a strong vehicle."""
    thrust_curvature: Annotated[float, Ge(-0.9), Le(0.9)] = 0.0
    """Fraction by which thrust around hover grows more slowly than in proportion to the command."""
    lift_with_speed: Annotated[float, Ge(-0.1), Le(0.1)] = 0.0
    """1/(m/s)², gain of thrust at equal rotor speed per squared speed in the rotor plane."""
    voltage_sag: Annotated[float, Ge(0.0), Le(5.0)] = 0.0
    """1/V, fraction of thrust lost per volt of battery; 0 if the firmware compensates it."""
    motor_curve: tuple[_Coefficient, _Coefficient, _Coefficient, _Coefficient, _Coefficient] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """The firmware's cubic from a motor's voltage, V, to thrust, N, and the thrust of its full command; zeros: none."""
    spread: Spread = Spread()

    @property
    def hover_thrust(self) -> float:
        """Return the thrust of each motor in hover, N."""
        return self.mass * GRAVITY / 4

    @property
    def thrust_range(self) -> tuple[float, float]:
        """Return the thrust range of one motor, N, for planning.

        The thrust scale is only known in hover: one below 1 lowers the maximum, one above 1 does not raise it.
        """
        return self.motor_thrust_min * max(self.thrust_scale, 1.0), self.motor_thrust_max * min(self.thrust_scale, 1.0)

    @property
    def command_per_thrust(self) -> float:
        """Return 16-bit units of a motor's command per N of collective thrust, the value for ctrlMel.massThrust."""
        return 65535 / (4 * self.motor_thrust_max * self.thrust_scale)

    @property
    def mixing(self) -> NDArray:
        """Return (4, 4): [collective thrust, torque x, y, z] = mixing @ motor thrusts."""
        levers = np.array([self.arm, self.arm, self.thrust_to_torque])
        return np.vstack([np.ones(4), levers[:, None] * MOTOR_TORQUE_SIGNS])

    def simplified(self) -> "Airframe":
        """Return the airframe without effects that the bodies of RotorPy and drone-models lack."""
        return replace(
            self, velocity_moment=(0.0, 0.0), thrust_scale=1.0, thrust_curvature=0.0, lift_with_speed=0.0,
            voltage_sag=0.0,
        )  # fmt: skip


UNPLANNED = frozenset(
    ("velocity_moment", "thrust_scale", "thrust_curvature", "lift_with_speed", "voltage_sag", "motor_curve", "spread")
)
"""Fields that datasets, and so networks, do not have."""


def airframe_of(values: Mapping[str, Any]) -> Airframe:
    """Return the airframe of plain data as `asdict` makes it; null is NaN.

    Fields of later versions are ignored, missing ones keep their defaults. Raises KeyError, TypeError, ValueError or
    AttributeError if the data are not an airframe.
    """
    given: dict[str, Any] = {}
    kinds = get_type_hints(Airframe)
    for each in fields(Airframe):
        if each.name not in values and each.default is not MISSING:
            continue
        value, kind = values[each.name], kinds[each.name]
        if kind is str:
            given[each.name] = str(value)
        elif kind is float:
            given[each.name] = _number(value)
        elif kind is Spread:
            named = {part.name for part in fields(Spread)} & set(value.keys())
            given[each.name] = Spread(**{name: _number(value[name]) for name in named})
        else:
            given[each.name] = tuple(_number(part) for part, _ in zip(value, get_args(kind), strict=True))
    return Airframe(**given)


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
