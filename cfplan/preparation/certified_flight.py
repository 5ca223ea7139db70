"""Certify a flight that goes on from one that is flown: bytes, stops, link loss, gaps and the dry run.

All of it may be certified, or its beginning alone, with the stop behind that: what a pilot is bound to then ends at
rest too, and takes as little time to certify as the beginning is short. More of the flight replaces the stop before the
vehicle gets there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError, InfeasibleError
from cfplan.flight.setpoints.commitment import left_of
from cfplan.flight.setpoints.encoding import HOLD, RATE, EncodedFlight, check_bytes, check_setpoints, encode_trajectory
from cfplan.flight.setpoints.packets import FullStateSetpoints
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.setpoints.stop_certificate import encode_certified_stops
from cfplan.flight.setpoints.stops import DURATION, encode_stops, rest_behind
from cfplan.flight.telemetry import Triple
from cfplan.preparation.beside import Work, beside
from cfplan.preparation.link_loss_assessment import OUTSIDE_HINT, assess_link_loss_of_stops
from cfplan.preparation.local_slowing import Assessment
from cfplan.safety.limits import Limits
from cfplan.simulation.dry_run import dry_run, rehearse_setpoints
from cfplan.simulation.glitches import glitch_where_nearly_lost
from cfplan.simulation.link_loss import LinkLossMoments, as_believed, foreseen_link_loss, link_loss_at_walls
from cfplan.vehicle.joint import JoinedTrajectory

STOP = round(DURATION * RATE)  # setpoints from the place where a stop begins to where it rests
BEHIND = STOP + 1 + round(HOLD * RATE)  # setpoints of a beginning behind those that follow the motion
_FORESEEN = 0.05  # m beyond a wall, from which on link loss that is only foreseen counts


class EndsBadlyError(InfeasibleError):
    """After link loss or a gap the vehicle would end outside the walls, or turn over."""


@dataclass(frozen=True, slots=True, eq=False)
class CertifiedFlight:
    """Setpoints that end at rest, a stop from each, and the simulated vehicle at each."""

    payloads: NDArray  # (N, 29) uint8
    stops: NDArray  # (N, M, 29) uint8
    snapshots: NDArray  # (L, N, 31) for each motor lag
    following: int | None  # how many of the setpoints follow the motion, before the stop; None where all do
    rest: tuple[Triple, float] | None = None  # m, rad: place and yaw where that stop rests


def certify_whole(flown: JoinedTrajectory, limits: Limits, starts: NDArray | None) -> CertifiedFlight:
    """Certify all of a flight like a plan before take-off; it goes on from snapshots, (L, 31), or from hover.

    Raises EndsBadlyError or NotCertifiedError where it does not pass.
    """
    encoded = encode_trajectory(flown, gains=gains_under(limits), space=limits.space)
    believed = None if starts is None else as_believed(starts, limits)

    def check() -> None:
        check_bytes(encoded, flown, limits.plan)
        dry_run(encoded, flown, limits.airframe, limits.flight, snapshot=believed).require_passed()

    stops, lost = _certified(encoded, encoded.payloads, limits, starts, check)
    return CertifiedFlight(encoded.payloads, stops, lost.snapshots, None)


def certify_beginning(
    flown: JoinedTrajectory,
    following: int,
    limits: Limits,
    starts: NDArray,
    *,
    foresee: bool = True,
    encoded: EncodedFlight | None = None,
) -> CertifiedFlight:
    """Certify so many setpoints of a flight, and the stop behind them; all of it where that is hardly more.

    As certify_whole(). With `foresee`, an estimate of link loss in all of the flight counts besides: what it says to
    end outside by far is refused before any of it is flown; without, setpoints that are `encoded` already, as many as
    encoded_for() says, are not encoded again.
    """
    if following + STOP >= flown.duration * RATE:
        return certify_whole(flown, limits, starts)
    gains, space = gains_under(limits), limits.space
    foresee = foresee and not limits.link_loss.only_warn
    beginning = encoded_for(following)
    if encoded is None or foresee:
        encoded = encode_trajectory(flown, gains=gains, space=space, count=None if foresee else beginning)
    whole, encoded = encoded.payloads if foresee else None, _first_rows(encoded, beginning)
    last = np.array([following])
    stop = encode_stops(encoded.motion, RATE, rows=last, gains=gains, space=space)[0]
    payloads = np.concatenate([encoded.payloads[:following], stop, np.repeat(stop[-1:], BEHIND - len(stop), axis=0)])
    begun = _first_rows(encoded, following + 1)

    def check() -> None:
        check_setpoints(begun, flown, limits.plan)
        believed = as_believed(starts, limits)
        rehearse_setpoints(payloads, limits.airframe, limits.flight, snapshot=believed).require_passed()

    foreseen = [] if whole is None else [partial(foresee_link_loss, whole, limits, starts)]
    stops, lost = _certified(begun, payloads, limits, starts, check, encoded.motion, foreseen)
    rest = rest_behind(encoded.motion, following, RATE)
    behind = left_of(stop, BEHIND - 1)
    return CertifiedFlight(payloads, np.concatenate([stops, behind]), lost.snapshots, following, rest)


def encoded_for(following: int) -> int:
    """Return how many setpoints of a flight are encoded, where so many are to be certified."""
    return following + STOP  # stops lead half as far on


def _first_rows(encoded: EncodedFlight, count: int) -> EncodedFlight:
    """Return the first setpoints of a flight."""

    def first(setpoints: FullStateSetpoints) -> FullStateSetpoints:
        return FullStateSetpoints(*(getattr(setpoints, name)[:count] for name in FullStateSetpoints.__slots__))

    return replace(
        encoded, times=encoded.times[:count], payloads=encoded.payloads[:count], decoded=first(encoded.decoded),
        motion=first(encoded.motion),
    )  # fmt: skip


def _certified(
    encoded: EncodedFlight,
    payloads: NDArray,
    limits: Limits,
    starts: NDArray | None,
    check: Callable[[], None],
    motion: FullStateSetpoints | None = None,
    foreseen: Sequence[Work] = (),
) -> tuple[NDArray, LinkLossMoments]:
    """Return a stop from each setpoint of `encoded`, and link loss of `payloads`, which begin with those setpoints.

    `motion` is that of the setpoints behind them too, where the stops lead along it. Raises as certify_whole() does,
    and what `check` raises, and first what is `foreseen`.
    """

    # What is mostly compiled loops goes on beside what is mostly Python: two threads of that would hinder each other.
    losing, *others = beside().begin(
        partial(link_loss_at_walls, payloads, limits, starts=starts),
        partial(meet_gaps, payloads, limits, starts),
        *foreseen,
    )
    refused: CfplanError | None = None
    within: Assessment | None = None
    try:
        along = encoded.motion if motion is None else motion
        count = len(encoded.payloads)
        stops, passed = encode_certified_stops(along, limits, RATE, encoded.gains, encoded.space, count=count)
        passed.require(limits)
        check()
        lost = losing.result()
        if lost.worst.beyond <= 0.0 and not limits.link_loss.only_warn:
            within = assess_link_loss_of_stops(encoded, limits, lost, margin=0.0, stops=stops)
    except CfplanError as error:
        refused = error
    finally:
        for each in (losing, *others):
            each.exception()  # nothing goes on behind the caller's back
    for each in reversed(others):
        each.result()
    if refused is not None:
        raise refused
    require_inside(lost, limits)
    if within is not None and not within.passed:
        what = f"{within.what} from {within.time[within.worst]:.2f} s on {within.describe(within.worst)}"
        raise EndsBadlyError(what, where="link loss", hint=OUTSIDE_HINT)
    return stops, lost


def require_inside(lost: LinkLossMoments, limits: Limits) -> None:
    """Raise EndsBadlyError where link loss ends outside the walls."""
    if not lost.worst.beyond <= 0.0 and not limits.link_loss.only_warn:
        raise EndsBadlyError(str(lost.worst), where="link loss", hint=OUTSIDE_HINT)


def foresee_link_loss(payloads: NDArray, limits: Limits, starts: NDArray) -> None:
    """Raise EndsBadlyError where link loss is foreseen to end outside the walls by far."""
    foreseen = foreseen_link_loss(payloads, limits, starts=starts).worst
    if foreseen.beyond > _FORESEEN:
        raise EndsBadlyError(str(foreseen), where="link loss", hint=OUTSIDE_HINT)


def meet_gaps(payloads: NDArray, limits: Limits, starts: NDArray | None) -> None:
    """Raise EndsBadlyError where a gap in setpoints or poses loses the vehicle."""
    believed = None if starts is None else as_believed(starts, limits)
    glitches = glitch_where_nearly_lost(payloads, limits, start=believed)
    if glitches.lost.any():
        raise EndsBadlyError(str(glitches), where="glitches", hint="plan with a lower speed or acceleration")
