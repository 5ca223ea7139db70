"""The timeline of a flight: what the pilot is committed to, and what is intended beyond that.

The commitment is bytes, which end at rest. The intention is a motion, which begins with those bytes. A long plan is
committed in parts, each with a stop behind it, so that the motion can change soon; if the next part is not committed in
time, the vehicle rests at the end of that stop. The timeline also keeps the simulated vehicle at each setpoint, so
later plans are certified as if the whole flight had been planned before take-off.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.air.certifying import STOP, CertifiedFlight, Onward, certify_whole
from cfplan.errors import InfeasibleError
from cfplan.flight.setpoints.commitment import Commitment, Proposal
from cfplan.flight.setpoints.encoding import LEAD, RATE, RATE_LEAD
from cfplan.flight.telemetry import Triple
from cfplan.geometry.min_snap import MIN_SPACING, centripetal_times
from cfplan.numbers import coordinates
from cfplan.planning.plan_result import Plan
from cfplan.safety.limits import Limits
from cfplan.safety.space import inside
from cfplan.vehicle.hover import hover_at
from cfplan.vehicle.joint import JoinedTrajectory

LOOKS_BACK = math.ceil(RATE_LEAD * RATE)  # setpoints before one, whose motion also enters it
HOVER = 0.02  # s, nominal duration of a hover: over before a plan may leave it, LOOKS_BACK setpoints later
LEAST_SPEED = 0.2  # m/s, to which requests may lower the speed
_SNAPSHOTS_KEPT = 6000  # setpoints before a splice whose snapshots are kept: no later plan leaves before them


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """What is committed and intended; its clock is 0 at setpoint 0."""

    commitment: Commitment
    motion: JoinedTrajectory  # committed and intended
    ahead: NDArray  # (K, 3) m, waypoints of the last trajectory, in order
    reached: tuple[float, ...]  # s on its path, of each waypoint
    begin: int  # number of the setpoint of the first snapshot
    snapshots: NDArray  # (L, N, 31), the simulated vehicle at each setpoint, for each motor lag
    speed: float = math.inf  # m/s, an additional limit for new plans
    part_ends: int | None = None  # first setpoint of the stop behind the committed part; None: all is committed
    rest: tuple[Triple, float] | None = None  # m, rad: place and yaw at which that stop ends
    left: NDArray = field(default_factory=lambda: np.empty((0, 3)))  # (J, 3) m, waypoints to go on to from rest
    stops: tuple[tuple[int, int], ...] = ()
    """First setpoint and end of each stop on the way. Within a stop the bytes brake along `motion` and do not follow it
    in time, so no plan leaves it there."""

    @property
    def ends(self) -> float:
        """Return the end of the motion, s, if all of it is committed."""
        return self.motion.duration

    @property
    def unfinished(self) -> bool:
        """Return whether more is intended than is committed."""
        return self.part_ends is not None or len(self.left) > 0

    @property
    def stopping(self) -> bool:
        """Return whether the last motion is the hover behind a stop."""
        return bool(self.stops) and _setpoint(self.motion.starts[-1]) + LOOKS_BACK == self.stops[-1][1]

    def snapshots_at(self, splice: int) -> NDArray:
        """Return (L, 31), the simulated vehicle at a setpoint; after the last one it hovers."""
        return np.asarray(self.snapshots[:, min(max(splice - self.begin, 0), self.snapshots.shape[1] - 1)])

    def onward(self, splice: int, motion: JoinedTrajectory) -> Onward:
        """Return a motion on this clock as one that continues from a setpoint."""
        row = min(splice, self.commitment.last) - self.commitment.first
        return Onward(motion.since(splice / RATE), self.snapshots_at(splice), self.commitment.payloads[row])

    def leaving(self, splice: int, *, keep: bool) -> tuple[int, int]:
        """Return the first setpoint, `splice` or later, at which a plan can begin, and the trajectory that it leaves.

        With `keep` that is the last trajectory, whose waypoints stay. No plan begins within a stop.
        """
        if keep:
            splice = max(splice, _setpoint(self.motion.starts[-1]))
        for begin, end in self.stops:
            if begin <= splice < end:
                splice = end
        last = int(np.searchsorted(self.motion.starts, joint_of(splice) + 1e-9, side="right")) - 1
        return splice, max(last, 0)

    def still_ahead(self, leave: float) -> list[int]:
        """Return the indices of the waypoints not yet passed at `leave`, s on the clock of the last trajectory."""
        last = self.motion.trajectories[-1]
        s = float(last.s_at(max(leave, 0.0)))
        here = last.path(s)
        return [
            number
            for number, (point, at) in enumerate(zip(self.ahead, self.reached, strict=True))
            if at > s and math.dist(point, here) >= MIN_SPACING
        ]

    def slowed_to(self, speed: float) -> "Timeline":
        """Return the timeline with another speed limit, m/s, for new plans."""
        return replace(self, speed=max(speed, LEAST_SPEED))

    def resting(self, rest: tuple[Triple, float], stop: tuple[int, int], limits: Limits) -> "Timeline":
        """Return the timeline with a stop, between two setpoints, and then rest at a place, m, and yaw, rad."""
        place, yaw = rest
        motion = self.motion.continued(joint_of(stop[1]), hover_at(place, yaw, HOVER, limits.airframe))
        return replace(
            self, motion=motion, ahead=np.array([place]), reached=(HOVER,), part_ends=None, rest=rest,
            left=np.empty((0, 3)), stops=(*self.stops, (stop[0], stop[1] + LOOKS_BACK)),
        )  # fmt: skip

    def cut_short(self, limits: Limits, *, going_on: bool) -> "Timeline":
        """Return the timeline that ends with the present commitment.

        With `going_on` the waypoints not reached are kept in `left`, to go on to from rest. A plan of which all is
        committed stays as it is.
        """
        if self.part_ends is None:
            return self if going_on else replace(self, left=np.empty((0, 3)))
        assert self.rest is not None
        rests_at = (self.part_ends + 0.5 * STOP) / RATE + LEAD - self.motion.starts[-1]
        left = self.ahead[self.still_ahead(rests_at)] if going_on else np.empty((0, 3))
        return replace(self.resting(self.rest, (self.part_ends, self.part_ends + STOP), limits), left=left)

    def for_plans_from(self, splice: int, limits: Limits) -> "Timeline":
        """Return the timeline for a plan from a setpoint on: cut short if the committed part ends before that."""
        if self.part_ends is None or splice < self.part_ends:
            return self
        return self.cut_short(limits, going_on=True)

    def with_certified(self, splice: int, made: CertifiedFlight) -> "Timeline":
        """Return the timeline with a certified flight from a setpoint on; its commitment is still the present one."""
        first = min(max(splice - _SNAPSHOTS_KEPT, self.begin, self.commitment.first), splice)
        rows = np.arange(first, splice) - self.begin
        before = self.snapshots[:, np.minimum(rows, self.snapshots.shape[1] - 1)]  # hovers after the last
        return replace(
            self,
            begin=first,
            motion=self.motion.kept_from(first / RATE),
            snapshots=np.concatenate([before, made.snapshots], axis=1),
            part_ends=None if made.following is None else splice + made.following,
            rest=made.rest,
            left=np.empty((0, 3)),
            stops=tuple(stop for stop in self.stops if splice - _SNAPSHOTS_KEPT < stop[0] < splice),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Replanned:
    """A proposal, the timeline once the pilot has accepted it, and the plan behind it."""

    proposal: Proposal
    timeline: Timeline
    plan: Plan | None  # None for a stop, and for a later part of a plan
    joint: float  # s from setpoint 0, when the new motion takes over
    stop: "Replanned | None" = None  # to be proposed first, if the plan begins at rest behind it

    def accepted(self, commitment: Commitment) -> Timeline:
        """Return the timeline with the pilot's new commitment."""
        return replace(self.timeline, commitment=commitment)

    def behind(self, commitment: Commitment) -> "Replanned":
        """Return the proposal behind a stop, ready to send once the pilot is committed to that stop."""
        proposal = replace(self.proposal, follows=commitment.checksum)
        return replace(self, proposal=proposal, timeline=self.accepted(commitment), stop=None)


def joint_of(splice: int) -> float:
    """Return the joint, s, of a plan that begins at a setpoint, which itself stays as committed."""
    return splice / RATE + LEAD


def _setpoint(joint: float) -> int:
    """Return the setpoint of a joint, s; 0 at the beginning."""
    return max(round((joint - LEAD) * RATE), 0)


def hold(planned: Plan, waypoints: ArrayLike) -> Timeline:
    """Return the timeline of a plan that begins at rest, through waypoints (K, 3) m with centripetal times.

    The first waypoint is its start. Raises InfeasibleError or NotCertifiedError if it fails the checks that replan()
    makes of plans.
    """
    points = np.asarray(waypoints, dtype=float)
    motion = JoinedTrajectory((planned.trajectory,), (0.0,))
    made = certify_whole(Onward(motion), planned.limits)
    reached = tuple(np.cumsum(centripetal_times(points)).tolist())
    return Timeline(Commitment(0, made.payloads, made.stops), motion, points[1:], reached, 0, made.snapshots)


def hold_hover(position: Triple, yaw: float, limits: Limits) -> Timeline:
    """Return the timeline of a vehicle that hovers at a position, m, with a yaw, rad, until a request comes.

    Raises InfeasibleError if that lies outside the space, or if link loss there would end outside the walls.
    """
    (beyond,), (face,) = limits.space.nearest(np.array([position]))
    if not inside(beyond):
        raise InfeasibleError(
            f"the hover at {coordinates(position, '.2f')} m is {beyond:.2f} m too {limits.space.too(face)}",
            where="take-off",
            hint="take off to a height inside the space less its margin, and nearer to the middle of the room",
        )
    motion = JoinedTrajectory((hover_at(position, yaw, HOVER, limits.airframe),), (0.0,))
    made = certify_whole(Onward(motion), limits)
    place = np.array([position], dtype=float)
    return Timeline(Commitment(0, made.payloads, made.stops), motion, place, (HOVER,), 0, made.snapshots)
