"""The certificate of lost vehicles: where a vehicle may be after its link is lost, and how near the others come.

A lost vehicle no longer follows its path. Its tube encloses it at each time until it lies on the floor; there is one
tube for each setpoint after which the link may be lost. The others all brake once the loss is noticed, which keeps them
apart from each other, by the certificate of separation. Vehicles of one dongle are lost together, and their tubes are
compared with each other too.

While a lost vehicle is in the air, the others keep away from its tube at all heights. Once it lies, they may pass over
it, but none may stop or end above it. A link that comes back after more than BACK lets its vehicle hover and land where
it is then, so from BACK on the others also keep away from where the tube has been, until all rest.

A vehicle that still waits at its start stays there when all brake. Within the skew of the fleet's start every vehicle
may still wait, so the first moment also covers the time before, when all hover at their starts or, after take-off,
above them.

A vehicle that is lost while it brakes for another reason is not part of this certificate.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.planning.fleet.members import FleetMember, places
from cfplan.planning.fleet.separation import Stops
from cfplan.planning.plan_result import Plan
from cfplan.safety.space import inside

NOTICED = (0.0, 0.6)  # s, soonest and latest, from the last setpoint until the others begin to brake
"""The conductor hears at once of a pilot that ends its flight or dies. A lost link is known to the pilot 0.4 to 0.5 s
after the last setpoint: answers to pings, ten a second, must be missing for 0.5 s (flight/pilot/health.py). A hanging
pilot is noticed after 0.5 s. The conductor's tick and its orders take 0.1 s at most."""
BACK = 0.4  # s from the last setpoint, after which a vehicle whose link comes back hovers and lands where it is
"""The pilot does not notice a link that is back sooner, and flies on: see NOTICED."""
_SAMPLE = 0.005  # s of a plan, from one compared place to the next
_BETWEEN = 1e-4  # m, as in separation.py
_RESTS = 1e3  # s before its start, of a vehicle that waits for long


class Tube(NamedTuple):
    """The space that a vehicle may be in after its link is lost, for each setpoint of its plan."""

    boxes: NDArray  # (K, R, S, 2, 3) m, low and high corners in S parts of the time
    """In K ways: first of a vehicle whose motors stop at once, then of one whose link is lost."""
    rate: float  # Hz, of the R setpoints
    part: float  # s of each part; the last one, in which it lies, lasts
    first: int = 0  # row of the plan's first setpoint; those before it are of a vehicle that still waits

    def rows(self, own: NDArray) -> NDArray:
        """Return the rows at own times of the plan, (N,) s: before its start the first one."""
        return np.clip(np.round(own * self.rate) + self.first, 0, self.boxes.shape[1] - 1).astype(np.int64)


@dataclass(frozen=True, slots=True)
class Loss:
    """The worst moment to lose a vehicle, or all vehicles of a dongle."""

    vehicles: tuple[str, ...]  # that are lost together
    pair: tuple[str, str]  # the lost one, and the one that it comes nearest to
    reaction: str  # of the others
    distance: float  # m, at least, from the tube to the other's column
    place: tuple[float, float]  # m, x and y, where the first of the pair loses its link
    time: float  # s after the fleet's start
    exposed: float  # fraction of the fleet's time at which the distance is less than allowed

    def __str__(self) -> str:
        a, b = self.pair
        x, y = self.place
        lost_too = [each for each in self.vehicles if each != a]
        together = f", with {', '.join(lost_too)}" if lost_too else ""
        return (
            f"{a} lost at ({x:.2f}, {y:.2f}) m, {self.time:.2f} s{together}, comes within {self.distance:.3f} m of "
            f"{b}; {self.reaction}"
        )

    def keeps(self, apart: float) -> bool:
        """Return whether that distance, m, is kept."""
        return bool(inside(apart - self.distance))


class _Ways(NamedTuple):
    """How far along its plan another vehicle is after a loss, for each part of the time."""

    first: NDArray  # (S,) int, samples from the place at the loss
    last: NDArray  # (S,) int
    rest: NDArray  # (2,) int, first and last where it rests
    back: int  # first part in which the link of the lost vehicle may be back
    waits: int  # samples; from a place before this one it may brake before it begins, and stays at its start
    far: float  # m, the largest distance that matters


@dataclass(frozen=True, slots=True)
class LossModel:
    """What vehicles do when one is lost, and how far they keep away."""

    tube: Callable[[Plan], Tube]
    stop: NDArray | Callable[[Plan], Stops]
    """How far, (M,) s at the rate of setpoints, a stop goes on along a plan; or the stops of a plan that leave it."""
    together: tuple[tuple[int, ...], ...]  # numbers of the vehicles that share a dongle, of two or more
    clearance: float  # m, from a tube to the other columns

    @property
    def stops(self) -> Callable[[Plan], Stops] | None:
        """Return the stops of a plan that leave it; None for those along it."""
        return self.stop if callable(self.stop) else None

    def losses(self, members: Sequence[FleetMember], numbers: Sequence[int], skew: float) -> tuple[Loss, ...]:
        """Return the worst moment to lose each of some vehicles of a fleet, and each dongle, the nearest first.

        `numbers` are those of the members in the fleet. Clocks and orders differ by `skew`, s, at most.
        """
        tubes, count = [self.tube(member.plan) for member in members], len(members)
        rate, end = tubes[0].rate, max(member.end for member in members)
        before = int(np.ceil((NOTICED[1] + skew) * rate)) if tubes[0].first else 0  # else the first setpoint is a hover
        times = np.arange(-before, int(np.ceil(end * rate)) + 1) / rate
        own = [times - member.delay for member in members]
        away = np.full((count, count, len(times)), np.inf)  # lost, other, time
        for i, j in itertools.permutations(range(count), 2):
            away[i, j] = self.distances(tubes[i], own[i], (members[j].plan, own[j]), skew)
        worst = []
        for group in (*((n,) for n in range(count)), *groups_among(self.together, numbers)):
            table = np.full_like(away, np.inf)
            for i in group:
                others = [j for j in range(count) if j not in group]
                table[i, others] = away[i, others]
            for i, j in itertools.combinations(group, 2):
                table[i, j] = self.tubes_apart(tubes[i], own[i], tubes[j], own[j], skew)
            worst.append(self._worst(group, table, times, members))
        return tuple(sorted(worst, key=lambda each: each.distance))

    def distances(
        self, tube: Tube, lost: NDArray, other: tuple[Plan, NDArray], skew: float, *, far: float = np.inf
    ) -> NDArray:
        """Return the least distance from a tube to the column of another vehicle that brakes, (N,) m.

        `lost`, (N,) s, are own times of the vehicle when its link is lost; `other` are the plan and own times of the
        other. Distances above `far`, m, are returned as that.
        """
        if callable(self.stop):
            return _off_path(tube, lost, self.stop(other[0]), other[1], skew, far)
        return _along_path(tube, lost, other, self.stop, skew, far)

    def tubes_apart(self, tube: Tube, own: NDArray, other: Tube, own_of_other: NDArray, skew: float) -> NDArray:
        """Return the least distance, (N,) m, between the tubes of two vehicles that lose their links together.

        `own` and `own_of_other`, (N,) s, are the times on both plans at the same N moments; their difference is
        uncertain by ±`skew`, s. A vehicle whose link comes back stays where it is then; tubes of flights on board
        contain that themselves.
        """
        late = int(np.ceil(skew * tube.rate))
        rows = tube.rows(own), other.rows(own_of_other[:, None] + np.arange(-late, late + 1) / tube.rate)
        ways = itertools.product(tube.boxes[1:], other.boxes[1:])  # the first is that of motors that stop at once
        back = tube.boxes.shape[2] if callable(self.stop) else int(BACK / tube.part)
        return np.min([_least_of_tubes(a, rows[0], b, rows[1], back) for a, b in ways], axis=0)

    def _worst(self, group: tuple[int, ...], away: NDArray, times: NDArray, members: Sequence[FleetMember]) -> Loss:
        """Return the moment at which others are least away; `away` has lost, other, time."""
        kept = away.min(axis=(0, 1))
        at = int(kept.argmin())
        i, j = divmod(int(away[:, :, at].argmin()), len(members))
        x, y = members[i].columns(times[at : at + 1])[0].tolist()
        return Loss(
            tuple(members[number].name for number in group),
            (members[i].name, members[j].name),
            "the others brake" if len(group) < len(members) else "all are lost",
            max(float(kept[at]), 0.0),
            (x, y),
            float(times[at]),
            float(np.mean(~inside(self.clearance - kept))),
        )


def groups_among(together: Sequence[tuple[int, ...]], numbers: Sequence[int]) -> Iterator[tuple[int, ...]]:
    """Yield the groups of two or more among some vehicles of a fleet, by their places in `numbers`."""
    for group in together:
        some = tuple(n for n, number in enumerate(numbers) if number in group)
        if len(some) > 1:
            yield some


def _along_path(
    tube: Tube, lost: NDArray, other: tuple[Plan, NDArray], stop: NDArray, skew: float, far: float
) -> NDArray:
    """Return the distances to a vehicle that brakes along its path."""
    plan, own = other
    trajectory = plan.trajectory
    samples = places(trajectory, np.arange(0.0, trajectory.duration + _SAMPLE, _SAMPLE))
    begin = np.round(np.clip(own, -_RESTS, _RESTS) / _SAMPLE).astype(np.int64)
    per_sample = max(float(np.linalg.norm(np.diff(samples, axis=0), axis=1).max()), 1e-6)
    found = _least(tube.boxes, tube.rows(lost), samples, per_sample, begin, _ways(tube, stop, skew, far))
    return np.asarray(found - 0.5 * _SAMPLE * plan.limits.plan.speed - _BETWEEN)


def _ways(tube: Tube, stop: NDArray, skew: float, far: float) -> _Ways:
    begin = tube.part * np.arange(tube.boxes.shape[2])
    soonest, latest = NOTICED
    first = _braked(begin, soonest, stop, tube.rate) - skew
    last = _braked(begin + tube.part, latest, stop, tube.rate) + skew
    rests = soonest + stop[-1] - skew, latest + stop[-1] + skew
    return _Ways(
        np.floor(first / _SAMPLE).astype(np.int64),
        np.ceil(last / _SAMPLE).astype(np.int64),
        np.array([np.floor(rests[0] / _SAMPLE), np.ceil(rests[1] / _SAMPLE)]).astype(np.int64),
        int(BACK / tube.part),
        int(np.ceil((skew - soonest) / _SAMPLE)),
        far,
    )


def _braked(times: NDArray, begins: float, stop: NDArray, rate: float) -> NDArray:
    """Return the time on its plan, s, that a vehicle has reached `times`, s, after a loss; it brakes from `begins`."""
    return np.asarray(np.minimum(times, begins) + np.interp(times - begins, np.arange(len(stop)) / rate, stop))


@njit(nogil=True, error_model="numpy")
def _least(boxes: NDArray, rows: NDArray, samples: NDArray, per_sample: float, begin: NDArray, ways: _Ways) -> NDArray:
    """Return the least distances, (N,) m, of boxes to samples, (W, 2), which are `per_sample`, m, apart at most."""
    out = np.full(len(rows), ways.far)
    for n in range(len(rows)):
        for way in range(boxes.shape[0]):
            row = rows[n]
            for part in range(boxes.shape[2]):
                lies = boxes[way, row, part, 1, 2] <= 0.0
                low, high = boxes[way, row, part, 0], boxes[way, row, part, 1]
                box = low[0], low[1], high[0], high[1]
                first, last = ways.first[part], ways.last[part]
                if lies:
                    first, last = ways.rest[0], ways.rest[1]
                elif way == boxes.shape[0] - 1 and part >= ways.back:
                    last = ways.rest[1]
                if begin[n] <= ways.waits:
                    first = -begin[n]
                first = min(max(begin[n] + first, 0), len(samples) - 1)
                last = min(max(begin[n] + last, 0), len(samples) - 1)
                out[n] = _nearest_sample(box, samples, per_sample, first, last, out[n])
                if lies:
                    break
    return out


@njit(error_model="numpy")
def _nearest_sample(
    box: tuple[float, float, float, float], samples: NDArray, per_sample: float, first: int, last: int, least: float
) -> float:
    """Return the least distance of a box, from x and y to x and y, to some of the samples, m, `least` at most.

    Samples that cannot be nearer than what was found are passed over.
    """
    k = first
    while k <= last:
        a = max(box[0] - samples[k, 0], samples[k, 0] - box[2], 0.0)
        b = max(box[1] - samples[k, 1], samples[k, 1] - box[3], 0.0)
        away = np.sqrt(a * a + b * b)
        if np.isnan(away) or np.isnan(least):
            return np.nan
        least = min(least, away)
        k += 1 + int((away - least) / per_sample)
    return least


def _off_path(tube: Tube, lost: NDArray, stops: Stops, own: NDArray, skew: float, far: float) -> NDArray:
    """Return the distances to a vehicle that leaves its path to stop."""
    late, (soonest, latest) = np.ceil(skew * stops.rate), NOTICED
    begins = np.arange(np.floor(soonest * stops.rate) - late, np.ceil(latest * stops.rate) + late + 1)
    window = np.array([-late, np.ceil(tube.part * stops.rate) + late])
    rows = np.round(np.clip(own, -_RESTS, _RESTS) * stops.rate).astype(np.int64)
    found = _least_off_path(
        tube.boxes, tube.rows(lost), stops.places, rows, begins.astype(np.int64), window.astype(np.int64),
        tube.part * stops.rate, stops.speed / stops.rate, far + stops.error,
    )  # fmt: skip
    return np.asarray(found - stops.error)


@njit(nogil=True, error_model="numpy")
def _least_off_path(
    boxes: NDArray, rows: NDArray, places: NDArray, own: NDArray, begins: NDArray, window: NDArray, part: float,
    step: float, far: float,
) -> NDArray:  # fmt: skip
    """Return the least distances, (N,) m, of boxes to a vehicle that begins one of its stops after the loss.

    `places`, (R, M, 2) m, are the places of the stops from each of its R setpoints; `own`, (N,), are the setpoints at
    which the losses happen; `begins`, (B,), are periods from the loss until a stop begins. A part of the tube lasts
    `part` periods, and is compared with the periods in `window` about its begin. The vehicle moves `step`, m, in a
    period at most, so parts that it cannot reach are passed over.
    """
    out = np.full(len(rows), far)
    setpoints, last = len(places) - 1, places.shape[1] - 1
    for n in range(len(rows)):
        for way in range(boxes.shape[0]):
            for number in range(boxes.shape[2]):
                low, high = boxes[way, rows[n], number, 0], boxes[way, rows[n], number, 1]
                lies = high[2] <= 0.0
                first = int(np.floor(number * part)) + window[0]
                x, y = places[min(max(own[n], 0), setpoints), 0]
                a, b = max(low[0] - x, x - high[0], 0.0), max(low[1] - y, y - high[1], 0.0)
                periods = min(max(abs(first), first + window[1] - window[0] + 1), begins[-1] + last)
                if np.sqrt(a * a + b * b) - step * (begins[-1] + last if lies else periods) > out[n]:
                    if lies:
                        break
                    continue
                for begin in begins:
                    row = min(max(own[n] + begin, 0), setpoints)
                    for k in range(first, first + window[1] - window[0] + 2):
                        if lies:
                            x, y = places[row, last]
                        elif k < begin:
                            x, y = places[min(max(own[n] + k, 0), setpoints), 0]
                        else:
                            x, y = places[row, min(k - begin, last)]
                        a, b = max(low[0] - x, x - high[0], 0.0), max(low[1] - y, y - high[1], 0.0)
                        away = np.sqrt(a * a + b * b)
                        if away < out[n] or np.isnan(away):
                            out[n] = away
                        if lies:
                            break
                if lies:
                    break
    return out


@njit(nogil=True, error_model="numpy")
def _least_of_tubes(boxes: NDArray, rows: NDArray, others: NDArray, rows_of_others: NDArray, back: int) -> NDArray:
    """Return the least distances, (N,) m, of boxes, (R, S, 2, 3), to those of another vehicle.

    Row n compares tube `rows[n]` with each tube of `rows_of_others[n]`, part by part in time. The last setpoints of
    the two vehicles may be a period apart, so each part is compared with the parts before and after it too. From part
    `back` on, each is compared with every part from `back` on, because either vehicle may stop there.
    """
    out = np.full(len(rows), np.inf)
    parts, parts_of_others = boxes.shape[1], others.shape[1]
    most = max(parts, parts_of_others)
    for n in range(len(rows)):
        for m in range(rows_of_others.shape[1]):
            tube, other = boxes[rows[n]], others[rows_of_others[n, m]]
            for part in range(most):
                first, last = max(part - 1, 0), part + 1
                if part >= back:
                    first, last = min(first, back), max(last, most - 1)
                for k in range(first, last + 1):
                    away = _between_boxes(tube[min(part, parts - 1)], other[min(k, parts_of_others - 1)])
                    if away < out[n] or np.isnan(away):
                        out[n] = away
    return out


@njit(error_model="numpy")
def _between_boxes(a: NDArray, b: NDArray) -> float:
    """Return the distance of two boxes, (2, 3) each, seen from above, m."""
    x = max(a[0, 0] - b[1, 0], b[0, 0] - a[1, 0], 0.0)
    y = max(a[0, 1] - b[1, 1], b[0, 1] - a[1, 1], 0.0)
    return np.sqrt(x * x + y * y)
