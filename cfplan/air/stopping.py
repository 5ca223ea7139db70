"""Stops on request: the vehicle comes to rest on its path as soon as possible.

Each setpoint has a stop anyway; a stop on request is the shortest one that keeps the limits of stops and that the
vehicle can follow.
"""

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cfplan.air.certifying import STOP, Onward, meet_gaps, require_inside
from cfplan.air.timeline import LOOKS_BACK, Replanned, Timeline
from cfplan.errors import InfeasibleError, NotCertifiedError
from cfplan.flight.setpoints.commitment import propose
from cfplan.flight.setpoints.encoding import HOLD, RATE, EncodedFlight
from cfplan.flight.setpoints.stop_certificate import certify_stops
from cfplan.flight.setpoints.stops import DURATION, encode_stops, rest_behind
from cfplan.safety.limits import Limits
from cfplan.simulation.dry_run import Rehearsal, rehearse_setpoints
from cfplan.simulation.link_loss import as_believed, as_most_sluggish, link_loss_at_walls

STOPS = (0.46, 0.48, 0.5, 0.52, 0.54, 0.55, 0.56, 0.58, 0.6, 0.65, 0.7, 0.8, 1.0, DURATION)
"""s, durations of stops, tried in order. From 2 m/s on a straight line a stop of 0.54 s brakes at 6.9 m/s², a tilt of
35°; the deceleration differs if the vehicle turns or slows down already. A stop of constant deceleration would be
planned to end 0.1 m sooner, but because motors lag the vehicle would overshoot it by as much."""
DEVIATION_MARGIN = 0.025  # m, by which a shortened stop may increase the deviation in its dry run
"""Above that, motors saturate, and a little noise increases the deviation: two stops that deviated by 2.8 and 4.0 cm in
the dry run deviated by 8.9 and 6.1 cm in flight."""
DEVIATION_MARGIN_SLUGGISH = 0.16  # m, likewise with the longest motor lag
"""This lag shows saturation more clearly. Of 440 stops the two that deviated most in flight, by 8.3 and 4.6 cm, did so
by 0.24 and 0.22 m in this dry run; the 437 that deviated by less than 0.16 m in it, by 4.0 cm at most in flight."""


def halt(timeline: Timeline, splice: int, limits: Limits) -> Replanned | Timeline:
    """Return the proposal to leave a timeline at setpoint `splice` and to rest as soon as possible on its path.

    If the stop behind the committed part of a plan ends as soon, returns the timeline without the rest of that plan.
    Raises InfeasibleError if the vehicle rests as soon anyway, or if no stop passes: then it rests at the end of its
    commitment.
    """
    timeline = timeline.for_plans_from(splice, limits)
    splice, _ = timeline.leaving(splice, keep=False)
    ends = _rests_next(timeline, splice)
    if sooner := [duration for duration in STOPS if duration < ends - splice / RATE]:
        onward = timeline.onward(splice, timeline.motion)
        encoded = onward.encoded(limits)
        for duration in sooner:
            with suppress(InfeasibleError, NotCertifiedError):
                return _stop_along(encoded, onward, timeline, splice, duration, limits)
    if timeline.unfinished:
        return timeline.cut_short(limits, going_on=False)
    raise InfeasibleError(
        f"{max(ends - splice / RATE, 0.0):.1f} s before its end, the vehicle cannot stop sooner",
        where="stop",
        hint="it rests at the end of what is committed",
    )


def stop_within(timeline: Timeline, splice: int, duration: float, limits: Limits) -> Replanned:
    """Return the proposal to stop along the path from the setpoint behind `splice` on, within `duration`, s.

    Raises NotCertifiedError if the stop exceeds the limits of stops or its dry run fails, InfeasibleError if link loss
    or a gap within it would end badly.
    """
    onward = timeline.onward(splice, timeline.motion)
    return _stop_along(onward.encoded(limits), onward, timeline, splice, duration, limits)


def _rests_next(timeline: Timeline, splice: int) -> float:
    """Return when a vehicle that flies on at setpoint `splice` comes to rest, s from setpoint 0."""
    ahead = [(end - LOOKS_BACK) / RATE for begin, end in timeline.stops if begin > splice]
    return min([timeline.ends if timeline.part_ends is None else (timeline.part_ends + STOP) / RATE, *ahead])


def _stop_along(
    encoded: EncodedFlight, onward: Onward, timeline: Timeline, splice: int, duration: float, limits: Limits
) -> Replanned:
    """Return the same as stop_within(); `encoded` are the setpoints of `onward`, from the splice on."""
    motion, gains, space = encoded.motion, encoded.gains, encoded.space
    first, second = np.array([0]), np.array([1])
    stop = encode_stops(motion, RATE, duration, second, gains, space)
    certify_stops(stop, motion, limits, RATE, rows=second, gains=gains, space=space).require(limits)
    rows, rest = stop[0], stop[0, -1:]
    hovering = np.repeat(rest, round(HOLD * RATE), axis=0)
    payloads = np.concatenate([encoded.payloads[:1], rows, hovering])
    # From within a stop, the remainder is the stop; a hover pads it to the length of the others.
    whole = encode_stops(motion, RATE, DURATION, first, gains, space)
    padded = np.concatenate([rows, np.repeat(rest, whole.shape[1], axis=0)])
    after = [padded[min(row, len(rows)) :][: whole.shape[1]] for row in range(len(payloads) - 1)]
    stops = np.concatenate([whole, np.stack(after)])
    starts = onward.starts
    assert starts is not None
    _rehearse_stop(payloads, duration, limits, starts, timeline.motion.at(splice / RATE).position)
    lost = link_loss_at_walls(payloads, limits, starts=starts)
    require_inside(lost, limits)
    meet_gaps(payloads, limits, starts)
    resting = timeline.resting(rest_behind(motion, 1, RATE, duration), (splice + 1, splice + len(rows)), limits)
    later = replace(resting, begin=splice, snapshots=lost.snapshots)
    proposal = propose(timeline.commitment, splice, payloads, stops, len(stops) - 2)
    return Replanned(proposal, later, None, splice / RATE)


def _rehearse_stop(payloads: NDArray, duration: float, limits: Limits, starts: NDArray, begin: NDArray) -> None:
    """Raise NotCertifiedError if the dry run of a stop fails, or if a shortened stop deviates too far in it.

    `begin`, (3,) m, is the desired place when the payloads begin: an initial distance from it is no fault of the stop.
    The certificate holds the motors' range along the planned motion, but motors lag. If a short stop swings from one
    side to the other at low thrust, attitude control saturates a motor; then the firmware lowers the thrust of all, and
    the vehicle sinks: by 0.2 m at the top of a climb.
    """
    believed = as_believed(starts, limits)
    run = rehearse_setpoints(payloads, limits.airframe, limits.flight, snapshot=believed)
    run.require_passed()
    if duration >= DURATION:
        return
    _require_near(run, math.dist(believed[:3], begin) + DEVIATION_MARGIN, duration)
    airframe, sluggish = as_most_sluggish(starts, limits)
    run = rehearse_setpoints(payloads, airframe, limits.flight, snapshot=sluggish)
    _require_near(run, math.dist(sluggish[:3], begin) + DEVIATION_MARGIN_SLUGGISH, duration)


def _require_near(run: Rehearsal, most: float, duration: float) -> None:
    """Raise NotCertifiedError if a stop of `duration`, s, deviates by more than `most`, m, in its dry run."""
    if not run.deviation <= most:
        raise NotCertifiedError(
            f"within {duration:g} s the vehicle strays {run.deviation:.3f} m from the stop, more than {most:.3f} m",
            where="dry run",
            hint="stop within a longer time",
        )
