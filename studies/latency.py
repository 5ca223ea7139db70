"""Measure how soon the motion changes after a request in flight, with pilot, planner and lab as processes.

First the vehicle hovers, for the lateness of its stream alone. Then requests come one at a time, each of them for a
tour of `HORIZON` m through random waypoints instead of what is ahead. Then they come much faster than they can be
planned, and the latest wins.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE
from cfplan.flight.telemetry import PlanCommitted, SetpointSent, Telemetry, Triple
from cfplan.preparation.air_planner import PathAnswer, PathVerdict, Wish
from cfplan.preparation.replan import HeldFlight
from cfplan.preparation.steps import ignore_steps
from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits
from cfplan.steering.flight_in_progress import Listeners
from cfplan.steering.real_time_steering import RealTimeSteering
from cfplan.steering.steered_vehicle import SteeredVehicle
from studies.runner.result import Column, StudyResult, Table, detail_table

HORIZON = 10.0  # m, at least, of straight lines through the waypoints of a request
_WALL_DISTANCE = 0.5  # m beyond the margin, that those keep
_PAUSE = (0.2, 0.6)  # s between an answer and the next request, where they come one at a time
_ANSWERS_WITHIN = 5.0  # s, of the last requests
_HEIGHT = 0.8  # m

LATENCY_COLUMNS = (
    Column("what", "from the request to"),
    Column("count", "requests", meaning="that were accepted"),
    Column("median", "median", "ms", ".0f"),
    Column("p90", "p90", "ms", ".0f"),
    Column("p99", "p99", "ms", ".0f"),
    Column("max", "max", "ms", ".0f"),
)
RATE_COLUMNS = (
    Column("what", "what"),
    Column("seconds", "for", "s", ".0f"),
    Column("asked", "requests"),
    Column("accepted", "accepted"),
    Column("rate", "accepted", "/s", ".1f"),
    Column("refused", "refused"),
    Column("late", "late"),
    Column("superseded", "superseded"),
    Column("p50", "setpoints late by, p50", "ms", ".2f"),
    Column("p99", "p99", "ms", ".2f"),
    Column("p999", "p99.9", "ms", ".2f"),
    Column("max_late", "max", "ms", ".1f"),
    Column("load", "load", "", ".1f", meaning="of the computer, the mean of the minute before its end"),
)


BUDGET_COLUMNS = (
    Column("what", "part of the time until the first changed setpoint"),
    Column("median", "median", "ms", ".0f"),
    Column("mean", "mean", "ms", ".0f"),
    Column("p90", "p90", "ms", ".0f"),
    Column("max", "max", "ms", ".0f"),
)


@dataclass(frozen=True, slots=True)
class Replan:
    """One request that was accepted."""

    asked: float  # s on the flight's clock
    first_changed: float  # s from then until the first setpoint was sent that is another than before
    motion: float  # s from then to the joint
    answer: float  # s from then to the answer, as the planner counts
    # What `first_changed` consists of, s, in order:
    to_planner: float = 0.0  # until the planner's process has the request
    waiting: float = 0.0  # until it begins to plan; with its proposals that came late
    planning: float = 0.0  # the plan, whole
    checking: float = 0.0  # bytes, stops, link loss, gaps and dry run of its first part
    verifying: float = 0.0  # the way to the pilot, which looks every 10 ms, verifies and answers
    spare: float = 0.0  # until the splice, which lies as far ahead as most plans need


_PARTS = (
    ("to the planner's process", "to_planner"),
    ("what it does before", "waiting"),
    ("plan", "planning"),
    ("checks", "checking"),
    ("verified by the pilot", "verifying"),
    ("left until the splice", "spare"),
)


class _HeardSteering(RealTimeSteering):
    """A flight by processes whose setpoints and commitments are kept."""

    def __init__(self, limits: Limits):
        super().__init__("sim://0", None, limits, ignore_steps, keys=False)
        self.sent: dict[int, SetpointSent] = {}
        self.committed: list[PlanCommitted] = []
        self.heard: list[PathAnswer] = []

    def start(self, mission: Mission, held: HeldFlight, listeners: Listeners) -> None:
        def hear(message: Telemetry) -> None:
            if isinstance(message, SetpointSent):
                self.sent.setdefault(message.index, message)
            elif isinstance(message, PlanCommitted):
                self.committed.append(message)
            listeners.telemetry(message)

        def hear_answer(answer: PathAnswer) -> None:
            self.heard.append(answer)
            listeners.answer(answer)

        super().start(mission, held, Listeners(hear, hear_answer))


def latency(
    safety_file: Path,
    *,
    requests: int = 100,
    seconds: float = 60.0,
    rate: float = 100.0,
    first_seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Ask for so many changes one at a time, then `rate` a second for so many s; hover before for as many s.

    Raises a CfplanError where the vehicle does not take off or its flight ends early.
    """
    limits = _patient(load_limits(safety_file))
    chance = np.random.default_rng(first_seed)
    flight = _HeardSteering(limits)
    asked: dict[int, float] = {}
    rows: list[dict[str, Any]] = []

    def ask(vehicle: SteeredVehicle) -> int:
        tour = list(_tour(chance, vehicle.target, limits))
        begun = vehicle.time
        number = vehicle.request(Wish.REPLACE, tour)
        asked[number] = begun
        return number

    with SteeredVehicle(flight, limits, uri="sim://0") as vehicle:
        vehicle.take_off(_HEIGHT)
        begun = vehicle.time
        vehicle.sleep(seconds)
        rows.append(_stretch("hovering, no requests", flight, begun, vehicle.time, {}))
        for done in range(requests):
            vehicle.answer_to(ask(vehicle))
            vehicle.sleep(float(chance.uniform(*_PAUSE)))
            progress(done, 2 * requests)
        one_by_one = dict(asked)
        begun = vehicle.time
        while (now := vehicle.time) < begun + seconds:
            ask(vehicle)
            vehicle.sleep(max(now + 1.0 / rate - vehicle.time, 0.0))
            progress(requests + int(requests * (now - begun) / seconds), 2 * requests)
        ended = vehicle.time
        vehicle.answer_to(max(asked))
        many = {number: time for number, time in asked.items() if number not in one_by_one}
        rows.append(_stretch(f"{rate:g} requests a second", flight, begun, ended, many))
        vehicle.land()
    replans = _replans(flight, one_by_one)
    settings = {"requests": requests, "seconds": seconds, "rate": rate, "seed": first_seed, "horizon": HORIZON}
    many_table = Table("rate", "Requests much faster than plans", RATE_COLUMNS, tuple(rows))
    tables = (latency_table(replans), budget_table(replans), many_table)
    return StudyResult("latency", settings, tables, (detail_table("replans", replans),))


def latency_table(replans: Sequence[Replan]) -> Table:
    """Return a row for each kind of delay. Raises InputError where nothing was accepted."""
    if not replans:
        raise InputError("no request was accepted", hint="is the computer too busy? see `python -m studies lateness`")
    kinds = (
        ("first changed setpoint", [each.first_changed for each in replans]),
        ("change of the motion", [each.motion for each in replans]),
        ("answer", [each.answer for each in replans]),
    )
    rows = []
    for what, values in kinds:
        median, p90, p99, most = np.percentile(values, [50, 90, 99, 100]).tolist()
        rows.append({"what": what, "count": len(values), "median": median, "p90": p90, "p99": p99, "max": most})
    return Table("latency", "Requests one at a time", LATENCY_COLUMNS, tuple(rows))


def budget_table(replans: Sequence[Replan]) -> Table:
    """Return a row for each part of the time until the first changed setpoint."""
    rows = []
    for what, name in _PARTS:
        values = np.array([getattr(each, name) for each in replans])
        rows.append({"what": what, "median": np.median(values), "mean": values.mean(),
                     "p90": np.quantile(values, 0.9), "max": values.max()})  # fmt: skip
    return Table("budget", "What that time consists of", BUDGET_COLUMNS, tuple(rows))


def first_change(sequence: NDArray, splice: int, payloads: NDArray) -> int | None:
    """Return the number of the first setpoint that is another with setpoints (K, 29) from a splice on; None for none.

    `sequence`, (N, 29), are those before; behind them the last one holds.
    """
    before = sequence[np.minimum(np.arange(splice, splice + len(payloads)), len(sequence) - 1)]
    changed = np.flatnonzero((before != payloads).any(axis=1))
    return splice + int(changed[0]) if len(changed) else None


def _replans(flight: _HeardSteering, asked: dict[int, float]) -> list[Replan]:
    """Return what became of the requests that were accepted, by the bytes that the pilot was bound to.

    Where the vehicle is to stop first, the first setpoint of that is the one that changes.
    """
    accepted = [each for each in flight.heard if each.verdict is PathVerdict.ACCEPTED and each.number in asked]
    answers = {each.stop or each.checksum: each for each in accepted if each.splice >= 0}
    sequence, found = np.empty((0, PAYLOAD_SIZE), dtype=np.uint8), []
    for each in flight.committed:
        payloads = np.frombuffer(each.payloads, np.uint8).reshape(-1, PAYLOAD_SIZE)
        if (answer := answers.get(each.checksum)) is not None:
            number, begun = first_change(sequence, each.splice, payloads), asked[answer.number]
            if number in flight.sent:
                sent = flight.sent[number]
                joint = sent.due if answer.stop else sent.due + answer.joint - number / RATE
                parts = _parts(answer, begun, sent.time)
                found.append(Replan(begun, sent.time - begun, joint - begun, answer.seconds, *parts))
        if len(sequence) < each.splice:
            waits = np.repeat(sequence[-1:], each.splice - len(sequence), axis=0)
            sequence = np.concatenate([sequence, waits])
        sequence = np.concatenate([sequence[: each.splice], payloads])
    return found


def _parts(answer: PathAnswer, asked: float, changed: float) -> tuple[float, ...]:
    """Return the parts of the time from when it was asked until the first changed setpoint was sent, s, as _PARTS."""
    times = answer.times
    assert times is not None
    return (
        times.received - asked, times.begun - times.received, times.planned,
        times.proposed - times.begun - times.planned, times.answered - times.proposed, changed - times.answered,
    )  # fmt: skip


def _stretch(what: str, flight: _HeardSteering, begin: float, end: float, asked: dict[int, float]) -> dict[str, Any]:
    """Return a row about the requests that were asked for, and the setpoints sent meanwhile."""
    became = Counter(each.verdict for each in flight.heard if each.number in asked)
    late = [each.time - each.due for each in list(flight.sent.values()) if begin <= each.due <= end]
    p50, p99, p999, most = np.percentile(late, [50, 99, 99.9, 100]).tolist()
    return {
        "what": what,
        "seconds": end - begin,
        "asked": len(asked),
        "accepted": became[PathVerdict.ACCEPTED],
        "rate": became[PathVerdict.ACCEPTED] / (end - begin),
        "refused": became[PathVerdict.REFUSED],
        "late": became[PathVerdict.LATE],
        "superseded": became[PathVerdict.SUPERSEDED],
        "p50": p50,
        "p99": p99,
        "p999": p999,
        "max_late": most,
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan"),
    }


def _tour(chance: np.random.Generator, begin: Triple, limits: Limits) -> Iterator[Triple]:
    """Yield random waypoints, of HORIZON m or a little more from a place, m."""
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


def _patient(limits: Limits) -> Limits:
    """Return limits under which no flight is refused or ended by lateness, and no hover by its endurance."""
    pose = replace(limits.pose, age_warning=0.15, age_brake=0.5, age_land=1.5)
    return replace(limits, pose=pose, lateness=1.0)
