"""Commitment: the setpoints that a pilot is bound to fly, which end at rest in the space; proposals replace its end.

Setpoints are numbered from the start of the stream. A proposal continues a commitment from a splice, the number of a
setpoint ahead of the clock; the joint is the moment of the motion at which that setpoint was sampled.

    before the joint   setpoints and their stops stay as committed, to the byte
    at the joint       the proposal's first setpoint equals the committed one within a quantum, so nothing jumps
    after the joint    the setpoints and stops of the proposal replace the committed ones

The planner may be late, mistaken or broken, so the pilot verifies from the bytes alone that

- the bytes are the certified ones (checksum), and were made for this commitment (order);
- the splice is still ahead of the clock (time), and not farther than a minute;
- position, velocity, acceleration, attitude and body rates there are the committed ones within a quantum (joint);
- the setpoints end at rest (end), and from each of them there is a stop that begins there and ends at rest (stops);
- positions agree with velocities from setpoint to setpoint (motion), inside the space (space), within the limits of
  plans, and in stops within those of stops (limits).

If any check fails, the old commitment is flown to its end. A commitment is immutable: splicing makes a new one.
"""

import struct
import zlib
from bisect import bisect_left
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.encoding import RATE, controller_attitude
from cfplan.flight.setpoints.motion_certificate import SPAN, MotionExtremes, excess_of, motion_extremes
from cfplan.flight.setpoints.packets import (
    ATTITUDE_QUANTUM,
    FULL_STATE_TYPE,
    PAYLOAD_SIZE,
    FullStateSetpoints,
    decode,
    positions_of,
)
from cfplan.flight.setpoints.rate_trade import turns_for
from cfplan.flight.setpoints.stops import DURATION
from cfplan.safety.limits import Limits
from cfplan.safety.space import inside
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import rotations_of, yaw_of

LEAST_AHEAD = 0  # least setpoints from the one just sent to a splice; the first new one follows the splice
FARTHEST_AHEAD = 6000  # most setpoints from the clock to a splice: a minute
MOST_SETPOINTS = 4000  # of a proposal, 40 s; a planner proposes parts that are shorter. Bounds the time to verify it
LONGEST_ENDING = 1000  # most unsent stops of a proposal
LONGEST_STOP = round(DURATION * RATE) + 1  # most setpoints of a stop; bounds the memory for unsent stops
KEPT_BEHIND = 100  # setpoints kept before the one due, for a vehicle that fell behind
QUANTUM = 1e-3  # m, m/s, m/s², rad/s: of the fields of a packet
LEVEL = 0.01  # rad, largest tilt in hover: twice the rounding of an attitude
LARGEST_JERK = 400.0  # m/s³, between consistent velocities: ten times what plans reach
_PERIOD = 1.0 / RATE
# m, between a position and the integral of velocities: the error of the trapezoidal rule, jerk times period³ / 12, plus
# rounding.
_JUMP = LARGEST_JERK * _PERIOD**3 / 12 + QUANTUM * (1.0 + _PERIOD)
_ROUNDING = 1e-9
_SAME_HEADING = 0.1  # rad; a stop and its setpoint trade different rates, which differ in heading by up to 0.02
_MAGIC = b"proposal"
_CHAIN = struct.Struct("<II")  # checksums of a commitment and of the proposal that continues it
# magic, `follows`, checksum, splice, setpoints, setpoints per stop, stops sent, `goes_on`, `unfinished`
_HEAD = struct.Struct("<8sIIQIII??")


class Fault(StrEnum):
    """Reasons to refuse a proposal."""

    SHAPE = "the proposal does not consist of setpoints with stops"
    CHECKSUM = "the proposal is not what was certified: its checksum differs"
    ORDER = "the proposal continues another commitment than the present one"
    LATE = "the proposal came too late"
    OUTSIDE = "the proposal begins where nothing is committed yet, or no more"
    JOINT = "the proposal does not begin with the committed setpoint"
    MOTION = "the proposed setpoints do not follow from one another"
    SPACE = "the proposal leaves the space"
    END = "the proposal does not end at rest"
    STOPS = "the stops do not begin with their setpoints, or do not end at rest"
    LIMITS = "the proposal exceeds a limit"


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a proposal is not flown; the commitment does not change."""

    fault: Fault
    detail: str  # the numbers

    def __str__(self) -> str:
        return f"{self.fault}: {self.detail}" if self.detail else str(self.fault)


@dataclass(frozen=True, slots=True, eq=False)
class Commitment:
    """Encoded setpoints that end at rest, with a stop from each.

    Raises NotCertifiedError if the arrays are not setpoints with stops.
    """

    first: int  # number of the first kept setpoint
    payloads: NDArray  # (N, 29) uint8
    stops: NDArray  # (N, M, 29) uint8
    splices: tuple[int, ...] = ()  # numbers of the first setpoints of plans made in the air
    checksum: int = -1  # of its whole history; -1: compute it from the arrays
    unfinished: bool = False  # whether it ends before its plan does: the planner is to propose the next part

    def __post_init__(self) -> None:
        if wrong := _wrong_shape(self.first, self.payloads, self.stops):
            raise NotCertifiedError(wrong, where="commitment", hint="encode the plan and its stops anew")
        for name in ("payloads", "stops"):
            object.__setattr__(self, name, _frozen(getattr(self, name)))
        if self.checksum < 0:
            object.__setattr__(self, "checksum", checksum_of(self.first, self.payloads, self.stops))

    @property
    def last(self) -> int:
        """Return the number of the last setpoint, a hover."""
        return self.first + len(self.payloads) - 1

    @property
    def motion_ends(self) -> int:
        """Return the number of the first of the setpoints that only hover at the end."""
        moving = np.flatnonzero(np.any(decode(self.payloads).velocity != 0.0, axis=1))
        return self.first + (int(moving[-1]) + 1 if len(moving) else 0)


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """A replacement for the rest of a commitment from setpoint `splice` on."""

    follows: int  # checksum of the commitment that it continues
    splice: int  # number of its first setpoint
    payloads: NDArray  # (K, 29) uint8
    stops: NDArray  # (K, M, 29) uint8
    checksum: int  # of splice, payloads and stops
    ending: int = 0  # number of last stops that are the remainder of the stop before them, see left_of()
    goes_on: bool = False  # whether it is the next part of the present plan, which is not announced
    unfinished: bool = False  # whether it ends before its plan does

    def to_bytes(self) -> bytes:
        """Return the proposal as a message to the pilot's process, kept short as copying costs milliseconds."""
        sent = len(self.stops) - self.ending
        shape, flags = self.stops.shape[:2], (self.goes_on, self.unfinished)
        head = _HEAD.pack(_MAGIC, self.follows, self.checksum, self.splice, *shape, sent, *flags)
        return b"".join((head, self.payloads.tobytes(), self.stops[:sent].tobytes()))

    @classmethod
    def of_bytes(cls, message: bytes) -> "Proposal | None":
        """Return the proposal in a message, unverified; None if there is none."""
        if len(message) < _HEAD.size or message[: len(_MAGIC)] != _MAGIC:
            return None
        _, follows, checksum, first, count, length, sent, goes_on, unfinished = _HEAD.unpack_from(message)
        if not 0 < length <= LONGEST_STOP or not 0 < sent <= count <= MOST_SETPOINTS or count - sent > LONGEST_ENDING:
            return None
        if len(message) != _HEAD.size + (count + sent * length) * PAYLOAD_SIZE:
            return None
        rows = np.frombuffer(message, np.uint8, offset=_HEAD.size).reshape(-1, PAYLOAD_SIZE)
        stops, ending = rows[count:].reshape(sent, length, PAYLOAD_SIZE), count - sent
        if ending:
            stops = np.concatenate([stops, left_of(stops[-1], ending)])
        return cls(follows, first, rows[:count], stops, checksum, ending, goes_on, unfinished)


def propose(
    commitment: Commitment,
    splice: int,
    payloads: NDArray,
    stops: NDArray,
    ending: int = 0,
    *,
    goes_on: bool = False,
    unfinished: bool = False,
) -> Proposal:
    """Return a proposal of certified setpoints and stops that continue the commitment from `splice` on.

    `ending` is the number of last stops that are the remainder of the stop before them; `goes_on` marks the next part
    of the present plan, and `unfinished` one with more of its plan to follow.
    """
    checksum = checksum_of(splice, payloads, stops)
    return Proposal(commitment.checksum, splice, payloads, stops, checksum, ending, goes_on, unfinished)


def left_of(stop: NDArray, count: int) -> NDArray:
    """Return the stops from within a stop, (M, 29), and from the hover after it, (count, M, 29): its remainders."""
    padded = np.concatenate([stop[1:], np.repeat(stop[-1:], count, axis=0)])
    return np.asarray(sliding_window_view(padded, len(stop), axis=0)[:count].swapaxes(1, 2))


def checksum_of(first: int, payloads: NDArray, stops: NDArray) -> int:
    """Return a checksum of setpoints, their stops, and the number of the first of them."""
    check = zlib.crc32(str((first, payloads.shape, stops.shape)).encode())
    for array in (payloads, stops):
        check = zlib.crc32(np.ascontiguousarray(array).data, check)
    return check


def splice(commitment: Commitment, proposal: Proposal, now: int, limits: Limits) -> Commitment | Refusal:
    """Return the new commitment, or why the proposal is refused; `now` is the number of the setpoint due.

    Never raises, whatever the proposal contains.
    """
    if not isinstance(proposal, Proposal) or _wrong_shape(proposal.splice, proposal.payloads, proposal.stops):
        return Refusal(Fault.SHAPE, "")
    if len(proposal.payloads) > MOST_SETPOINTS:
        return Refusal(Fault.SHAPE, f"{len(proposal.payloads)} setpoints, at most {MOST_SETPOINTS}")
    if not 0 <= proposal.ending < len(proposal.stops):
        return Refusal(Fault.SHAPE, f"{proposal.ending} of {len(proposal.stops)} stops not sent")
    if proposal.stops.shape[1] != commitment.stops.shape[1]:
        return Refusal(Fault.SHAPE, f"stops of {proposal.stops.shape[1]} setpoints")
    if proposal.checksum != checksum_of(proposal.splice, proposal.payloads, proposal.stops):
        return Refusal(Fault.CHECKSUM, "")
    if proposal.follows != commitment.checksum:
        return Refusal(Fault.ORDER, "")
    if proposal.splice < now + LEAST_AHEAD:
        return Refusal(Fault.LATE, f"for setpoint {proposal.splice}, with {now} due")
    if not commitment.first <= proposal.splice <= now + FARTHEST_AHEAD:
        return Refusal(Fault.OUTSIDE, f"at setpoint {proposal.splice}, with {now} due")
    kept = min(proposal.splice, commitment.last) - commitment.first  # after its end the vehicle hovers
    proposed = decode(proposal.payloads)
    before = np.concatenate([commitment.payloads[np.maximum(kept + np.arange(-SPAN, 0), 0)], proposal.payloads])
    if refusal := (
        _differs(decode(commitment.payloads[kept : kept + 1]), proposed, proposal.splice)
        or _moves_at_end(proposal)
        or _find_fault(proposal, before, limits)
        or _fault_of_stops(proposed, proposal)
        or _fault_within_stops(proposal, before, limits)
    ):
        return refusal
    return spliced(commitment, proposal, now)


def spliced(commitment: Commitment, proposal: Proposal, now: int) -> Commitment:
    """Return the new commitment as splice() does, without verifying the proposal."""
    first = max(min(proposal.splice, now) - KEPT_BEHIND, commitment.first)
    behind = np.minimum(np.arange(first, proposal.splice), commitment.last) - commitment.first
    payloads = np.concatenate([commitment.payloads[behind], proposal.payloads])
    stops = np.concatenate([commitment.stops[behind], proposal.stops])
    for array in (payloads, stops):
        array.setflags(write=False)  # so they need not be copied
    return Commitment(
        first,
        payloads,
        stops,
        (*(one for one in commitment.splices if first <= one < proposal.splice), proposal.splice),
        zlib.crc32(_CHAIN.pack(commitment.checksum, proposal.checksum)),
        proposal.unfinished,
    )


def _frozen(array: NDArray) -> NDArray:
    array = np.ascontiguousarray(array)
    array = array.copy() if array.flags.writeable else array
    array.setflags(write=False)
    return array


def _wrong_shape(first: int, payloads: NDArray, stops: NDArray) -> str:
    """Return what is wrong with the shapes of setpoints and stops; empty if nothing is."""
    if not isinstance(first, int) or first < 0:
        return f"the first setpoint has the number {first!r}"
    for name, array, shape in (("setpoints", payloads, (PAYLOAD_SIZE,)), ("stops", stops, (-1, PAYLOAD_SIZE))):
        if not isinstance(array, np.ndarray) or array.dtype != np.uint8 or array.ndim != len(shape) + 1:
            return f"the {name} are no bytes"
        if array.shape[-1] != PAYLOAD_SIZE or 0 in array.shape:
            return f"{name} of shape {array.shape}"
        if (array[..., 0] != FULL_STATE_TYPE).any():
            return f"some of the {name} are no full states"
    if len(payloads) != len(stops):
        return f"{len(payloads)} setpoints and {len(stops)} stops"
    return ""


def _differs(committed: FullStateSetpoints, proposed: FullStateSetpoints, number: int) -> Refusal | None:
    for name in ("position", "velocity", "acceleration", "body_rate"):
        difference = float(np.abs(getattr(proposed, name)[0] - getattr(committed, name)[0]).max())
        if difference > QUANTUM + _ROUNDING:
            return Refusal(Fault.JOINT, f"{name.replace('_', ' ')} at setpoint {number} is off by {difference:.3f}")
    turned = 2.0 * np.arccos(min(abs(float(proposed.quaternion[0] @ committed.quaternion[0])), 1.0))
    if turned > 2.0 * ATTITUDE_QUANTUM:
        return Refusal(Fault.JOINT, f"attitude at setpoint {number} is off by {np.degrees(turned):.2f}°")
    return None


def _moves_at_end(proposal: Proposal) -> Refusal | None:
    if _rests(decode(proposal.payloads[-1:])).all():
        return None
    return Refusal(Fault.END, f"setpoint {proposal.splice + len(proposal.payloads) - 1} still moves")


def _find_fault(proposal: Proposal, before: NDArray, limits: Limits) -> Refusal | None:
    """Return why the setpoints must not be flown; the stop at their end is checked with the other stops."""
    end = max(len(proposal.payloads) - (proposal.ending + 1 if proposal.ending else 0), 1)
    if found := _first_excess(proposal.payloads[None], before, end, limits, in_stop=False):
        fault, what, _, row = found
        return Refusal(fault, f"setpoint {proposal.splice + row} {what}")
    return None


def _fault_of_stops(proposed: FullStateSetpoints, proposal: Proposal) -> Refusal | None:
    """Return which stop does not begin at its setpoint or end at rest, or does not agree with the last setpoints."""
    stops, first, count = proposal.stops, proposal.splice, len(proposal.payloads)
    begin, end = decode(stops[:, 0]), decode(stops[:, -1])
    difference = np.maximum(
        np.abs(begin.position - proposed.position).max(axis=1), np.abs(begin.velocity - proposed.velocity).max(axis=1)
    )
    turned = np.abs(np.remainder(yaw_of(begin.quaternion.T) - yaw_of(proposed.quaternion.T) + np.pi, 2 * np.pi) - np.pi)
    good = (difference <= QUANTUM + _ROUNDING) & (turned <= _SAME_HEADING) & _rests(end)
    if not good.all():
        return Refusal(Fault.STOPS, f"the stop from setpoint {first + int(np.argmin(good))}")
    last = count - proposal.ending - 1
    rows = np.minimum(np.arange(count - last), stops.shape[1] - 1)
    if proposal.ending and (proposal.payloads[last:] != stops[last, rows]).any():
        return Refusal(Fault.STOPS, f"the setpoints from {first + last} on are not the stop from there")
    return None


def _fault_within_stops(proposal: Proposal, before: NDArray, limits: Limits) -> Refusal | None:
    """Return why the stops must not be flown."""
    stops = proposal.stops
    if found := _first_excess(stops, before, stops.shape[1], limits, in_stop=True):
        fault, what, number, row = found
        return Refusal(fault, f"setpoint {row} of the stop from setpoint {proposal.splice + number} {what}")
    return None


def _first_excess(
    runs: NDArray, before: NDArray, end: int, limits: Limits, *, in_stop: bool
) -> tuple[Fault, str, int, int] | None:
    """Return the first fault in the rows before `end` of runs, (R, L, 29): its kind, its text, its run and its row."""

    def wrong(first: int, count: int, rows: int) -> tuple[Fault, str] | None:
        some = runs[first : first + count]
        worst = motion_extremes(some, before[first:], limits.airframe, end=rows)
        return _excess_text(worst, some[:, :rows], limits, in_stop=in_stop)

    if not wrong(0, len(runs), end):
        return None
    run, count = 0, len(runs)
    # Halving looks at no more runs than all of them once again, so a refusal costs two verifications at most.
    while count > 1:
        half = count // 2
        run, count = (run, half) if wrong(run, half, end) else (run + half, count - half)
    row = bisect_left(range(end - 1), True, key=lambda n: wrong(run, 1, n + 1) is not None)
    found = wrong(run, 1, row + 1) or wrong(0, len(runs), end)
    return None if found is None else (*found, run, row)


def _excess_text(worst: MotionExtremes, runs: NDArray, limits: Limits, *, in_stop: bool) -> tuple[Fault, str] | None:
    """Return kind and text of the fault in runs of setpoints, by their worst values; None if there is no fault."""
    # Stops start on the chords between setpoints, off the path by at most acceleration times period² / 8.
    chords = limits.flight.acceleration.brake * _PERIOD**2 / 4 if in_stop else 0.0
    if not worst.jump <= _JUMP + chords:
        return Fault.MOTION, f"jumps by {worst.jump:.3f} m"
    # The outermost corners suffice for walls, but not for obstacles, which may stand between them.
    places = positions_of(runs).reshape(-1, 3) if limits.space.obstacles else worst.corners
    beyond = limits.space.farthest(places)
    if not inside(beyond, QUANTUM):
        return Fault.SPACE, f"is {beyond:.3f} m too far out"
    exceeds = excess_of(worst, limits, in_stop=in_stop)
    return (Fault.LIMITS, exceeds) if exceeds else None


def _rests(setpoints: FullStateSetpoints) -> NDArray:
    """Return (N,) whether each setpoint is a hover: level once the turn for its traded rates is removed."""
    force = setpoints.acceleration + np.array([0.0, 0.0, GRAVITY])
    turn = rotations_of(turns_for(-setpoints.body_rate[:, :2]))
    axis = (controller_attitude(force, setpoints.quaternion) @ np.swapaxes(turn, 1, 2))[:, :, 2]
    thrust = np.linalg.norm(force, axis=1) * turn[:, 2, 2]
    still = ~setpoints.velocity.any(axis=1) & (setpoints.body_rate[:, 2] == 0.0)
    level = np.hypot(axis[:, 0], axis[:, 1]) <= LEVEL
    return np.asarray(still & level & (np.abs(thrust - GRAVITY) <= 10 * QUANTUM))


def warm_up(commitment: Commitment, limits: Limits) -> None:
    """Verify a proposal and discard the answer, so that all code is compiled and loaded before the flight."""
    end = Commitment(0, commitment.payloads[-2:], commitment.stops[-2:])
    proposal = Proposal.of_bytes(propose(end, 0, end.payloads, end.stops).to_bytes())
    assert proposal is not None
    splice(end, proposal, 0, limits)
