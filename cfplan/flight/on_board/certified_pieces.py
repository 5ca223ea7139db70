"""Certified pieces for the vehicle's memory: fitted with more pieces, or slower, until the decoded motion passes.

Plans have jumps in angular acceleration, polynomials do not. If they overshoot a limit, the whole flight is slowed:
fits with several numbers of pieces are each slowed until their certificate passes, and of the fastest ones the nearest
to the plan is chosen.
"""

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.firmware import version_text
from cfplan.flight.on_board.correction import Correction
from cfplan.flight.on_board.fitting import drawn_knots, even_knots, fit_control_points, fit_pieces
from cfplan.flight.on_board.memory_format import (
    MEMORY_SIZE,
    MOST_PIECES,
    YAW_READ_SINCE,
    compressed_bytes,
    compressed_size,
    raw_bytes,
    read_compressed,
    read_raw,
)
from cfplan.flight.on_board.piece_certificate import certify_pieces, certify_samples, sample_pieces
from cfplan.flight.on_board.pieces import Pieces
from cfplan.flight.on_board.reference import PolynomialReference
from cfplan.safety.certificate import Certificate
from cfplan.safety.limits import Limits
from cfplan.vehicle.trajectory import Trajectory

FARTHEST = 0.02  # m from the reference
SLOWEST = 1.5  # times the plan's duration
_LEAST_PIECES = 2  # Crazyswarm cannot read a file of one
_COUNT_FRACTIONS = (0.25, 0.5, 0.75, 1.0)  # of the largest number of pieces, to be tried
_DURATION_TOLERANCE = 1.01  # times the least duration; within this the fit nearest to the plan is chosen
_LENGTHS = (
    1.2,
    1.0,
    0.9,
    0.8,
    0.7,
    0.6,
    0.5,
    0.4,
)  # s of a compressed piece, about: shorter ones suffer from whole millimetres
_COUNTS_NEAR_FULL = 2  # numbers of pieces below the largest that fits, to be tried too, as fits vary
_MAX_COUNT_FACTOR, _COUNT_FACTOR_STEP = (
    3.0,
    0.05,
)  # times as many pieces as there may be, that are sought for how long may fly
_COARSE = 0.004  # s between samples in the search for the slowing
_HALVINGS = 7
_SLOWING_STEP, _SLOWING_ATTEMPTS = 1.003, 6  # where the fine certificate does not pass at what the coarse one found


@dataclass(frozen=True, slots=True)
class OnBoardTrajectory:
    """A trajectory in the vehicle's memory, and its decoded pieces."""

    memory: bytes  # from byte 0 of the memory on; empty where there are more pieces than it holds
    compressed: bool
    pieces: Pieces
    certificate: Certificate  # of the pieces
    reference: PolynomialReference  # of the fit
    error: float  # m, largest deviation from the reference

    @property
    def duration(self) -> float:
        """Return how long it takes, s."""
        return self.pieces.duration


@dataclass(frozen=True, slots=True)
class _Fitted:
    memory: bytes
    compressed: bool
    pieces: Pieces


_Fit = Callable[[PolynomialReference], _Fitted]


def certified_pieces(
    trajectory: Trajectory,
    limits: Limits,
    *,
    leads: bool = True,
    most: int = MOST_PIECES,
    correction: Correction | None = None,
) -> OnBoardTrajectory:
    """Return at most `most` pieces, uncompressed, that fly a trajectory within the limits.

    `leads` puts them ahead of the trajectory to compensate for drag, see reference.py; `correction` is learned from a
    dry run without it. Raises NotCertifiedError if they deviate by more than FARTHEST from the reference, or take more
    than SLOWEST times as long.
    """

    def fit_of(knots_of: Callable[[PolynomialReference, int], NDArray], count: int) -> _Fit:
        def make(reference: PolynomialReference) -> _Fitted:
            pieces = fit_pieces(reference, knots_of(reference, count))
            if count > MOST_PIECES:
                return _Fitted(b"", False, pieces)
            memory = raw_bytes(pieces)
            return _Fitted(memory, False, read_raw(memory, count))

        return make

    counts = sorted({max(_LEAST_PIECES, round(most * share)) for share in _COUNT_FRACTIONS})
    fits_tried = (fit_of(knots_of, count) for count in counts for knots_of in (even_knots, drawn_knots))
    reference = PolynomialReference(trajectory, leads=leads, correction=correction)
    return _best(fits_tried, reference, limits, f"{most} pieces")


def certified_compressed(
    trajectory: Trajectory,
    limits: Limits,
    *,
    leads: bool = True,
    room: int = MEMORY_SIZE,
    correction: Correction | None = None,
) -> OnBoardTrajectory:
    """Return compressed pieces that fly a trajectory within the limits, in `room` bytes at most.

    Raises NotCertifiedError as above, or if a firmware that safety.yaml permits would misread the yaw; for a flight
    that is too long, its message says what would fit.
    """

    def fit_of(count: int) -> _Fit:
        return lambda reference: _compressed(reference, count, room)

    reference = PolynomialReference(trajectory, leads=leads, correction=correction)
    yaw = reference.at(np.arange(0.0, reference.duration, _COARSE))[:, 0, 3]
    if limits.firmware.oldest < YAW_READ_SINCE and yaw.any():
        raise NotCertifiedError(
            f"firmware before {version_text(YAW_READ_SINCE)} misreads the yaw of compressed pieces, and safety.yaml "
            f"permits {version_text(limits.firmware.oldest)}",
            where="trajectory memory",
            hint="update every vehicle and raise `firmware.oldest`, plan with a fixed yaw of 0, or fly a shorter path, "
            "for which uncompressed pieces suffice",
        )
    counts = {max(1, int(np.ceil(reference.duration / length))) for length in _LENGTHS}
    fullest = _max_count_that_fits(reference, max(counts), room)
    if fullest == max(counts):
        return _best(map(fit_of, sorted(counts)), reference, limits, f"{room} bytes")
    counts = {count for count in counts if count < fullest} | set(
        range(max(fullest - _COUNTS_NEAR_FULL, 1), fullest + 1)
    )
    try:
        return _best(map(fit_of, sorted(counts)), reference, limits, f"{room} bytes")
    except NotCertifiedError as error:
        if fits := _longest_flight_that_fits(reference, fullest, room):
            raise NotCertifiedError(
                f"a flight of {reference.duration:.0f} s; of one like this {room} bytes hold some {fits:.0f} s",
                where="trajectory memory",
                hint="fly fewer laps, less of the path, or faster (far from walls it need not be slow for the fall), "
                "or fly it streamed",
            ) from error
        raise


def _compressed(reference: PolynomialReference, count: int, room: int) -> _Fitted:
    memory = compressed_bytes(fit_control_points(reference, count), room)
    return _Fitted(memory, True, read_compressed(memory))


def _max_count_that_fits(reference: PolynomialReference, count: int, room: int) -> int:
    """Return the most compressed pieces, at most `count`, that `room` bytes hold."""
    while count > 1 and (size := compressed_size(fit_control_points(reference, count).moves)) > room:
        count = max(min(count - 1, int(count * room / size) + _COUNTS_NEAR_FULL), 1)
    return count


def _longest_flight_that_fits(reference: PolynomialReference, count: int, room: int) -> float:
    """Return the longest such flight, s, that fits the memory; 0 if memory is not the problem: `count` pieces are near
    enough.
    """
    for share in np.arange(1.0, _MAX_COUNT_FACTOR, _COUNT_FACTOR_STEP):
        made = _compressed(reference, round(share * count), sys.maxsize)
        if _error(made.pieces, reference) <= FARTHEST:
            return reference.duration * room / len(made.memory) if share > 1.0 else 0.0
    return 0.0


def _best(fits_tried: Iterable[_Fit], reference: PolynomialReference, limits: Limits, room: str) -> OnBoardTrajectory:
    """Return the nearest to the reference among the fastest that pass. Raises NotCertifiedError if none does."""
    good: list[OnBoardTrajectory] = []
    flaws: list[tuple[float, str]] = []  # severity and text
    for make in fits_tried:
        try:
            made = _certified(make, reference, limits)
        except NotCertifiedError as error:
            flaws.append((np.inf, error.what))
            continue
        if flaw := _rejection(made):
            flaws.append((max(made.error / FARTHEST, made.certificate.worst.share), flaw))
        else:
            good.append(made)
    if not good:
        raise NotCertifiedError(
            f"within {room}: {min(flaws)[1]}", where="polynomials",
            hint="use more pieces, compressed ones if need be, plan with lower limits, or keep farther from walls",
        )  # fmt: skip
    least = min(made.duration for made in good)
    return min((made for made in good if made.duration <= _DURATION_TOLERANCE * least), key=lambda made: made.error)


def _certified(make: _Fit, reference: PolynomialReference, limits: Limits) -> OnBoardTrajectory:
    """Return the fit with about the least slowing at which its certificate passes, if there is one."""
    samples = sample_pieces(make(reference).pieces, _COARSE)
    slowing = _least_slowing(
        lambda factor: certify_samples(samples.slowed(factor), limits.airframe, limits.plan).passed
    )
    for _ in range(_SLOWING_ATTEMPTS):
        slowed = replace(reference, slowing=slowing)
        made = make(slowed)
        certificate = certify_pieces(made.pieces, limits.airframe, limits.plan, limits.space)
        if certificate.passed:
            break
        slowing *= _SLOWING_STEP
    return OnBoardTrajectory(
        made.memory, made.compressed, made.pieces, certificate, slowed, _error(made.pieces, slowed)
    )


def _error(pieces: Pieces, reference: PolynomialReference) -> float:
    """Return the largest deviation of pieces from their reference, m."""
    samples = sample_pieces(pieces, _COARSE)
    deviation = samples.derivatives[:, 0, :3] - reference.at(samples.time)[:, 0, :3]
    return float(np.linalg.norm(deviation, axis=1).max())


def _rejection(made: OnBoardTrajectory) -> str:
    """Return why a trajectory is rejected; empty if it is not."""
    if not made.error <= FARTHEST:
        return f"polynomials stray {made.error:.2f} m from the plan, {FARTHEST:g} m are allowed"
    worst = made.certificate.worst
    if not made.certificate.passed:
        return f"polynomials reach {100 * worst.share:.1f} % of the limit on {worst.name} at {worst.time:.2f} s"
    return ""


def _least_slowing(passes: Callable[[float], bool]) -> float:
    """Return the least factor from 1 to SLOWEST at which something passes, by bisection; SLOWEST if there is none."""
    if passes(1.0):
        return 1.0
    low, high = 1.0, SLOWEST
    for _ in range(_HALVINGS):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if passes(middle) else (middle, high)
    return high
