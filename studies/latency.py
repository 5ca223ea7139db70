"""Steer the virtual vehicle in real time, and measure how soon requests change the motion, and at what rate.

Pilot, planner and lab are processes. First the vehicle hovers, to measure the lateness of its stream alone. Then
requests come one at a time, each replacing the path ahead by a tour of 10 m through random waypoints. In a second
flight, as no battery lasts for both, they come much faster than they can be planned, and the latest wins.
"""

import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.air.requests import PathAnswer, PathVerdict, Wish
from cfplan.air.timeline import Timeline
from cfplan.errors import InputError
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.setpoints.commitment import QUANTUM
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, decode
from cfplan.flight.telemetry import PlanCommitted, SetpointSent, Telemetry, Triple
from cfplan.preparation.steps import ignore_steps
from cfplan.safety.limits import Limits
from cfplan.steering.flight_in_progress import Listeners
from cfplan.steering.real_time_steering import RealTimeSteering
from cfplan.steering.steered_vehicle import SteeredVehicle
from studies.real_time import patient
from studies.runner.limits import limits_for
from studies.runner.options import option
from studies.runner.reductions import count, largest, mean, median, quantile
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

HORIZON = 10.0  # m, least length of the polyline through the waypoints of a request
_WALL_DISTANCE = 0.5  # m that those waypoints keep from the margin
_PAUSE = (0.2, 0.6)  # s between an answer and the next request, when they come one at a time
_HEIGHT = 0.8  # m

_MEDIAN = Column("median", "median", "ms", ".0f", value=median("seconds"))
_P90 = Column("p90", "p90", "ms", ".0f", value=quantile("seconds", 0.9))
_MAX = Column("max", "max", "ms", ".0f", value=largest("seconds"))
LATENCY_COLUMNS = (
    Column("what", "from the request to"),
    Column("count", "requests", meaning="that were accepted", value=count()),
    _MEDIAN,
    _P90,
    Column("p99", "p99", "ms", ".0f", value=quantile("seconds", 0.99)),
    _MAX,
)
BUDGET_COLUMNS = (
    Column("what", "part of the time until the first changed setpoint"),
    _MEDIAN,
    Column("mean", "mean", "ms", ".0f", value=mean("seconds")),
    _P90,
    _MAX,
)
RATE_COLUMNS = (
    Column("what", "what"),
    Column("seconds", "for", "s", ".0f"),
    Column("asked", "requests"),
    Column("accepted", "accepted"),
    Column("rate", "accepted", "/s", ".1f", value=lambda rows: rows[0].accepted / rows[0].seconds),
    Column("refused", "refused"),
    Column("late", "late"),
    Column("superseded", "superseded"),
    Column("p50", "setpoints late by, p50", "ms", ".2f"),
    Column("p99", "p99", "ms", ".2f"),
    Column("p999", "p99.9", "ms", ".2f"),
    Column("max_late", "max", "ms", ".1f"),
    Column("load", "load", "", ".1f", meaning="of the computer, the mean of the minute before its end"),
)


@dataclass(frozen=True, slots=True)
class Settings:
    """Number and rate of requests."""

    requests: int = option(100, "Requests one at a time; a battery lasts for some 500.", least=1)
    seconds: float = option(60.0, "Duration of the fast requests, and of hovering before, s.", least=1)
    rate: float = option(100.0, "Fast requests per second.", least=0.1)
    seed: int = option(0, "Seed of the waypoints.", least=0)


@dataclass(frozen=True, slots=True)
class Stretch:
    """A part of the flight."""

    what: str
    seconds: float
    asked: int  # requests
    accepted: int
    refused: int
    late: int
    superseded: int
    p50: float  # s, median lateness of setpoints; likewise p99, p999 and max_late
    p99: float
    p999: float
    max_late: float
    load: float  # load average of the last minute of the stretch
    replans: Sequence[Mapping[str, float]] = ()  # s, DELAYS and PARTS by accepted request, if one at a time


DELAYS = (  # from the request
    "first changed setpoint",  # is sent
    "changed motion",  # the first setpoint whose position is off by more than a quantum
    "answer",  # as the planner counts
)
PARTS = (  # of the time until the first changed setpoint, in order
    "to the planner's process",  # until it has the request
    "what it does before",  # until it begins to plan, including earlier proposals that came late
    "plan",
    "checks",  # bytes, stops, link loss, gaps and dry run of the plan's first part
    "verified by the pilot",  # which looks every 10 ms, verifies and answers
    "left until the splice",  # which is set far enough ahead for most plans
)
ONE_BY_ONE = "one request at a time"


class HeardSteering(RealTimeSteering):
    """A flight in real time that keeps its setpoints and commitments."""

    def __init__(self, limits: Limits):
        super().__init__("sim://0", None, limits, ignore_steps, keys=False)
        self.sent: dict[int, SetpointSent] = {}
        self.committed: list[PlanCommitted] = []
        self.heard: list[PathAnswer] = []

    def start(self, mission: Mission, timeline: Timeline, listeners: Listeners) -> None:
        def hear(message: Telemetry) -> None:
            if isinstance(message, SetpointSent):
                self.sent.setdefault(message.index, message)
            elif isinstance(message, PlanCommitted):
                self.committed.append(message)
            listeners.telemetry(message)

        def hear_answer(answer: PathAnswer) -> None:
            self.heard.append(answer)
            listeners.answer(answer)

        super().start(mission, timeline, Listeners(hear, hear_answer))


class Asking:
    """A flight in which tours are requested; `asked` is when each request was made, by its number."""

    def __init__(self, limits: Limits, chance: np.random.Generator):
        self.flight, self.asked = HeardSteering(limits), dict[int, float]()
        self._limits, self._chance = limits, chance

    @contextmanager
    def flying(self) -> Iterator[SteeredVehicle]:
        """Take off with a full battery. Raises a CfplanError if the vehicle does not, or its flight ends early."""
        with SteeredVehicle(self.flight, self._limits, uri="sim://0") as vehicle:
            vehicle.take_off(_HEIGHT)
            yield vehicle

    def ask(self, vehicle: SteeredVehicle) -> int:
        """Request a tour from where the vehicle is going; return the request's number."""
        tour = list(_tour(self._chance, vehicle.target, self._limits))
        begun = vehicle.time
        number = vehicle.request(Wish.REPLACE, tour)
        self.asked[number] = begun
        return number


def work(settings: Settings, run: Run) -> Work:
    """Return one case: both flights, under the limits of this folder."""
    return Work({"flight": settings}, partial(measure, limits=limits_for(Path())), Stretch)


def measure(settings: Settings, limits: Limits) -> list[Stretch]:
    """Fly, and return the stretches: hovering, one request at a time, and many.

    Raises:
        CfplanError: the vehicle did not take off, or its flight ended early.
        InputError: none of the requests that came one at a time was accepted.
    """
    limits, chance = patient(limits), np.random.default_rng(settings.seed)
    return [*_calm(settings, limits, chance), _fast(settings, limits, chance)]


def _calm(settings: Settings, limits: Limits, chance: np.random.Generator) -> list[Stretch]:
    """Fly one battery: hover, then ask one request at a time."""
    asking = Asking(limits, chance)
    with asking.flying() as vehicle:
        begun = _mark(vehicle)
        vehicle.sleep(settings.seconds)
        hovered = _mark(vehicle)
        for _ in range(settings.requests):
            vehicle.answer_to(asking.ask(vehicle))
            vehicle.sleep(float(chance.uniform(*_PAUSE)))
        answered = _mark(vehicle)
        vehicle.land()
    one_by_one = _stretch(ONE_BY_ONE, asking.flight, asking.asked, hovered, answered)
    return [  # once all messages have come
        _stretch("hovering, no requests", asking.flight, (), begun, hovered),
        replace(one_by_one, replans=find_replans(asking.flight, asking.asked)),
    ]


def _fast(settings: Settings, limits: Limits, chance: np.random.Generator) -> Stretch:
    """Fly another battery, with requests much faster than plans."""
    asking = Asking(limits, chance)
    with asking.flying() as vehicle:
        begun = _mark(vehicle)
        while (now := vehicle.time) < begun.time + settings.seconds:
            asking.ask(vehicle)
            vehicle.sleep(max(now + 1.0 / settings.rate - vehicle.time, 0.0))
        ended = _mark(vehicle)
        vehicle.answer_to(max(asking.asked))
        vehicle.land()
    return _stretch(f"{settings.rate:g} requests a second", asking.flight, asking.asked, begun, ended)


def tables(settings: Settings, rows: list[Stretch]) -> Iterator[Table]:
    """Yield the delays, the parts of the time until the first changed setpoint, and the outcomes of fast requests."""
    replans = [replan for row in rows for replan in row.replans]
    delays, parts = ([_Duration(what, each[what]) for what in names for each in replans] for names in (DELAYS, PARTS))
    yield table("latency", "Requests one at a time", LATENCY_COLUMNS, delays, by=("what",))
    yield table("budget", "What that time consists of", BUDGET_COLUMNS, parts, by=("what",))
    others = [row for row in rows if row.what != ONE_BY_ONE]
    yield table("rate", "Requests much faster than plans", RATE_COLUMNS, others)


class _Duration(NamedTuple):
    what: str
    seconds: float


def first_changes(sequence: NDArray, splice: int, payloads: NDArray) -> tuple[int, int] | None:
    """Return the numbers of the first setpoint that `payloads`, (K, 29), change from `splice` on, and of the first
    whose position they change by more than a quantum; None where there are none.

    `sequence`, (N, 29), holds the setpoints before the change; its last one is repeated beyond its end.
    """
    before = sequence[np.minimum(np.arange(splice, splice + len(payloads)), len(sequence) - 1)]
    changed = (before != payloads).any(axis=1)
    moved = (np.abs(decode(before).position - decode(payloads).position) > 1.5 * QUANTUM).any(axis=1)
    return (splice + int(np.argmax(changed)), splice + int(np.argmax(moved))) if moved.any() else None


def find_replans(flight: HeardSteering, asked: Mapping[int, float]) -> list[dict[str, float]]:
    """Return DELAYS and PARTS, s, of each accepted request, by the bytes that the pilot committed to.

    If the vehicle has to stop first, the first changed setpoint is one of that stop. Raises InputError if no request
    was accepted.
    """
    accepted = [each for each in flight.heard if each.verdict is PathVerdict.ACCEPTED and each.number in asked]
    answers = {each.stop or each.checksum: each for each in accepted if each.splice >= 0}
    sequence, found = np.empty((0, PAYLOAD_SIZE), dtype=np.uint8), []
    for each in flight.committed:
        payloads = np.frombuffer(each.payloads, np.uint8).reshape(-1, PAYLOAD_SIZE)
        if (answer := answers.get(each.checksum)) is not None:
            numbers, begun = first_changes(sequence, each.splice, payloads), asked[answer.number]
            if numbers is not None and all(number in flight.sent for number in numbers):
                changed, moved = (flight.sent[number].time for number in numbers)
                delays = dict(zip(DELAYS, (changed - begun, moved - begun, answer.seconds), strict=True))
                found.append(delays | dict(zip(PARTS, _parts(answer, begun, changed), strict=True)))
        if len(sequence) < each.splice:
            waits = np.repeat(sequence[-1:], each.splice - len(sequence), axis=0)
            sequence = np.concatenate([sequence, waits])
        sequence = np.concatenate([sequence[: each.splice], payloads])
    if not found:
        hint = "is the computer too busy? see `python -m studies lateness`"
        raise InputError("no request was accepted", hint=hint)
    return found


def _parts(answer: PathAnswer, asked: float, changed: float) -> tuple[float, ...]:
    """Return PARTS of the time from the request until the first changed setpoint was sent, s."""
    times = answer.times
    assert times is not None
    return (
        times.received - asked, times.begun - times.received, times.planned,
        times.proposed - times.begun - times.planned, times.answered - times.proposed, changed - times.answered,
    )  # fmt: skip


class _Mark(NamedTuple):
    time: float  # s
    load: float  # load average of the last minute


def _mark(vehicle: SteeredVehicle) -> _Mark:
    return _Mark(vehicle.time, os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan"))


def _stretch(what: str, flight: HeardSteering, asked: Collection[int], begin: _Mark, end: _Mark) -> Stretch:
    """Return the outcomes of the requests of these numbers, and the lateness of setpoints meanwhile."""
    became = Counter(each.verdict for each in flight.heard if each.number in asked)
    late = [each.time - each.due for each in flight.sent.values() if begin.time <= each.due <= end.time]
    p50, p99, p999, most = np.percentile(late, [50, 99, 99.9, 100]).tolist()
    return Stretch(
        what=what,
        seconds=end.time - begin.time,
        asked=len(asked),
        accepted=became[PathVerdict.ACCEPTED],
        refused=became[PathVerdict.REFUSED],
        late=became[PathVerdict.LATE],
        superseded=became[PathVerdict.SUPERSEDED],
        p50=p50,
        p99=p99,
        p999=p999,
        max_late=most,
        load=end.load,
    )


def _tour(chance: np.random.Generator, begin: Triple, limits: Limits) -> Iterator[Triple]:
    """Yield random waypoints, m, of a tour from `begin` that is at least HORIZON long."""
    space = limits.space
    low, high = np.array(space.low) + space.margin, np.array(space.high) - space.margin
    inner = np.minimum(_WALL_DISTANCE, 0.25 * (high - low))
    place, length = np.array(begin), 0.0
    while length < HORIZON:
        following = chance.uniform(low + inner, high - inner)
        length += float(np.linalg.norm(following - place))
        place = following
        x, y, z = following.tolist()
        yield x, y, z


STUDY = Study(Settings, work, tables, "--requests 400 -o results/latency.json", one_at_a_time=True)
