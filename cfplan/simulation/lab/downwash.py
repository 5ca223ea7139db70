"""The air and the space that vehicles of one lab share: downwash, and contact.

Downwash is a fit to 45 minutes of public flight logs of 34 g vehicles that flew above each other, dz 0.2 to 0.7 m. It
takes from each vehicle beneath a fraction of its thrust, which is how such flights can be replayed.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cfplan.flight.telemetry import Triple
from cfplan.simulation.lab.lab import Truth
from cfplan.simulation.virtual_crazyflie.vehicle import VirtualCrazyflie
from cfplan.vehicle.airframe import Airframe

_AT_ROTORS = 19.9 / 34.0  # of a vehicle's weight, on one alike directly beneath it
_HALVED_AT = 0.275  # m beneath it, where half of that is left
_WIDTH, _WIDENS = 0.031, 0.069  # m, and m per m beneath it: standard deviation sideways
_PROPELLER = 0.0235  # m, radius
_HEIGHT = 0.05  # m between the centres of vehicles that touch with one above the other


def downwash(across: float, above: float) -> float:
    """Return the force on a vehicle, as a fraction of its weight, by one alike `above` it and `across` from it, m."""
    if above <= 0.0:
        return 0.0
    width = _WIDTH + _WIDENS * above
    return _AT_ROTORS / (1.0 + above / _HALVED_AT) * math.exp(-0.5 * (across / width) ** 2)


def share_air(vehicles: Sequence[VirtualCrazyflie]) -> None:
    """Let each vehicle lose thrust to the air beneath all others, where they are now, until this is called again.

    A vehicle pushes air down as its motors push it up, so one that stands with its motors off disturbs nobody.
    """
    states = [vehicle.truth.tolist() for vehicle in vehicles]
    thrusts = [sum(state[13:17]) for state in states]
    for vehicle, own, thrust in zip(vehicles, states, thrusts, strict=True):
        pushed = sum(
            downwash(math.hypot(other[0] - own[0], other[1] - own[1]), other[2] - own[2]) * by
            for other, by in zip(states, thrusts, strict=True)
        )
        vehicle.lose_thrust(min(pushed / thrust, 1.0) if thrust > 0.0 else 0.0)


class Contact(NamedTuple):
    """Two vehicles touch."""

    pair: tuple[str, str]
    time: float  # s, of the lab
    place: Triple  # m, in the middle between them

    def __str__(self) -> str:
        a, b = self.pair
        return f"{a} and {b} touch at ({', '.join(f'{each:.2f}' for each in self.place)}) m"


def contacts(truths: dict[str, Truth], airframe: Airframe) -> tuple[Contact, ...]:
    """Return the first contact of each pair, the earliest first, from the rows of truth of vehicles of one lab."""
    reach = 2.0 * (math.sqrt(2.0) * airframe.arm + _PROPELLER)
    found = []
    for (a, one), (b, two) in itertools.combinations(truths.items(), 2):
        other = np.column_stack([np.interp(one.time, two.time, two.position[:, axis]) for axis in range(3)])
        away = other - one.position
        touching = np.flatnonzero((np.hypot(away[:, 0], away[:, 1]) < reach) & (np.abs(away[:, 2]) < _HEIGHT))
        if len(touching):
            row = int(touching[0])
            x, y, z = (0.5 * (one.position[row] + other[row])).tolist()
            found.append(Contact((a, b), float(one.time[row]), (x, y, z)))
    return tuple(sorted(found, key=lambda each: each.time))
