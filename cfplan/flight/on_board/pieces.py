"""On-board polynomials: the pieces of a trajectory as the high-level commander stores and evaluates them.

The firmware (src/modules/src/pptraj.c) keeps durations and coefficients as float32 and evaluates them in float32 by
Horner's rule, 100 times a second. From acceleration, jerk and yaw it computes the body rates for the
controller. After the last piece it hovers at its end. This module rounds wherever the firmware does.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.vehicle.airframe import GRAVITY

COUNT = 8  # coefficients of a polynomial
AXES = 4  # x, y, z, yaw
RATE = 100.0  # Hz, at which the commander evaluates them


@dataclass(frozen=True, slots=True)
class Pieces:
    """A sequence of polynomials, each from its own time 0 to its duration.

    Raises NotCertifiedError if a number is not finite as float32, or a duration is not positive.
    """

    durations: NDArray  # (K,) s, float32
    coefficients: NDArray  # (K, 4, 8) float32: x, y, z in m and yaw in rad, ascending powers of time

    def __post_init__(self) -> None:
        with np.errstate(over="ignore"):
            durations = np.array(self.durations, dtype=np.float32)
            coefficients = np.array(self.coefficients, dtype=np.float32)
        if durations.ndim != 1 or not len(durations) or coefficients.shape != (len(durations), AXES, COUNT):
            raise NotCertifiedError(
                f"{coefficients.shape} coefficients for {durations.shape} durations", where="the pieces",
                hint="give (K,) durations and (K, 4, 8) coefficients",
            )  # fmt: skip
        bad = ~(np.isfinite(coefficients).all(axis=(1, 2)) & np.isfinite(durations) & (durations > 0.0))
        if bad.any():
            raise NotCertifiedError(
                "a coefficient is too large, or a duration not above 0", where=f"piece {int(np.argmax(bad)) + 1}",
                hint="use fewer, longer pieces",
            )  # fmt: skip
        for name, values in (("durations", durations), ("coefficients", coefficients)):
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    @property
    def duration(self) -> float:
        """Return the duration of all pieces, s."""
        return float(self.durations.astype(float).sum())

    @property
    def begins(self) -> NDArray:
        """Return when each piece begins, (K,) s."""
        return np.concatenate([[0.0], np.cumsum(self.durations.astype(float))[:-1]])


@dataclass(frozen=True, slots=True)
class Goals:
    """The commander's goals for the controller at N times, float32."""

    position: NDArray  # (N, 3) m
    velocity: NDArray  # (N, 3) m/s
    acceleration: NDArray  # (N, 3) m/s², without gravity
    jerk: NDArray  # (N, 3) m/s³
    yaw: NDArray  # (N,) rad
    body_rate: NDArray  # (N, 3) rad/s, body axes


def goals_at(pieces: Pieces, times: NDArray) -> Goals:
    """Return the commander's goals at times, (N,) s from the start, at least 0."""
    piece, left, ended = _located(pieces, np.asarray(times, dtype=np.float32))
    table = pieces.coefficients[piece]
    values = []
    for _ in range(4):
        values.append(_horner(table, left))
        table = _derived(table)
    position, velocity, acceleration, jerk = values
    rate = body_rates(acceleration[:, :3], jerk[:, :3], position[:, 3], velocity[:, 3])
    for each in (velocity, acceleration, jerk, rate):
        each[ended] = 0.0
    return Goals(position[:, :3], velocity[:, :3], acceleration[:, :3], jerk[:, :3], position[:, 3], rate)


def body_rates(acceleration: NDArray, jerk: NDArray, yaw: NDArray, yaw_rate: NDArray) -> NDArray:
    """Return the body rates, (N, 3) rad/s, for the controller: without drag, in the precision of the arguments."""
    force = acceleration + np.array([0.0, 0.0, GRAVITY], dtype=acceleration.dtype)
    size = np.sqrt((force * force).sum(axis=1))[:, None]
    z = force / size
    y = np.cross(z, np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1))
    y = y / np.sqrt((y * y).sum(axis=1))[:, None]
    x = np.cross(y, z)
    tip = (jerk - (jerk * z).sum(axis=1)[:, None] * z) / size
    return np.stack([-(tip * y).sum(axis=1), (tip * x).sum(axis=1), z[:, 2] * yaw_rate], axis=1)


def derivatives_of(pieces: Pieces, piece: int, times: NDArray, orders: int = 5) -> NDArray:
    """Return position and derivatives, (N, orders, 4) in float64, of one piece at times of its own, (N,) s."""
    table = pieces.coefficients[piece].astype(float)[None].repeat(len(times), axis=0)
    values = []
    for _ in range(orders):
        values.append(_horner(table, times))
        table = _derived(table)
    return np.stack(values, axis=1)


def states_at(pieces: Pieces, times: NDArray) -> NDArray:
    """Return position and yaw with four derivatives, (N, 5, 4) in float64, at times, (N,) s from the start."""
    piece, left, _ = _located(pieces, np.asarray(times, dtype=np.float32))
    out = np.zeros((len(times), 5, AXES))
    for k in np.unique(piece):
        here = piece == k
        out[here] = derivatives_of(pieces, int(k), left[here].astype(float))
    return out


def _located(pieces: Pieces, times: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return the piece of each time, how long it has been flown, s, and whether all pieces have ended, (N,) each."""
    piece, left = np.full(len(times), len(pieces.durations) - 1), times.copy()
    ended = np.ones(len(times), dtype=bool)
    for k, duration in enumerate(pieces.durations):
        here = ended & (left <= duration)
        piece[here], ended[here] = k, False
        left[ended] -= duration
    left[ended] = pieces.durations[-1]
    return piece, left, ended


def _horner(table: NDArray, times: NDArray) -> NDArray:
    """Return polynomials (N, 4, 8) at times (N,), (N, 4)."""
    value = np.zeros_like(table[:, :, 0])
    for power in range(COUNT - 1, -1, -1):
        value = value * times[:, None] + table[:, :, power]
    return value


def _derived(table: NDArray) -> NDArray:
    """Return the derivatives of polynomials, (N, 4, 8) each."""
    out = np.zeros_like(table)
    out[..., :-1] = table[..., 1:] * np.arange(1, COUNT, dtype=table.dtype)
    return out
