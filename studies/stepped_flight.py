"""Fly a mission in the stepped lab, with or without faults, and judge the flight by the simulated truth.

In the stepped lab (`cfplan.simulation.lab.stepped_lab`) the pilot, the packets, the pose tracker, the virtual Crazyflie
and the virtual cameras are those of a flight in real time; there are no processes and no sockets.
"""

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from cfplan.air.requests import PathAnswer, Wish
from cfplan.air.stepped import PlannerFault, SteppedPlanner
from cfplan.air.timeline import Timeline, hold
from cfplan.errors import CfplanError, ExitCode, InputError
from cfplan.flight.pilot.keys import HeldOrders, Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import FlightOutcome, Rung
from cfplan.flight.pilot.pilot import Pilot
from cfplan.flight.pilot.proposals import NO_PROPOSALS
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.telemetry import Event, Phase, PhaseEntered, SetpointSent, Telemetry, Triple
from cfplan.geometry.path_file import load_path_file
from cfplan.preparation.plan_flight import plan_flight
from cfplan.recording.header import RecordHeader, header_under
from cfplan.recording.reader import read_record
from cfplan.recording.writer import RecordWriter, new_file
from cfplan.safety.limits import Limits
from cfplan.safety.space import Space
from cfplan.simulation.lab.lab import Fault, Truth
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.lab.stepped_link import SteppedPoses, connect
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.supervisor import State
from cfplan.simulation.virtual_vicon.cameras import ViconSettings

FOR_GOOD = 60.0  # s, longer than any flight
ASKED: Triple = (0.6, 2.0, 1.0)  # m, a waypoint that a healthy planner could reach
FULL_SPEED = 1.5  # s after the stream began: the cruise of flights/line.yaml
_DOWN = 0.05  # m
_SETTLING = 0.1  # s until the supervisor reports that the vehicle was disarmed
_AFTERWARDS = 6.0  # s that the vehicle gets to come to rest after the pilot ended
_LONGEST = 100.0  # s; a vehicle that is left to itself on the floor disarms 30 s after arming
_ARMED = (State.ARMING, State.READY_TO_FLY, State.FLYING, State.WARNING_LEVEL_OUT, State.LANDED)
_RUNGS = tuple(f"{rung.name.lower()}:" for rung in Rung)  # an event that names a rung begins with one of these


@dataclass(frozen=True, slots=True)
class Scenario:
    """A flight: what goes wrong and when, and what it must lead to."""

    name: str
    rung: Rung  # that it must lead to, and no lower one
    faults: tuple[Fault, ...] = ()  # start times relative to `moment`
    phase: Phase = Phase.STREAM  # in which the fault begins
    moment: float = FULL_SPEED  # s after the phase began
    stall: float = 0.0  # s for which the pilot's computer stalls
    stall_after: float = 0.0  # s after `moment`
    order: Order | None = None  # operator command at `moment`
    main_killed: bool = False
    main_killed_after: float = 0.0  # s after `moment`
    pilot_killed: bool = False
    pilot_killed_after: float = 0.0  # s after `moment`
    disk_full: bool = False
    planner: PlannerFault | None = None
    """Fault of the in-flight planner, which is asked to fly to ASKED at `moment`."""
    from_start: bool = False  # the faults are active before the pilot connects
    vehicle: VehicleSettings = field(default_factory=lambda: VehicleSettings(auto_arming=False))
    """Arms only on request, so that a test can see whether the vehicle was disarmed."""
    cameras: ViconSettings | None = None  # None: the lab's defaults
    falls: bool = False
    """Motors stop in the air: the vehicle's supervisor stops them, or a take-off ends just above the floor."""
    grounded: bool = False  # the vehicle must never take off

    @property
    def leaves_alone(self) -> bool:
        """Return whether the vehicle is left to its own time-outs: the pilot or the radio dies for good."""
        deaths = (RadioFaultKind.DEAD, RadioFaultKind.UNACKNOWLEDGED)
        dead = (fault.kind in deaths and fault.duration >= FOR_GOOD for fault in self.faults)
        return self.pilot_killed or any(dead)


class PilotKilled(BaseException):
    """Simulates the sudden death of the pilot's process."""


@dataclass(frozen=True, slots=True)
class FaultFlight:
    """One flight with faults, judged by the truth."""

    name: str  # of the scenario
    phase: str  # in which the fault begins
    expected: str
    rung: str
    reaction: float | None  # s from the fault to the first rung; None if the pilot took none
    off_plan: float  # m, largest distance of the true position from the planned path; horizontal once landing begins
    off_setpoint: float  # m, largest distance of the true position from the setpoint, until landing begins
    to_wall: float  # m, least distance of the true position from walls and ceiling; negative beyond them
    highest: float  # m above the floor
    rest: Triple  # m, where it came to rest
    motors_off: int  # ms with all motors off in the air
    landed: bool  # on the floor, motors off
    disarmed: bool
    locked: bool  # the supervisor locked at some time
    readable: bool  # the record can be read
    reason: str
    planner: str  # its answer; empty if it was not asked or did not answer
    seed: int = 0  # of the flight's random faults
    path: str = ""  # set where a study flies several paths

    @property
    def bad(self) -> bool:
        """Return whether the vehicle left the walls, did not land or disarm, or left no readable record."""
        return not (self.to_wall > 0.0 and self.landed and self.disarmed and self.readable)

    @property
    def end(self) -> str:
        """Return how the flight ended, in words."""
        ends = [text for text, holds in (("landed", self.landed), ("disarmed", self.disarmed)) if holds]
        without = f", {self.motors_off} ms without motors" if self.motors_off else ""
        return (", ".join(ends) or "in the air") + without


@dataclass(slots=True)
class SteppedFlight:
    """The outcome of a flight in the stepped lab, with its truth and messages."""

    outcome: FlightOutcome | None  # None where the pilot was killed, or never flew
    reason: str
    truth: Truth
    struck: float  # s, when the fault began; NaN if it was active from the start or never began
    events: list[tuple[float, str]] = field(default_factory=list)
    answers: list[PathAnswer] = field(default_factory=list)  # the planner's
    sent: list[tuple[float, Triple]] = field(default_factory=list)  # (s, m) of each setpoint of the plan
    landing: float = math.inf  # s, when the last phase of landing began
    killed: bool = False  # the pilot was killed, in flight or before
    ended: bool = False  # the pilot returned or raised


def prepare_timeline(source: Path, limits: Limits) -> Timeline:
    """Plan a path file and return the flight as the in-flight planner holds it. Raises what planning raises."""
    return hold(plan_flight(source, limits).plan, load_path_file(source).waypoints)


def fly_scenario(
    scenario: Scenario, mission: Mission, seed: int = 0, *, timeline: Timeline | None = None
) -> FaultFlight:
    """Fly a scenario, record it, and judge it by the truth. A planner fault needs a `timeline`."""
    if scenario.planner is not None:
        if timeline is None:
            raise InputError(
                "no planner flies with a mission alone",
                where=scenario.name,
                hint="give what prepare_timeline() returns",
            )
        mission = Mission(timeline.commitment.payloads, timeline.commitment.stops, mission.limits)
    lab = _lab(scenario, mission, seed)
    with tempfile.TemporaryDirectory() as folder:
        writer = RecordWriter(
            Path(folder),
            _header(mission),
            warn=lambda _: None,
            open_file=_FullDisk if scenario.disk_full else new_file,
            clock=lab.clock,
        )
        with writer:
            flown = fly_stepped(scenario, mission, listen=writer.write, lab=lab, timeline=timeline)
        try:
            readable = len(read_record(Path(folder)).phases.time) > 0
        except CfplanError:
            readable = False
    return judge(scenario, flown, mission, readable)


def fly_stepped(
    scenario: Scenario,
    mission: Mission,
    *,
    listen: Callable[[Telemetry], None] = lambda _: None,
    seed: int = 0,
    lab: SteppedLab | None = None,
    timeline: Timeline | None = None,
) -> SteppedFlight:
    """Fly a scenario in a stepped lab, by default a new one with this seed, until everything has come to rest."""
    lab = lab or _lab(scenario, mission, seed)
    orders, flown, begin = HeldOrders(), SteppedFlight(None, "", lab.truth(), math.nan), lab.now
    planner = None
    if scenario.planner is not None and timeline is not None:
        planner = SteppedPlanner(timeline, mission.limits, lab.clock, flown.answers.append)

    def hear(message: Telemetry) -> None:
        if flown.killed:
            return
        listen(message)
        if isinstance(message, Event):
            flown.events.append((message.time, message.text))
        elif isinstance(message, SetpointSent):
            flown.sent.append((message.time, message.position))
        elif isinstance(message, PhaseEntered):
            if message.phase is Phase.LAND:
                flown.landing = message.time
            if message.phase is scenario.phase and math.isnan(flown.struck):
                lab.clock.at(message.time + scenario.moment, lambda: _strike(scenario, lab, flown, orders, planner))

    if scenario.from_start:
        for fault in scenario.faults:
            lab.disturb(fault)
    pilot = Pilot(
        mission,
        connect=lambda waiting: connect(lab, hear),
        source=SteppedPoses(lab, mission.limits.pose),
        report=hear,
        orders=orders,
        proposals=planner or NO_PROPOSALS,
        clock=lab.clock,
    )
    try:
        flown.outcome = pilot.fly()
        flown.reason = flown.outcome.reason
    except PilotKilled:
        flown.reason = "the pilot was killed"
    except CfplanError as error:
        flown.reason = str(error)
    flown.ended = True
    lab.clock.sleep(_SETTLING)
    flown.truth = lab.truth()
    if not on_floor(flown.truth):
        lab.clock.sleep(_AFTERWARDS)
        flown.truth = lab.truth()
    while scenario.leaves_alone and flown.truth.supervisor[-1] in _ARMED and lab.now < begin + _LONGEST:
        lab.clock.sleep(_AFTERWARDS)
        flown.truth = lab.truth()
    return flown


def _strike(
    scenario: Scenario, lab: SteppedLab, flown: SteppedFlight, orders: HeldOrders, planner: SteppedPlanner | None
) -> None:
    """Apply the faults and orders of a scenario now, or schedule them."""

    def kill() -> None:
        if flown.ended:
            return
        flown.killed = True
        lab.disturb(RadioFault(RadioFaultKind.DEAD))  # the pilot's cleanup code must not reach the vehicle
        raise PilotKilled

    flown.struck = lab.now
    for fault in scenario.faults if not scenario.from_start else ():
        lab.disturb(fault)
    orders.worst = scenario.order
    if planner is not None:
        planner.fault = scenario.planner
        planner.request(Wish.REPLACE, [ASKED])
    if scenario.stall:
        lab.clock.at(lab.now + scenario.stall_after, lambda: lab.clock.stall(scenario.stall))
    if scenario.main_killed:
        lab.clock.at(lab.now + scenario.main_killed_after, lambda: setattr(orders, "gone", True))
    if scenario.pilot_killed:
        lab.clock.at(lab.now + scenario.pilot_killed_after, kill)


def _lab(scenario: Scenario, mission: Mission, seed: int) -> SteppedLab:
    return SteppedLab(mission.limits.airframe, vehicle=scenario.vehicle, cameras=scenario.cameras, seed=seed)


def judge(scenario: Scenario, flown: SteppedFlight, mission: Mission, readable: bool) -> FaultFlight:
    """Return the verdict on a flight, by the simulated truth."""
    truth, outcome = flown.truth, flown.outcome
    rung = outcome.rung if outcome is not None else Rung.NONE
    rungs = (time for time, text in flown.events if time >= flown.struck and text.startswith(_RUNGS))
    reaction = next((time - flown.struck for time in rungs), None)
    flew = (
        outcome is not None and Phase.TAKE_OFF in dict(outcome.phases) and outcome.exit_code is not ExitCode.PREFLIGHT
    )
    return FaultFlight(
        name=scenario.name,
        phase=str(scenario.phase),
        expected="no take-off" if scenario.grounded else scenario.rung.name.lower(),
        rung=rung.name.lower() if flew or flown.killed else "no take-off",
        reaction=reaction,
        off_plan=_off_plan(flown, mission),
        off_setpoint=_off_setpoint(flown, mission),
        to_wall=to_wall(truth, mission.limits.space),
        highest=float(truth.position[:, 2].max()),
        rest=tuple(truth.position[-1].tolist()),
        motors_off=int(truth.off_in_air[-1]),
        landed=on_floor(truth),
        disarmed=truth.supervisor[-1] not in _ARMED,
        locked=truth.locked,
        readable=readable,
        reason=flown.reason,
        planner=", ".join(answer.reason or answer.verdict.value for answer in flown.answers),
    )


def to_wall(truth: Truth, space: Space) -> float:
    """Return the least distance, m, of the true position from walls and ceiling; negative beyond them."""
    low, high = np.array(space.low), np.array(space.high)
    low[2] = -np.inf  # the vehicle may touch the floor
    return float(np.minimum(truth.position - low, high - truth.position).min())


def on_floor(truth: Truth) -> bool:
    """Return whether the vehicle came to rest on the floor with its motors off."""
    return bool(truth.position[-1, 2] < _DOWN and not truth.motor[-1].any())


def _off_plan(flown: SteppedFlight, mission: Mission) -> float:
    outcome, truth = flown.outcome, flown.truth
    begin = flown.struck if not math.isnan(flown.struck) else outcome.first_setpoint if outcome is not None else 0.0
    if outcome is None and (not flown.sent or begin < flown.sent[0][0]):
        return 0.0
    if outcome is not None and (not outcome.first_setpoint or begin < outcome.first_setpoint):
        return 0.0
    planned = decode(mission.payloads).position
    after = truth.time >= begin
    flying = after & (truth.time < flown.landing) & (truth.position[:, 2] > 0.02)
    down = after & (truth.time >= flown.landing)
    near = cKDTree(planned).query(truth.position[flying])[0]
    beside = cKDTree(planned[:, :2]).query(truth.position[down][:, :2])[0]
    return float(max(near.max(initial=0.0), beside.max(initial=0.0)))


def _off_setpoint(flown: SteppedFlight, mission: Mission) -> float:
    """Return the largest distance, m, from the setpoint of the same moment: lagging along the path counts."""
    if not flown.sent:
        return 0.0
    sent, truth = np.array([time for time, _ in flown.sent]), flown.truth
    begin = sent[0] if math.isnan(flown.struck) else max(sent[0], flown.struck)
    during = (truth.time >= begin) & (truth.time <= min(sent[-1], flown.landing))
    places = np.array([place for _, place in flown.sent])
    due = truth.time[during] - mission.lead
    wanted = np.column_stack([np.interp(due, sent, places[:, axis]) for axis in range(3)])
    return float(np.linalg.norm(truth.position[during] - wanted, axis=1).max(initial=0.0))


class _FullDisk:
    """A file on a disk that is full after the header."""

    def __init__(self, path: Path):
        self._file = path.open("xb", buffering=0)
        self._left = 200_000

    def write(self, data: bytes, /) -> int | None:
        if len(data) > self._left:
            raise OSError(28, "No space left on device")
        self._left -= len(data)
        return self._file.write(data)

    def truncate(self, size: int, /) -> int:
        return self._file.truncate(size)

    def close(self) -> None:
        self._file.close()


def _header(mission: Mission) -> RecordHeader:
    path = decode(mission.payloads).position[::5]
    return header_under(mission.limits, name="fault", uri="stepped://0", path=path, travel_time=mission.motion_ends)
