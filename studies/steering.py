"""Steer the virtual Crazyflie by random requests in the stepped lab, and judge every setpoint that was streamed.

The seed of a flight determines where the vehicle stands, how long its planner takes, and the requests, which come at
any moment and in bursts: extend, replace, stop, fly slower or faster. Some lie outside the room, cannot be flown, or
are garbage; some coincide with a fault of the planner. No limit may be exceeded.
"""

import contextlib
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from cfplan.air.certifying import STOP
from cfplan.air.requests import PathAnswer, PathVerdict, Wish
from cfplan.air.stepped import PlannerFault
from cfplan.air.timeline import Timeline
from cfplan.errors import CfplanError, ExitCode, InputError
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.telemetry import Event, Phase, PhaseEntered, SetpointSent, Telemetry
from cfplan.safety.limits import Limits
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.steering.flight_in_progress import Listeners
from cfplan.steering.steered_vehicle import SteeredVehicle
from cfplan.steering.stepped_steering import SteppedSteering
from cfplan.steering.waypoint_lines import parse_line
from cfplan.vehicle.joint import JoinedTrajectory
from studies.flown_sequence import Committed, SequenceVerdict, judge_sequence
from studies.runner.limits import limits_for
from studies.runner.options import option
from studies.runner.reductions import count, largest, mean, smallest, total
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work
from studies.stepped_flight import on_floor, to_wall

_PLANNING = (0.02, 0.05, 0.1, 0.3)  # s, planning times, one of which is drawn for each flight
_BURST_FRACTION, _BURST, _BURST_PERIOD = 0.02, (10, 30), 0.02  # fraction of bursts, requests in a burst, s between them
_FAULT_FRACTION = 0.03  # of the requests: the planner has a fault
_TAKE_OFF_HEIGHT = (0.5, 1.2)  # m
_NEAR = 0.3  # m from the target, along each axis: waypoints too near to turn to at speed
_FRACTIONS = {"extend": 0.30, "replace": 0.28, "stop": 0.07, "slower": 0.05, "faster": 0.08, "near": 0.08,
              "outside": 0.07, "garbage": 0.07}  # fmt: skip
_GARBAGE: tuple[Any, ...] = (
    [[math.nan, 0.0, 1.0]], [[0.0, math.inf, 1.0]], [], [1.0, 2.0, 3.0], [["a", "b", "c"]], None, "fly home",
    np.ones((1000, 3)), [[0.0, 1.0]], [[1.0, 2.0, 3.0], [1.0, 2.0]], {"x": 1.0}, [[1e300, 0.0, 1.0]], [[0.0, 0.0, 1e9]],
)  # fmt: skip
_TEXTS = ("1 2", "replace", "stop now", "\x00\xff", "fly 1 2 3", "nan nan", "1,2,3,4", "stop 1 2 3", "1.0 0.0 one")
_RUNGS = tuple(f"{rung.name.lower()}:" for rung in Rung)
_ENDS = ("flown", "landed", "stopped and landed")  # end of a flight: at the end of its path, in motion, after a stop
_BAD_SHOWN = 20
_STANDING = 1e-9  # m/s, speed up to which a motion counts as at rest
Judge = Callable[[dict[int, SetpointSent], list[Committed], Limits], SequenceVerdict]


@dataclass(frozen=True, slots=True)
class Settings:
    """The flights to draw."""

    flights: int = option(40, "Flights.", least=1)
    requests: int = option(250, "Requests of each flight; the last may be those of a burst.", least=1)
    seconds: float = option(90.0, "Time of each flight in which they are made, s.", least=1)
    seed: int = option(0, "Seed of the first flight.", least=0)


@dataclass(frozen=True, slots=True)
class SteeredFlight:
    """One flight with random requests."""

    seed: int
    planning: float  # s, planning time
    seconds: float  # s of flight along committed setpoints
    requests: int
    accepted: int
    refused: int  # by the planner or the pilot, with a reason
    late: int
    superseded: int
    invalid: int  # refused before planning, as they are not waypoints
    unanswered: int
    ended: str
    end: str  # the pilot's reason
    landed: bool  # on the floor and disarmed, at the end of the path or by the operator
    deviation: float  # m, largest distance from the setpoint
    to_wall: float  # m, least distance of the true position from walls and ceiling
    setpoints: int
    missing: int
    differing: int
    plan_usage: float
    speed: float
    acceleration: float
    stop_acceleration: float
    joint: float
    without_stop: int
    faults: Sequence[str]

    @property
    def planner(self) -> str:
        """Return the planner's time in words."""
        return f"{self.planning:g} s"

    @property
    def hours(self) -> float:
        """Return the time of flight, h."""
        return self.seconds / 3600.0

    @property
    def bad(self) -> bool:
        """Return whether anything went wrong in the flight."""
        return bool(self.faults) or not self.landed or self.unanswered > 0 or self.to_wall <= 0.0


COLUMNS = (
    Column("group", "planner takes", value=lambda rows: rows[0].planner),
    Column("flights", "flights", value=count()),
    Column("hours", "flown", "h", ".2f", value=total("hours")),
    Column("requests", "requests", format=".0f", value=total("requests")),
    Column("accepted", "accepted", format=".0f", value=total("accepted")),
    Column("refused", "refused", format=".0f", meaning="in words: no way leads there, outside, or no waypoints at all",
           value=total(lambda row: row.refused + row.invalid)),
    Column("late", "late", format=".0f", value=total("late")),
    Column("superseded", "superseded", format=".0f", meaning="as another request came before it was planned",
           value=total("superseded")),
    Column("unanswered", "not answered", format=".0f", goal="0", value=total("unanswered")),
)  # fmt: skip
SEQUENCE_COLUMNS = (
    Column("group", "planner takes", value=lambda rows: rows[0].planner),
    Column("setpoints", "setpoints", format=".0f", value=total("setpoints")),
    Column("differing", "not as committed", format=".0f", goal="0", value=total("differing")),
    Column("without_stop", "without a stop", format=".0f", goal="0",
           meaning="setpoints without a committed stop that rests inside", value=total("without_stop")),
    Column("plan_usage", "usage of a limit", "%", ".2f", goal="100 %", meaning="the most, by the dense certificate",
           value=largest("plan_usage")),
    Column("speed", "speed", "m/s", ".3f", value=largest("speed")),
    Column("acceleration", "acceleration", "m/s²", ".2f", meaning="by differences of the velocities streamed",
           value=largest("acceleration")),
    Column("stop_acceleration", "in stops", "m/s²", ".2f", meaning="likewise, in stops that were asked for",
           value=largest("stop_acceleration")),
    Column("joint", "joint", "quanta", ".2f", goal="1", meaning="the most that a field jumps by at a splice",
           value=largest("joint")),
    Column("deviation_mean", "deviation, mean", "cm", ".1f", meaning="of each flight's largest",
           value=mean("deviation")),
    Column("deviation", "largest", "cm", ".1f", value=largest("deviation")),
    Column("to_wall", "to the wall", "m", ".2f", meaning="least distance of the true position",
           value=smallest("to_wall")),
    Column("bad", "flights with a fault", goal="0", value=count("bad")),
)  # fmt: skip
BAD_COLUMNS = (
    Column("seed", "seed"),
    Column("ended", "ended"),
    Column("end", "end"),
    Column("to_wall", "to the wall", "m", ".3f"),
    Column("unanswered", "not answered"),
    Column("faults", "faults", value=lambda rows: "; ".join(rows[0].faults)),
)


class WatchedSteering(SteppedSteering):
    """A flight in the stepped lab that keeps its setpoints and commitments."""

    def __init__(self, limits: Limits, *, planning: float, seed: int, vehicle: VehicleSettings):
        super().__init__(limits, planning=planning, seed=seed, vehicle=vehicle)
        self.commitments: list[Committed] = []
        self.sent: dict[int, SetpointSent] = {}
        self.answered: Counter[int] = Counter()
        self._flies_plan = False

    def start(self, mission: Mission, timeline: Timeline, listeners: Listeners) -> None:
        def hear(message: Telemetry) -> None:
            if isinstance(message, PhaseEntered):
                self._flies_plan = message.phase in (Phase.STREAM, Phase.HOLD)
            elif isinstance(message, Event) and message.text.startswith(_RUNGS):
                self._flies_plan = False  # the vehicle leaves the plan for a stop or a landing
            elif isinstance(message, SetpointSent) and self._flies_plan:
                self.sent.setdefault(message.index, message)
            listeners.telemetry(message)

        def hear_answer(answer: PathAnswer) -> None:
            if answer.verdict not in (PathVerdict.CUT_SHORT, PathVerdict.CHANGED):
                self.answered[answer.number] += 1
            listeners.answer(answer)

        self._keep(timeline, 0)
        super().start(mission, timeline, Listeners(hear, hear_answer))
        assert self.planner is not None
        self.planner.on_committed = lambda made: self._keep(made.timeline, made.proposal.splice)

    def _keep(self, timeline: Timeline, splice: int) -> None:
        """Keep the setpoints, motion and first and last setpoints of the stops of a commitment, from its splice on.

        In a hover the pilot may accept a proposal at a later splice than it was made for; all of it is then delayed.
        """
        commitment, flown = timeline.commitment, timeline.motion
        later = commitment.splices[-1] - splice if commitment.splices else 0
        if later:
            flown = flown_later(flown, splice, later)
        elif self.commitments:
            known, flown = {id(each) for each in self.commitments[-1].flown.trajectories}, self.commitments[-1].flown
            for start, leg in zip(timeline.motion.starts, timeline.motion.trajectories, strict=True):
                if id(leg) not in known:
                    flown = flown.continued(start, leg)
        rows = slice(splice + later - commitment.first, None)
        ends = np.array(commitment.stops[rows][:, [0, -1]])
        payloads = np.array(commitment.payloads[rows])
        if timeline.stopping:  # as was asked for
            stop = splice + later, timeline.stops[-1][1] + later
        else:
            begins = timeline.part_ends
            stop = (0, 0) if begins is None else (begins + later, begins + STOP + later)
        self.commitments.append(Committed(splice + later, payloads, ends, flown, *stop, later=later))


def flown_later(flown: JoinedTrajectory, splice: int, later: int) -> JoinedTrajectory:
    """Return a motion proposed from setpoint `splice` on, delayed by `later` setpoints.

    The vehicle hovers until then, so that motions committed to begin meanwhile are not flown. If the leg that the
    proposal continues already moves there, too slowly for the pilot to tell from a hover, that leg is delayed too.
    """
    begins = splice / RATE
    if np.linalg.norm(flown.at(begins).velocity) > _STANDING:
        begins = max(start for start in flown.starts if start <= begins)
    starts = tuple(start + later / RATE if start >= begins else start for start in flown.starts)
    return JoinedTrajectory(flown.trajectories, starts)


def fly_steered(
    seed: int, limits: Limits, requests: int, seconds: float, judge: Judge = judge_sequence
) -> SteeredFlight:
    """Fly number `seed` with `requests` requests in `seconds`, and judge it by its setpoints and by the truth."""
    chance = np.random.default_rng(seed)
    planning = float(chance.choice(_PLANNING))
    flight = WatchedSteering(limits, planning=planning, seed=seed, vehicle=_vehicle(seed, limits, chance))
    ended, invalid, asked = str(chance.choice(_ENDS)), 0, list[int]()
    vehicle = SteeredVehicle(flight, limits, uri="sim://0")
    failure = ""
    try:
        with vehicle:
            vehicle.take_off(float(chance.uniform(*_TAKE_OFF_HEIGHT)))
            for wish, waypoints, pause in _requests(chance, vehicle, flight, limits, requests, seconds):
                try:
                    asked.append(vehicle.request(wish, waypoints))
                except InputError:
                    invalid += 1
                vehicle.sleep(pause)
            asked += _end(vehicle, ended)
    except CfplanError as error:
        failure = str(error)
    answers, outcome = Counter(answer.verdict for answer in vehicle.answers()), vehicle.outcome
    pending = frozenset() if flight.planner is None else flight.planner.pending  # as the flight ends
    verdict, truth = judge(flight.sent, flight.commitments, limits), flight.lab.truth()
    well = outcome is not None and outcome.exit_code in (ExitCode.OK, ExitCode.ENDED_BY_OPERATOR)
    return SteeredFlight(
        seed=seed,
        planning=planning,
        seconds=verdict.setpoints / RATE,
        requests=len(asked) + invalid,
        accepted=answers[PathVerdict.ACCEPTED],
        refused=answers[PathVerdict.REFUSED],
        late=answers[PathVerdict.LATE],
        superseded=answers[PathVerdict.SUPERSEDED],
        invalid=invalid,
        unanswered=sum(flight.answered[number] != (number not in pending) for number in asked),
        ended=ended,
        end=failure or (outcome.reason if outcome is not None else "no outcome"),
        landed=well and not failure and on_floor(truth),
        deviation=outcome.deviation.max if outcome is not None else math.nan,
        to_wall=to_wall(truth, limits.space),
        **asdict(verdict),
    )


def _vehicle(seed: int, limits: Limits, chance: np.random.Generator) -> VehicleSettings:
    """Return a vehicle that stands somewhere in the middle half of the room."""
    low, high = np.array(limits.space.low[:2]), np.array(limits.space.high[:2])
    x, y = ((low + high) / 2 + chance.uniform(-0.25, 0.25, 2) * (high - low)).tolist()
    return VehicleSettings(seed=seed, position=(x, y, 0.0), yaw=float(chance.uniform(-1.0, 1.0)))


def _requests(
    chance: np.random.Generator,
    vehicle: SteeredVehicle,
    flight: SteppedSteering,
    limits: Limits,
    count: int,
    seconds: float,
) -> Iterator[tuple[Wish, Any, float]]:
    """Yield requests with their waypoints and the pause after each, s; set planner faults at random."""
    mean_burst = sum(_BURST) / 2.0
    apart = seconds / count * (1.0 + _BURST_FRACTION * mean_burst)
    made = 0
    while made < count:
        together = int(chance.integers(*_BURST)) if chance.random() < _BURST_FRACTION else 1
        for number in range(together):
            assert flight.planner is not None
            faults = [*PlannerFault]
            faults.remove(PlannerFault.KILLED)  # a killed planner would not answer any further request
            flight.planner.fault = faults[chance.integers(len(faults))] if chance.random() < _FAULT_FRACTION else None
            last = number == together - 1
            pause = float(chance.exponential(apart)) if last else _BURST_PERIOD
            yield *_drawn(chance, vehicle, limits), pause
        made += together
    assert flight.planner is not None
    flight.planner.fault = None


def _drawn(chance: np.random.Generator, vehicle: SteeredVehicle, limits: Limits) -> tuple[Wish, Any]:
    kind = str(chance.choice(list(_FRACTIONS), p=list(_FRACTIONS.values())))
    space = limits.space
    low, high = np.array(space.low) + space.margin, np.array(space.high) - space.margin
    points = chance.uniform(low, high, (int(chance.integers(1, 5)), 3))
    wish = Wish.EXTEND if chance.random() < 0.5 else Wish.REPLACE
    match kind:
        case "extend" | "replace" | "stop" | "slower" | "faster":
            return Wish(kind), points
        case "near":
            points[0] = np.clip(np.array(vehicle.target) + chance.uniform(-_NEAR, _NEAR, 3), low, high)
        case "outside":
            points[chance.integers(len(points)), chance.integers(3)] = chance.choice([-1.0, 1.0]) * chance.uniform(4, 9)
        case "garbage":
            with contextlib.suppress(InputError):
                parse_line(_TEXTS[chance.integers(len(_TEXTS))])
                raise AssertionError("a line that is none was read")
            return wish, _GARBAGE[chance.integers(len(_GARBAGE))]
    return wish, points


def _end(vehicle: SteeredVehicle, how: str) -> list[int]:
    """End a flight; return the numbers of the requests made to end it."""
    asked = []
    if how == "stopped and landed":
        asked.append(vehicle.request(Wish.STOP))
        vehicle.sleep(0.4)
    if how == "flown":
        vehicle.wait()
        vehicle.finish()
    else:
        vehicle.land()
    return asked


def work(settings: Settings, run: Run) -> Work:
    """Return one case per seed, under the limits of this folder."""
    seeds = range(settings.seed, settings.seed + settings.flights)
    measure = partial(fly_steered, limits=limits_for(Path()), requests=settings.requests, seconds=settings.seconds)
    return Work({str(seed): seed for seed in seeds}, measure, SteeredFlight)


def tables(settings: Settings, rows: list[SteeredFlight]) -> Iterator[Table]:
    """Yield the outcomes of requests and the verdicts on setpoints, by planning time, and the failed flights."""
    flights, bad = sorted(rows, key=attrgetter("planning")), [row for row in rows if row.bad]
    requests, hours = sum(row.requests for row in rows), sum(row.hours for row in rows)
    title = f"{requests} random requests in {hours:.2f} h of flight"
    yield table("requests", title, COLUMNS, flights, by=("planning",), last="all")
    yield table("sequence", "What was streamed", SEQUENCE_COLUMNS, flights, by=("planning",), last="all")
    yield table("bad", f"{len(bad)} flights went wrong", BAD_COLUMNS, bad[:_BAD_SHOWN])


STUDY = Study(Settings, work, tables, "--flights 40 --workers 2 -o results/steering.json")
