"""Certify a flight that continues the present one: bytes, stops, link loss, gaps and the dry run.

Either the whole flight is certified, or only its beginning with a stop behind it: that commitment ends at rest too, and
a short beginning takes little time to certify. More of the flight replaces the stop before the vehicle reaches it. The
first setpoint is the committed one, to the byte: it was certified with its own look-ahead.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.air.background import Check, background_checks
from cfplan.errors import CfplanError, InfeasibleError
from cfplan.flight.setpoints.byte_check import check_bytes, check_setpoints
from cfplan.flight.setpoints.commitment import left_of
from cfplan.flight.setpoints.encoding import HOLD, RATE, EncodedFlight, encode_trajectory
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.setpoints.stop_certificate import encode_certified_stops
from cfplan.flight.setpoints.stops import DURATION, encode_stops, rest_behind
from cfplan.flight.telemetry import Triple
from cfplan.preparation.link_loss_assessment import OUTSIDE_HINT, assess_link_loss_of_stops
from cfplan.safety.limits import Limits
from cfplan.safety.space import inside
from cfplan.simulation.dry_run import rehearse_motion, rehearse_setpoints
from cfplan.simulation.glitches import glitch_near_critical_setpoints
from cfplan.simulation.link_loss import LinkLossMoments, as_believed, foreseen_link_loss, link_loss_at_walls
from cfplan.vehicle.joint import JoinedTrajectory

STOP = round(DURATION * RATE)  # setpoints from the place where a stop begins to where it rests
STOP_AND_HOVER = STOP + 1 + round(HOLD * RATE)  # setpoints of a beginning behind those that follow the motion
_FORESEEN = 0.05  # m beyond a wall; if link loss is only estimated, less than this is ignored


class EndsBadlyError(InfeasibleError):
    """Link loss or a gap would take the vehicle outside the walls, or turn it over."""


@dataclass(frozen=True, slots=True, eq=False)
class CertifiedFlight:
    """Setpoints that end at rest, a stop from each, and the simulated vehicle at each."""

    payloads: NDArray  # (N, 29) uint8
    stops: NDArray  # (N, M, 29) uint8
    snapshots: NDArray  # (L, N, 31), the simulated vehicle at each setpoint, for each motor lag
    following: int | None  # number of setpoints that follow the motion, before the stop; None: all do
    rest: tuple[Triple, float] | None = None  # m, rad: place and yaw at which that stop ends

    @property
    def ending(self) -> int:
        """Return the number of stops at the end that are only the remainder of the stop before them."""
        return 0 if self.following is None else len(self.payloads) - self.following - 1


@dataclass(frozen=True, slots=True, eq=False)
class Onward:
    """A motion that continues from a setpoint."""

    motion: JoinedTrajectory  # its clock is 0 at that setpoint
    starts: NDArray | None = None  # (L, 31) the simulated vehicle there, for each motor lag; None: it hovers
    committed: NDArray | None = None  # (29,) uint8, that setpoint as committed; None if nothing is committed

    def encoded(self, limits: Limits, count: int | None = None) -> EncodedFlight:
        """Return its setpoints, at most `count` of them; the first is the committed one."""
        encoded = encode_trajectory(self.motion, gains=gains_under(limits), space=limits.space, count=count)
        if self.committed is None:
            return encoded
        payloads = encoded.payloads.copy()
        payloads[0] = self.committed
        return replace(encoded, payloads=payloads, decoded=decode(payloads))

    def to_check(self, encoded: EncodedFlight) -> EncodedFlight:
        """Return the setpoints that were made from this motion: all but the committed one."""
        return encoded if self.committed is None else _rows(encoded, slice(1, None))


def certify_whole(onward: Onward, limits: Limits) -> CertifiedFlight:
    """Certify a whole flight like a plan before take-off.

    Raises EndsBadlyError or NotCertifiedError if it does not pass.
    """
    encoded, motion = onward.encoded(limits), onward.motion
    believed = None if onward.starts is None else as_believed(onward.starts, limits)

    def check() -> None:
        check_bytes(onward.to_check(encoded), motion, limits.plan)
        # One vehicle that knows its true state, in some 10 ms: the draws of the dry run before take-off take 40 times
        # as long. What they add to its deviation was accepted for the flight's limits then.
        rehearse_motion(encoded, motion, limits.airframe, limits.flight, snapshot=believed).require_passed()

    stops, lost = _certified(encoded, encoded.payloads, limits, onward.starts, check)
    return CertifiedFlight(encoded.payloads, stops, lost.snapshots, None)


def certify_beginning(onward: Onward, following: int, limits: Limits, *, foresee: bool = True) -> CertifiedFlight:
    """Certify the first `following` setpoints of a flight in motion and the stop behind them.

    A flight that is hardly longer than that is certified whole. Raises as certify_whole() does. With `foresee`, link
    loss is also estimated for the rest of the flight, which is refused if that would end far outside the walls.
    """
    if following + STOP >= onward.motion.duration * RATE:
        return certify_whole(onward, limits)
    starts = onward.starts
    assert starts is not None
    foresee = foresee and not limits.link_loss.only_warn
    encoded = onward.encoded(limits, None if foresee else following + STOP)  # enough: stops advance half as far
    foreseen = [partial(foresee_link_loss, encoded.payloads, limits, starts)] if foresee else []
    beginning = _Beginning.of(encoded, following)

    def check() -> None:
        check_setpoints(onward.to_check(beginning.encoded), onward.motion, limits.plan)
        believed = as_believed(starts, limits)
        rehearse_setpoints(beginning.payloads, limits.airframe, limits.flight, snapshot=believed).require_passed()

    stops, lost = _certified(
        beginning.encoded, beginning.payloads, limits, starts, check, motion=beginning.motion, foreseen=foreseen
    )
    return beginning.certified(stops, lost.snapshots)


class _Beginning(NamedTuple):
    """The first setpoints of a flight, which are to be certified, and the stop behind them."""

    payloads: NDArray  # (N, 29) uint8, with the stop and the hover behind it
    encoded: EncodedFlight  # the setpoints before the stop
    motion: FullStateSetpoints  # as far as the stops from those setpoints reach
    stop: NDArray  # (M, 29) uint8
    rest: tuple[Triple, float]  # m, rad: place and yaw at which the stop ends

    @classmethod
    def of(cls, encoded: EncodedFlight, following: int) -> "_Beginning":
        """Return the beginning of an encoded flight, which must reach as far as the stops from it do."""
        motion, gains, space = _motion_rows(encoded.motion, slice(following + STOP)), encoded.gains, encoded.space
        stop = encode_stops(motion, RATE, rows=np.array([following]), gains=gains, space=space)[0]
        hovering = np.repeat(stop[-1:], STOP_AND_HOVER - len(stop), axis=0)
        payloads = np.concatenate([encoded.payloads[:following], stop, hovering])
        begun = _rows(encoded, slice(following + 1))
        return cls(payloads, begun, motion, stop, rest_behind(motion, following, RATE))

    def certified(self, stops: NDArray, snapshots: NDArray) -> CertifiedFlight:
        """Return the certified flight; `stops`, (K, M, 29), are those from the setpoints before the stop."""
        behind = left_of(self.stop, STOP_AND_HOVER - 1)
        following = len(stops) - 1
        return CertifiedFlight(self.payloads, np.concatenate([stops, behind]), snapshots, following, self.rest)


def _rows(encoded: EncodedFlight, rows: slice) -> EncodedFlight:
    """Return some of the setpoints of a flight."""
    return replace(
        encoded, times=encoded.times[rows], payloads=encoded.payloads[rows],
        decoded=_motion_rows(encoded.decoded, rows), motion=_motion_rows(encoded.motion, rows),
    )  # fmt: skip


def _motion_rows(setpoints: FullStateSetpoints, rows: slice) -> FullStateSetpoints:
    return FullStateSetpoints(*(getattr(setpoints, name)[rows] for name in FullStateSetpoints.__slots__))


def _certified(
    encoded: EncodedFlight,
    payloads: NDArray,
    limits: Limits,
    starts: NDArray | None,
    check: Callable[[], None],
    *,  # for a beginning only
    motion: FullStateSetpoints | None = None,
    foreseen: Sequence[Check] = (),
) -> tuple[NDArray, LinkLossMoments]:
    """Return a stop from each setpoint of `encoded`, and link loss of `payloads`, which begin with those setpoints.

    `motion` also covers the setpoints after these, if the stops reach that far. Raises as certify_whole() does, and
    whatever `check` raises; errors of the checks in `foreseen` come first.
    """

    # Compiled loops run beside code that is mostly Python: two threads of Python would hold each other up.
    losing, *others = background_checks().begin(
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
            each.exception()  # no check may outlast this call
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


def _require_all_inside(encoded: EncodedFlight, stops: NDArray, limits: Limits, lost: LinkLossMoments) -> None:
    """Raise EndsBadlyError if link loss ends outside the walls, also during any of the stops."""
    require_inside(lost, limits)
    if limits.link_loss.only_warn:
        return
    within = assess_link_loss_of_stops(encoded, limits, lost, margin=0.0, stops=stops)
    if not within.passed:
        what = f"{within.what} from {within.time[within.worst]:.2f} s on {within.describe(within.worst)}"
        raise EndsBadlyError(what, where="link loss", hint=OUTSIDE_HINT)


def require_inside(lost: LinkLossMoments, limits: Limits) -> None:
    """Raise EndsBadlyError if link loss ends outside the walls."""
    if not inside(lost.worst.beyond) and not limits.link_loss.only_warn:
        raise EndsBadlyError(str(lost.worst), where="link loss", hint=OUTSIDE_HINT)


def foresee_link_loss(payloads: NDArray, limits: Limits, starts: NDArray) -> None:
    """Raise EndsBadlyError if link loss is estimated to end far outside the walls."""
    foreseen = foreseen_link_loss(payloads, limits, starts=starts).worst
    if not inside(foreseen.beyond, _FORESEEN):
        raise EndsBadlyError(str(foreseen), where="link loss", hint=OUTSIDE_HINT)


def meet_gaps(payloads: NDArray, limits: Limits, starts: NDArray | None) -> None:
    """Raise EndsBadlyError if the vehicle is lost after a gap in setpoints or poses."""
    believed = None if starts is None else as_believed(starts, limits)
    glitches = glitch_near_critical_setpoints(payloads, limits, start=believed)
    if glitches.lost.any():
        raise EndsBadlyError(str(glitches), where="glitches", hint="plan with a lower speed or acceleration")
