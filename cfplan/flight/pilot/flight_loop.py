"""What the pilot does over and over, whatever phase it is in.

Everything happens in ticks at the rate of the setpoints. A tick waits for its deadline, sends what is due, forwards
the newest good pose, and looks at what could end the flight; so whatever the pilot waits for, poses flow and the watch
is kept. A reason to leave the plan arrives as `AbortRaised`, out of any wait.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

from cfplan.flight.mocap.pose_gate import PoseGate
from cfplan.flight.mocap.pose_predictor import PosePredictor
from cfplan.flight.mocap.poses import Pose, PoseSource
from cfplan.flight.pilot.abort_monitor import LINK_GONE, Abort, AbortMonitor, Observation
from cfplan.flight.pilot.deadlines import Deadlines
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import Check, Rung
from cfplan.flight.pilot.stream import Stream
from cfplan.flight.radio.link import Link
from cfplan.flight.telemetry import Event, Level, Phase, PhaseEntered, PoseReceived, Quaternion, Telemetry, Triple

REPLY = 0.2  # s that the on-board commander has to answer; setpoints may stay out for 0.5 s
TRIES = 3
_SIGN_OF_LIFE = 0.1  # s between those for the vehicle's watchdog, which waits for 1 s


class OrderSource(Protocol):
    """Where the operator's orders come from."""

    worst: Order | None
    gone: bool


class AbortRaised(Exception):
    """There is a reason to leave the plan."""

    def __init__(self, abort: Abort):
        self.abort = abort
        super().__init__(abort.text)


class LinkLost(Exception):
    """Nothing more can be sent."""


class FlightLoop:
    """The link, the poses and the watch of one flight, ticking."""

    def __init__(
        self,
        mission: Mission,
        source: PoseSource,
        report: Callable[[Telemetry], None],
        orders: OrderSource,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self.mission, self.limits, self.source = mission, mission.limits, source
        self.report, self.now = report, clock
        self._orders, self._sleep = orders, sleep
        self._monitor = AbortMonitor(mission.limits)
        self._pose_gate, self._predictor = PoseGate(mission.limits.pose.jump), PosePredictor()
        self.plan = Stream(mission.payloads, mission.rate, stop_from=mission.stops.__getitem__)
        self.stream: Stream | None = None  # what each tick sends; None while the on-board commander flies
        self.sending_paused = False  # sends nothing for a moment
        self.link: Link
        self.connected = self.feeding = self.airborne = False
        self.floor = 0.0  # m, height of the tracked body before take-off
        self.rung = Rung.NONE  # an abort of this rung or a lesser one changes nothing
        self.deadlines: Deadlines
        self.phases: list[tuple[Phase, float]] = []
        self.checks: tuple[Check, ...] = ()
        self.pose_fault = ""  # why the last pose was not good
        self._source_fault = ""
        self._sign_of_life = -math.inf  # s, when the vehicle's watchdog last had one
        self.recent: deque[Pose] = deque()  # the good poses of the last second
        self.waking: deque[float] = deque(maxlen=200)  # s by which the last ticks were late
        self.late: list[float] = []  # the same of the plan's setpoints
        # (s from the first setpoint, m) of each pose in the stream and the hover behind it
        self.off_plan: list[tuple[float, float]] = []

    def tick(self) -> float:
        """One deadline: the setpoint, then the pose, then the look-out. The time after it, s."""
        due = self.deadlines.wait()
        now = self.now()
        stream = self.stream
        if stream is not None and not self.sending_paused:
            index = stream.index(now)
            self.link.send(stream.packets[index])
            if self.plan.start:
                self.report(stream.sent(index, now, due))
            if stream is self.plan and now < stream.end:
                self.late.append(now - due)
        if self.airborne and self.limits.firmware.watchdog and now - self._sign_of_life > _SIGN_OF_LIFE:
            self._sign_of_life = now
            self.link.keep_alive()
        self.waking.append(now - due)
        if self.feeding:
            self._forward_poses()
        self._keep_watch(now, now - due)
        return now

    def _forward_poses(self) -> None:
        newest, estimate = None, self.link.estimate
        if self.airborne and estimate is not None and self.now() - estimate.time <= self.limits.pose.age_warning:
            self.source.tell_attitude(estimate.quaternion)
        for pose in self.source.poses():
            self.report(PoseReceived(pose.time, pose.received, pose.position, pose.quaternion))
            fault = self._pose_gate.fault(pose)
            if fault != self.pose_fault:
                self.pose_fault = fault
                self.say(Level.WARNING, f"pose: {fault}" if fault else "pose: good again")
            if not fault:
                newest = pose
                self.recent.append(pose)
                self._predictor.add(pose)
                self._note_deviation(pose)
        if self.source.fault != self._source_fault:
            self._source_fault = self.source.fault
            self.say(Level.WARNING, f"motion capture: {self._source_fault or 'good again'}")
        now = self.now()
        if newest is not None and now - newest.time < self.limits.pose.age_brake:
            self.link.send_pose(self._predictor.position(now), newest.quaternion)
        while len(self.recent) > 1 and self.recent[0].time < self.recent[-1].time - 1.0:
            self.recent.popleft()

    def _note_deviation(self, pose: Pose) -> None:
        if self.stream is not self.plan or pose.time < self.plan.start:
            return
        elapsed = pose.time - self.plan.start
        distance = math.dist(pose.position, self.plan.position(pose.time - self.mission.lead))
        self.off_plan.append((elapsed, distance))

    def _keep_watch(self, now: float, late: float) -> None:
        link = self.link
        if link.lost or (self.airborne and link.estimate is not None and now - link.estimate.time > LINK_GONE):
            raise LinkLost
        pose, stream = self._pose_gate.last, self.stream
        observation = Observation(
            now=now,
            order=self._orders.worst,
            main_gone=self._orders.gone,
            pose=pose,
            pose_fault=self.source.fault or self.pose_fault,
            wanted=stream.position(pose.time - self.mission.lead) if stream is not None and pose is not None else None,
            estimate=link.estimate,
            status=link.status,
            late=late if stream is not None else 0.0,
        )
        abort = self._monitor.gravest(observation) if self.airborne else self._monitor.ordered(observation)
        if abort is not None and abort.rung > self.rung:
            raise AbortRaised(abort)

    def look_at_orders(self) -> None:
        """What a tick does before there is a link."""
        abort = self._monitor.ordered(Observation(self.now(), self._orders.worst, self._orders.gone))
        if abort is not None:
            raise AbortRaised(abort)

    def restart_deadlines(self) -> None:
        """Deadlines from now on; those that something slow on the ground has missed do not count."""
        self.deadlines = Deadlines(self.mission.rate, self.now, self._sleep)

    def until(self, done: Callable[[], bool], patience: float) -> bool:
        """Tick until it is done; whether it was, in time."""
        end = self.now() + patience
        while self.tick() < end:
            if done():
                return True
        return done()

    def pause(self, duration: float) -> None:
        self.until(lambda: False, duration)

    def ask(self, command: Callable[[], None], number: int, tries: int = TRIES) -> int | None:
        """Command the on-board commander; its answer, or None where there is none."""
        for _ in range(tries):
            command()
            if self.until(lambda: number in self.link.replies, REPLY):
                return self.link.replies[number]
        return None

    def pose(self) -> Pose:
        pose = self._pose_gate.last
        assert pose is not None  # nothing asks before the feed has begun
        return pose

    def resting(self) -> tuple[Triple, Quaternion]:
        """Where the vehicle is asked to hover: at the stream's end, or without one where it is."""
        if self.stream is None:
            return self.pose().position, self.pose().quaternion
        position, _, _, quaternion, _ = self.stream.states[self.stream.last]
        return position, quaternion

    def bits(self, mask: int) -> int:
        status = self.link.status
        return status.supervisor & mask if status is not None else 0

    def enter(self, phase: Phase) -> None:
        now = self.now()
        self.phases.append((phase, now))
        self.report(PhaseEntered(now, phase))

    def say(self, level: Level, text: str) -> None:
        self.report(Event(self.now(), level, text))
