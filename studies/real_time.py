"""Fly a mission in real time on the virtual Crazyflie, with the pilot's process, cflib, packets, poses and a record."""

import multiprocessing
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from cfplan.errors import CfplanError, ExitCode, InputError
from cfplan.flight.mocap.source import pose_source
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import FlightOutcome
from cfplan.flight.pilot.process import fly
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.telemetry import Phase, PhaseEntered, SetpointSent, Telemetry
from cfplan.recording.header import RecordHeader, header_under
from cfplan.recording.rerun.live import LiveView
from cfplan.recording.writer import RecordWriter, wall_time_at_zero
from cfplan.safety.limits import Limits
from cfplan.simulation.lab.lab import Lab, Truth, start_lab
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.lab.room import RoomSettings
from cfplan.simulation.lab.sim_driver import SimDriver
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.vehicle.airframe import Airframe

LATENESS_CHECK = "this computer's lateness"
RETRIES = 2  # after refusals for lateness alone
_MOST_NOISE = 1.0  # m


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions of the lab: radio loss, pose noise."""

    loss: float = 0.0  # fraction of the radio's transmissions
    pose_noise: float = 0.001  # m, standard deviation of each axis
    seed: int = 0  # of all noise
    airframe: Airframe | None = None  # of the vehicle; None: as the mission's limits state it

    def __post_init__(self) -> None:
        if not (0 <= self.loss < 1 and 0 <= self.pose_noise < _MOST_NOISE):
            raise InputError(
                f"a loss of {self.loss} and pose noise of {self.pose_noise} m make no sense",
                hint=f"loss is a fraction from 0 to less than 1, noise less than {_MOST_NOISE:g} m",
            )


@dataclass(slots=True)
class RealTimeFlight:
    """The outcome of a flight in real time, with its setpoints and truth."""

    outcome: FlightOutcome | None  # None if there was no vehicle or no pose
    reason: str  # how it ended, in one line
    refusals: int = 0  # earlier attempts that preflight refused only because this computer was late
    sent: list[SetpointSent] = field(default_factory=list)  # the plan's setpoints
    truth: Truth | None = None
    view_failure: str = ""  # why the live view ended early; empty if it did not

    @property
    def landed(self) -> bool:
        """Return whether it flew its plan to the end and landed."""
        return self.outcome is not None and self.outcome.exit_code is ExitCode.OK

    def time_to(self, index: int) -> float:
        """Return the time, s, from the first setpoint sent to the first numbered `index` or higher; 0 if none."""
        ended = (message.time for message in self.sent if message.index >= index)
        return next(ended, self.sent[0].time) - self.sent[0].time if self.sent else 0.0


View = Callable[[RecordHeader], AbstractContextManager[LiveView]]


def simulated_lab(mission: Mission, conditions: Conditions) -> Lab:
    """Start a lab with these conditions."""
    noise, seed = conditions.pose_noise, conditions.seed
    lab = start_lab(
        conditions.airframe or mission.limits.airframe,
        vehicle=VehicleSettings(seed=seed),
        room=RoomSettings(ViconSettings(position_noise=noise, seed=seed)),
    )
    if conditions.loss:
        lab.disturb(RadioFault(RadioFaultKind.LOSS, size=conditions.loss))
    return lab


def fly_in_real_time(
    mission: Mission,
    conditions: Conditions,
    *,
    name: str,
    view: View | None = None,
    on_stream: Callable[[int], None] = lambda _: None,
    pilot: Callable[..., FlightOutcome] = fly,
    start: Callable[[Mission, Conditions], Lab] = simulated_lab,
) -> RealTimeFlight:
    """Fly a mission; retry if preflight refuses for lateness alone. A failure is the result's reason, not raised.

    `on_stream` is called with the process id of the pilot when the stream begins. `pilot` flies like `fly` in the lab
    that `start` returns.
    """
    refusals = 0
    while True:
        flight = _fly_once(
            mission, conditions, partial(pilot, mission), start, name=name, view=view, on_stream=on_stream
        )
        flight.refusals = refusals
        if refusals == RETRIES or not _refused_for_lateness(flight.outcome):
            return flight
        refusals += 1


def patient(limits: Limits) -> Limits:
    """Return limits under which lateness neither refuses nor ends a flight that measures it."""
    pose = replace(limits.pose, age_warning=0.15, age_brake=0.5, age_land=1.5)
    return replace(limits, pose=pose, lateness=1.0)


def _refused_for_lateness(outcome: FlightOutcome | None) -> bool:
    if outcome is None or outcome.exit_code is not ExitCode.PREFLIGHT:
        return False
    return {check.name for check in outcome.checks if not check.passed} == {LATENESS_CHECK}


def _fly_once(
    mission: Mission,
    conditions: Conditions,
    pilot: Callable[..., FlightOutcome],
    start: Callable[[Mission, Conditions], Lab],
    *,
    name: str,
    view: View | None,
    on_stream: Callable[[int], None],
) -> RealTimeFlight:
    flight = RealTimeFlight(None, "")
    header, phase = _header(mission, name), Phase.CLOSED

    def hear(message: Telemetry) -> None:
        nonlocal phase
        writer.write(message)
        if watching is not None:
            watching.show(message)
        if isinstance(message, PhaseEntered):
            phase = message.phase
            if phase is Phase.STREAM:
                on_stream(_pilot())
        elif isinstance(message, SetpointSent) and phase is Phase.STREAM:
            flight.sent.append(message)

    try:
        with (
            tempfile.TemporaryDirectory(prefix="cfplan-") as folder,
            start(mission, conditions) as lab,
            RecordWriter(Path(folder), header) as writer,
            view(header) if view is not None else nullcontext() as watching,
        ):
            poses = pose_source(lab.mocap_uri, mission.limits.pose, open_within=10.0)
            flight.outcome = pilot(uri=lab.uri, drivers=[SimDriver], pose_source=poses, on_telemetry=hear)
            flight.truth = lab.truth()
        flight.reason = flight.outcome.reason
        flight.view_failure = watching.failure if watching is not None else ""
    except CfplanError as error:
        flight.reason = str(error)
    return flight


def _pilot() -> int:
    """Return the process id of the pilot."""
    pilots = (child.pid for child in multiprocessing.active_children() if child.name == "pilot")
    return next(pilots, 0) or 0


def _header(mission: Mission, name: str) -> RecordHeader:
    return header_under(
        mission.limits,
        name=name,
        uri="sim://0",
        path=decode(mission.payloads).position[::5],
        travel_time=mission.motion_ends,
        wall_time_at_zero=wall_time_at_zero(),
    )
