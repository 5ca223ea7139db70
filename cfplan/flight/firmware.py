"""What cfplan knows of crazyflie-firmware: the gains of its Mellinger controller, and its time-outs by version.

Setpoints, dry run and link loss rest on these figures, so preflight reads back what of them a vehicle can tell.
"""

import math
import re
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from cfplan.safety.limits import Limits
from cfplan.vehicle.airframe import Airframe

NEWEST_KNOWN = (2026, 8)  # the newest firmware that these figures were read from


@dataclass(frozen=True, slots=True)
class MellingerGains:
    """The parameters of the group ctrlMel, with the defaults that they have from firmware 2023.11 to 2026.08."""

    mass: float = 0.029  # kg; set this to the true mass before a flight
    mass_thrust: float = 132000.0  # 16-bit units per N
    kp_xy: float = 0.4
    kd_xy: float = 0.2
    ki_xy: float = 0.05
    i_range_xy: float = 2.0
    kp_z: float = 1.25
    kd_z: float = 0.4
    ki_z: float = 0.05
    i_range_z: float = 0.4
    kR_xy: float = 70000.0
    kw_xy: float = 20000.0
    ki_m_xy: float = 0.0
    i_range_m_xy: float = 1.0
    kR_z: float = 60000.0
    kw_z: float = 12000.0
    ki_m_z: float = 500.0
    i_range_m_z: float = 1500.0
    kd_omega_rp: float = 200.0

    def pack(self) -> NDArray:
        """Return the gains (19,), as the compiled controller takes them."""
        return np.array([getattr(self, name) for name in _GAINS])  # astuple() takes ten times as long


_GAINS = tuple(each.name for each in fields(MellingerGains))
# The parameter of each gain, in the order of `MellingerGains.pack`.
GAIN_PARAMETERS = tuple("ctrlMel." + {"mass_thrust": "massThrust"}.get(name, name) for name in _GAINS)


def gains_for(airframe: Airframe) -> MellingerGains:
    """Return the default gains with the vehicle's own mass and thrust scale, as the pilot sets them."""
    return MellingerGains(mass=airframe.mass, mass_thrust=airframe.command_per_thrust)


@dataclass(frozen=True, slots=True)
class Timeouts:
    """What the supervisor does by itself, and after which time, s."""

    level_out: float = 0.5  # after the last setpoint: x and y are given up, and the vehicle levels out
    motors_off: float = 2.0  # after the last setpoint: motors off, then locked until restarted
    keep_alive: float = 1.0  # after the last keep-alive packet, once there was one: motors off
    connection: float = 1.0  # after the last packet of any kind: all log blocks are deleted
    still_flying: float = 2.0  # after the last thrust, for which the vehicle counts as flying
    period: float = 0.04  # between two looks at all that: each comes up to this much later

    @property
    def level_out_at_latest(self) -> float:
        """Return when, s after the last setpoint, the vehicle levels out at the latest."""
        return self.level_out + self.period

    def motors_off_at_latest(self, watchdog: bool) -> float:
        """Return when, s after the last packet, the motors stop at the latest, with the watchdog or without it."""
        return self.watchdog_at_latest if watchdog else self.motors_off + self.period

    @property
    def watchdog_at_latest(self) -> float:
        """Return when, s after the last keep-alive packet, the motors stop at the latest."""
        return self.keep_alive + self.period


# Each from this version on; read in supervisor.c of every release from 2023.06 to 2026.08, which agree.
TIMEOUTS: tuple[tuple[tuple[int, ...], Timeouts], ...] = (((2023, 6), Timeouts()),)


YAW_CORRECT = (2025, 9, 1)  # the first firmware whose filter does not diverge with yaw beyond 90°
FLIES_AS_PREDICTED = (2026, 4)
"""The first firmware whose filter knows rotor drag (kalman.dragB): the oldest that deviates as dry runs say."""
# The largest deviations of firmware from each version on, at 2 m/s on flights/line, figure8 and loop3d, with that
# firmware itself around the simulated body; from FLIES_AS_PREDICTED on they are 2 to 4 cm.
EARLIER_DEVIATIONS: tuple[tuple[tuple[int, ...], str], ...] = (
    (YAW_CORRECT, "8 to 13 cm, and 2 cm low"),
    ((2025, 12), "5 to 9 cm"),
)

ATTITUDE_ERROR_WITHOUT_DRAG = math.radians(3.5)  # rad, of a filter that knows no drag; results/blind-link-loss.json
VELOCITY_ERROR_WITHOUT_DRAG = 0.3  # m/s, likewise


def knows_drag(limits: Limits) -> bool:
    """Return whether every vehicle that may fly has a filter that can be told of rotor drag.

    Before a vehicle is connected, safety.yaml alone says what firmware it may have.
    """
    return limits.firmware.oldest >= FLIES_AS_PREDICTED


def estimate_errors(limits: Limits) -> tuple[float, float]:
    """Return the errors of the estimated attitude, rad, and velocity, m/s, to allow for when link and poses are lost.

    They are those of safety.yaml, and no less than those of the oldest firmware that may fly.
    """
    stated = limits.link_loss.attitude_error, limits.link_loss.velocity_error
    if knows_drag(limits):
        return stated
    return max(stated[0], ATTITUDE_ERROR_WITHOUT_DRAG), max(stated[1], VELOCITY_ERROR_WITHOUT_DRAG)


def earlier_deviation(version: tuple[int, ...]) -> str:
    """Return how far a firmware before `FLIES_AS_PREDICTED` deviates, in words; empty where that is not known."""
    known = [text for since, text in EARLIER_DEVIATIONS if since <= version < FLIES_AS_PREDICTED]
    return known[-1] if known else ""


def version_of(text: str) -> tuple[int, ...]:
    """Return the version in what a vehicle says of its firmware: "2025.09.1 (abc)" is (2025, 9, 1), "" is ()."""
    found = re.search(r"\d+(?:\.\d+)*", text)
    return tuple(int(part) for part in found[0].split(".")) if found else ()


def version_text(version: tuple[int, ...]) -> str:
    """Return a version as Bitcraze writes it: (2025, 9, 1) is "2025.09.1"."""
    return ".".join(f"{part:02d}" if place == 1 else str(part) for place, part in enumerate(version))


def timeouts_of(version: tuple[int, ...]) -> Timeouts:
    """Return the time-outs of a firmware; one newer than NEWEST_KNOWN is taken to have the newest known ones.

    Raises ValueError for a firmware older than all of `TIMEOUTS`.
    """
    for since, timeouts in reversed(TIMEOUTS):
        if version >= since:
            return timeouts
    raise ValueError(f"the time-outs of firmware {version_text(version) or 'unknown'} are not known")
