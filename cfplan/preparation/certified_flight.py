"""Certify a flight that goes on from one that is flown: bytes, stops, link loss, gaps and the dry run.

All of it may be certified, or its beginning alone, with the stop behind that: what a pilot is bound to then ends at
rest too, and takes as little time to certify as the beginning is short. More of the flight replaces the stop before the
vehicle gets there. What is simulated of a beginning may go on beside, while what follows on it is planned already.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

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
from cfplan.preparation.beside import Pending, Work, beside
from cfplan.preparation.link_loss_assessment import OUTSIDE_HINT, assess_link_loss_of_stops
from cfplan.safety.limits import Limits
from cfplan.safety.space import inside
from cfplan.simulation.dry_run import dry_run, rehearse_setpoints
from cfplan.simulation.glitches import glitch_at_sampled_setpoints
from cfplan.simulation.link_loss import LinkLossMoments, as_believed, foreseen_link_loss, link_loss_at_walls
from cfplan.vehicle.joint import JoinedTrajectory

STOP = round(DURATION * RATE)  # setpoints from the place where a stop begins to where it rests
BEHIND = STOP + 1 + round(HOLD * RATE)  # setpoints of a beginning behind those that follow the motion
_FORESEEN = 0.05  # m beyond a wall, from which on link loss that is only foreseen counts


class EndsBadlyError(InfeasibleError):
    """After link loss or a gap the vehicle would end outside the walls, or turn over."""


class UnfoundedError(Exception):
    """What a flight goes on from has not passed what was simulated of it meanwhile."""


class Simulated:
    """The simulated vehicle at each setpoint of a flight; of the last ones it may be simulated beside still."""

    def __init__(self, last: NDArray | Pending, before: NDArray | None = None):
        """Join the snapshots before, (L, K, 31) for each motor lag, and the last, (L, N, 31), which may be to come."""
        self.coming = None if isinstance(last, np.ndarray) else last  # what raises where they do not pass
        self._last, self._before = last, before

    @property
    def snapshots(self) -> NDArray:
        """Return (L, K + N, 31), waiting for them if need be. Raises UnfoundedError where the last do not pass."""
        if not isinstance(self._last, np.ndarray):
            try:
                self._last = np.asarray(self._last.result())
            except Exception as error:
                raise UnfoundedError from error
        if self._before is not None:
            self._last, self._before = np.concatenate([self._before, self._last], axis=1), None
        return self._last

    def behind(self, before: NDArray) -> "Simulated":
        """Return the same behind others, (L, K, 31)."""
        return Simulated(self._last, before)


@dataclass(frozen=True, slots=True, eq=False)
class CertifiedFlight:
    """Setpoints that end at rest, a stop from each, and the simulated vehicle at each."""

    payloads: NDArray  # (N, 29) uint8
    stops: NDArray  # (N, M, 29) uint8
    simulated: Simulated
    following: int | None  # how many of the setpoints follow the motion, before the stop; None where all do
    rest: tuple[Triple, float] | None = None  # m, rad: place and yaw where that stop rests

    @property
    def snapshots(self) -> NDArray:
        """Return (L, N, 31), the simulated vehicle at each setpoint, as Simulated.snapshots."""
        return self.simulated.snapshots


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
    return CertifiedFlight(encoded.payloads, stops, Simulated(lost.snapshots), None)


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
    foresee = foresee and not limits.link_loss.only_warn
    if encoded is None or foresee:
        encoded = encode_trajectory(
            flown, gains=gains_under(limits), space=limits.space, count=None if foresee else encoded_for(following)
        )
    foreseen = [partial(foresee_link_loss, encoded.payloads, limits, starts)] if foresee else []
    beginning = _Beginning.of(encoded, following)

    def check() -> None:
        check_setpoints(beginning.encoded, flown, limits.plan)
        _rehearse(beginning.payloads, limits, starts)

    stops, lost = _certified(beginning.encoded, beginning.payloads, limits, starts, check, beginning.motion, foreseen)
    return beginning.certified(stops, Simulated(lost.snapshots))


def certify_meanwhile(
    flown: JoinedTrajectory, following: int, limits: Limits, starts: Callable[[], NDArray], encoded: EncodedFlight
) -> CertifiedFlight:
    """Certify the beginning of a flight like certify_beginning() without `foresee`; simulations go on beside.

    `starts` is asked for the snapshots that they go on from once there is nothing else to do. They raise what does not
    pass in them where their result is asked for.
    """
    if following + STOP >= flown.duration * RATE:
        return certify_whole(flown, limits, starts())
    beginning = _Beginning.of(encoded, following)
    stops = _stops_along(beginning.encoded, beginning.motion, limits)
    check_setpoints(beginning.encoded, flown, limits.plan)
    work = partial(_simulate, beginning.payloads, beginning.encoded, stops, limits, starts())
    return beginning.certified(stops, Simulated(beside().begin(work)[0]))


class _Beginning(NamedTuple):
    """So many setpoints of a flight as are to be certified, and the stop behind them."""

    payloads: NDArray  # (N, 29) uint8, with the stop and the hover behind it
    encoded: EncodedFlight  # before the stop
    motion: FullStateSetpoints  # as far as stops from them lead
    stop: NDArray  # (M, 29) uint8
    rest: tuple[Triple, float]  # m, rad: where that rests

    @classmethod
    def of(cls, encoded: EncodedFlight, following: int) -> "_Beginning":
        """Return it, from the setpoints of a flight, at least as many as encoded_for() says."""
        motion, gains, space = _first(encoded.motion, encoded_for(following)), encoded.gains, encoded.space
        stop = encode_stops(motion, RATE, rows=np.array([following]), gains=gains, space=space)[0]
        hovering = np.repeat(stop[-1:], BEHIND - len(stop), axis=0)
        payloads = np.concatenate([encoded.payloads[:following], stop, hovering])
        begun = _first_rows(encoded, following + 1)
        return cls(payloads, begun, motion, stop, rest_behind(motion, following, RATE))

    def certified(self, stops: NDArray, simulated: Simulated) -> CertifiedFlight:
        """Return it certified, with the stops from its setpoints before the stop, (K, M, 29)."""
        behind = left_of(self.stop, BEHIND - 1)
        following = len(stops) - 1
        return CertifiedFlight(self.payloads, np.concatenate([stops, behind]), simulated, following, self.rest)


def encoded_for(following: int) -> int:
    """Return how many setpoints of a flight are encoded, where so many are to be certified."""
    return following + STOP  # stops lead half as far on


def _first_rows(encoded: EncodedFlight, count: int) -> EncodedFlight:
    """Return the first setpoints of a flight."""
    return replace(
        encoded, times=encoded.times[:count], payloads=encoded.payloads[:count], decoded=_first(encoded.decoded, count),
        motion=_first(encoded.motion, count),
    )  # fmt: skip


def _first(setpoints: FullStateSetpoints, count: int) -> FullStateSetpoints:
    return FullStateSetpoints(*(getattr(setpoints, name)[:count] for name in FullStateSetpoints.__slots__))


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
    try:
        stops = _stops_along(encoded, encoded.motion if motion is None else motion, limits)
        check()
        lost = losing.result()
        _require_all_inside(encoded, stops, limits, lost)
    except CfplanError as error:
        refused = error
    finally:
        for each in (losing, *others):
            each.exception()  # nothing goes on behind the caller's back
    for each in reversed(others):
        each.result()
    if refused is not None:
        raise refused
    return stops, lost


def _stops_along(encoded: EncodedFlight, motion: FullStateSetpoints, limits: Limits) -> NDArray:
    """Return a certified stop from each setpoint, (N, M, 29), along the motion. Raises NotCertifiedError."""
    count = len(encoded.payloads)
    stops, passed = encode_certified_stops(motion, limits, RATE, encoded.gains, encoded.space, count=count)
    passed.require(limits)
    return stops


def _simulate(payloads: NDArray, encoded: EncodedFlight, stops: NDArray, limits: Limits, starts: NDArray) -> NDArray:
    """Return the simulated vehicle at each setpoint, (L, N, 31), where all that is simulated of them passes.

    `payloads` begin with what is `encoded`, with these stops. Raises as certify_whole() does.
    """
    lost = link_loss_at_walls(payloads, limits, starts=starts)
    _require_all_inside(encoded, stops, limits, lost)
    _rehearse(payloads, limits, starts)
    meet_gaps(payloads, limits, starts)
    return lost.snapshots


def _rehearse(payloads: NDArray, limits: Limits, starts: NDArray) -> None:
    """Raise NotCertifiedError where the dry run does not pass."""
    believed = as_believed(starts, limits)
    rehearse_setpoints(payloads, limits.airframe, limits.flight, snapshot=believed).require_passed()


def _require_all_inside(encoded: EncodedFlight, stops: NDArray, limits: Limits, lost: LinkLossMoments) -> None:
    """Raise EndsBadlyError where link loss ends outside the walls, also while the vehicle flies one of the stops."""
    require_inside(lost, limits)
    if limits.link_loss.only_warn:
        return
    within = assess_link_loss_of_stops(encoded, limits, lost, margin=0.0, stops=stops)
    if not within.passed:
        what = f"{within.what} from {within.time[within.worst]:.2f} s on {within.describe(within.worst)}"
        raise EndsBadlyError(what, where="link loss", hint=OUTSIDE_HINT)


def require_inside(lost: LinkLossMoments, limits: Limits) -> None:
    """Raise EndsBadlyError where link loss ends outside the walls."""
    if not inside(lost.worst.beyond) and not limits.link_loss.only_warn:
        raise EndsBadlyError(str(lost.worst), where="link loss", hint=OUTSIDE_HINT)


def foresee_link_loss(payloads: NDArray, limits: Limits, starts: NDArray) -> None:
    """Raise EndsBadlyError where link loss is foreseen to end outside the walls by far."""
    foreseen = foreseen_link_loss(payloads, limits, starts=starts).worst
    if not inside(foreseen.beyond, _FORESEEN):
        raise EndsBadlyError(str(foreseen), where="link loss", hint=OUTSIDE_HINT)


def meet_gaps(payloads: NDArray, limits: Limits, starts: NDArray | None) -> None:
    """Raise EndsBadlyError where a gap in setpoints or poses loses the vehicle."""
    believed = None if starts is None else as_believed(starts, limits)
    glitches = glitch_at_sampled_setpoints(payloads, limits, start=believed)
    if glitches.lost.any():
        raise EndsBadlyError(str(glitches), where="glitches", hint="plan with a lower speed or acceleration")
