"""The pilot: the phases of one flight from connecting to closing, and the ways out of it.

Everything happens in ticks at the rate of the setpoints. A tick waits for its deadline, sends what is due, forwards
the newest good pose, and looks at what could end the flight; so whatever the pilot waits for, poses flow and
the watch is kept. A reason to leave the plan arrives as `Tripped`, and each rung of the abort ladder can only be left
for a graver one.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

from cfplan.errors import CfplanError, ExitCode, InputError, PreflightError
from cfplan.flight.forecast import Forecast
from cfplan.flight.freshness import Freshness
from cfplan.flight.keys import Order
from cfplan.flight.link import GO_TO, LAND, TAKE_OFF, Link
from cfplan.flight.mission import Mission, manoeuvre_time, yaw_of
from cfplan.flight.outcome import Check, Deviation, FlightOutcome, Rung, settle_time
from cfplan.flight.pace import Lateness, Pace
from cfplan.flight.poses import Pose, PoseSource
from cfplan.flight.preflight import CAN_FLY, FLYING, Ground, run_checks
from cfplan.flight.stream import Stream
from cfplan.flight.telemetry import (
    Event,
    Level,
    Phase,
    PhaseEntered,
    PoseReceived,
    Telemetry,
    Triple,
)
from cfplan.flight.watch import LINK_GONE, Seen, Trip, Watch

ARMED, HIGH_LEVEL_ACTIVE = 1 << 1, 1 << 8  # bits of supervisor.info
CONVERGED_WITHIN = 0.03  # m, estimate from pose
CONVERGED_FOR = 1.0  # s
SETTLED_WITHIN = 0.03  # m, from where the motion ended
_AT_START_WITHIN = 0.06  # m
_BRAKE_HOLD = 1.0  # s of hover after a stop
_ON_THE_FLOOR = 0.15  # m above where it took off
_REPLY = 0.2  # s that the on-board commander has to answer; setpoints may stay out for 0.5 s
_TRIES = 3


class OrdersFrom(Protocol):
    """Where the operator's orders come from."""

    worst: Order | None
    gone: bool


class Tripped(Exception):
    """There is a reason to leave the plan."""

    def __init__(self, trip: Trip):
        self.trip = trip
        super().__init__(trip.text)


class LinkLost(Exception):
    """Nothing more can be sent."""


class Pilot:
    """Flies one mission, once."""

    def __init__(
        self,
        mission: Mission,
        *,
        connect: Callable[[Callable[[], None]], Link],
        source: PoseSource,
        report: Callable[[Telemetry], None],
        orders: OrdersFrom,
        quieten: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self._mission, self._connect, self._source = mission, connect, source
        self._report, self._orders, self._quieten = report, orders, quieten
        self._limits, self._now, self._sleep = mission.limits, clock, sleep
        self._plan = Stream(mission.payloads, mission.rate)
        self._watch = Watch(mission.limits)
        self._freshness, self._forecast = Freshness(mission.limits.pose.jump), Forecast()
        self._link: Link
        self._connected = self._feeding = self._airborne = False
        self._stream: Stream | None = None
        self._rung = self._reached = Rung.NONE
        # the rung that only a graver one ends, and how far down the flight came
        self._floor = 0.0
        # m, height of the tracked body before take-off
        self._phases: list[tuple[Phase, float]] = []
        self._checks: tuple[Check, ...] = ()
        self._recent: deque[Pose] = deque()
        self._waking: deque[float] = deque(maxlen=200)
        self._late: list[float] = []
        self._skipped = 0
        self._pose_fault = ""
        self._pace: Pace
        self._off_plan: list[tuple[float, float]] = []
        # (s from the first setpoint, m) of each pose in the stream and the hover behind it
        self._stopped_at = 0.0

    def fly(self) -> FlightOutcome:
        """All phases. Raises a CfplanError where the vehicle or its poses cannot be had; nothing is armed then."""
        exit_code, reason = ExitCode.OK, "landed"
        try:
            try:
                self._prepare()
                self._perform()
            except Tripped as tripped:
                exit_code, reason = self._leave_plan(tripped.trip)
            except CfplanError as error:
                if not self._connected or not self._checks:
                    raise
                exit_code, reason = error.exit_code, str(error)
            except LinkLost:
                raise
            except Exception as error:  # a fault of this program must not end in the air
                trip = Trip(Rung.LAND, ExitCode.ENDED_BY_SAFETY, f"fault in the pilot: {error!r}")
                if not self._airborne:
                    raise
                exit_code, reason = self._leave_plan(trip)
        except LinkLost:
            exit_code, reason = ExitCode.LINK_LOST, f"the link was lost: {self._link.lost or 'the log fell silent'}"
            self._say(Level.ERROR, reason)
        finally:
            self._finish()
        return self._outcome(exit_code, reason)

    # On the ground.

    def _prepare(self) -> None:
        mission = self._mission
        self._enter(Phase.CONNECT)
        self._restart_pace()
        self._link = self._connect(self._look_at_orders)
        self._connected = True
        self._enter(Phase.RELEASE)
        self._link.release_priority()
        self._enter(Phase.CONFIGURE)
        self._restart_pace()
        wanted = mission.parameters
        for name, value in mission.parameters_if_known.items():
            if self._link.has_parameter(name):
                wanted[name] = value
            else:
                self._say(Level.WARNING, f"the vehicle has no {name}: expect it some centimetres off at speed")
        read_back = {name: self._link.set_parameter(name, value) for name, value in wanted.items()}
        self._link.start_logs()
        self._until(lambda: self._link.estimate is not None and self._link.status is not None, 3.0)
        if self._link.estimate is None or self._link.status is None:
            raise InputError("the vehicle sends no log", where=self._link.uri, hint="restart the vehicle")
        self._quieten()
        self._feed()
        self._converge()
        self._preflight(wanted, read_back)
        self._enter(Phase.ARM)
        self._restart_pace()
        self._floor = self._pose().position[2]
        self._link.arm(True)
        if not self._until(lambda: self._bits(ARMED | CAN_FLY) == ARMED | CAN_FLY, 3.0):
            raise PreflightError("the vehicle does not arm", hint="restart the vehicle")

    def _feed(self) -> None:
        self._enter(Phase.FEED)
        self._source.open()
        self._feeding = True
        self._restart_pace()
        if not self._until(lambda: len(self._recent) >= 20, 5.0):
            raise InputError(
                f"no good pose comes: {self._pose_fault}" if self._pose_fault else "no pose comes",
                where="motion capture",
                hint="is the body tracked, and is its name right?",
            )

    def _converge(self) -> None:
        """Set the vehicle's filter to where motion capture sees it, and wait until both agree."""
        self._enter(Phase.CONVERGE)
        pose = self._pose()
        for name, value in zip(("X", "Y", "Z"), pose.position, strict=True):
            self._link.set_parameter(f"kalman.initial{name}", value)
        self._link.set_parameter("kalman.initialYaw", yaw_of(pose.quaternion))
        self._link.set_parameter("kalman.resetEstimation", 1)
        self._pause(0.1)
        self._link.set_parameter("kalman.resetEstimation", 0)
        self._restart_pace()
        agreed_since = math.inf

        def agreed() -> bool:
            nonlocal agreed_since
            variance, estimate = self._link.position_variance, self._link.estimate
            good = (
                variance is not None
                and estimate is not None
                and max(variance) < CONVERGED_WITHIN**2
                and math.dist(estimate.position, self._pose().position) < CONVERGED_WITHIN
            )
            now = self._now()
            agreed_since = min(agreed_since, now) if good else math.inf
            return now - agreed_since >= CONVERGED_FOR

        if not self._until(agreed, 10.0):
            self._say(Level.WARNING, "the vehicle's estimate does not settle")

    def _preflight(self, wanted: dict[str, float], read_back: dict[str, float]) -> None:
        """The table. An auto-arming vehicle is not ready for moments, so a table that fails gets two more tries."""
        self._enter(Phase.PREFLIGHT)
        for _ in range(_TRIES):
            could_fly = False

            def look() -> bool:
                nonlocal could_fly
                could_fly = could_fly or bool(self._bits(CAN_FLY))
                return False

            self._until(look, 1.0)
            estimate, status, variance = self._link.estimate, self._link.status, self._link.position_variance
            assert estimate is not None  # the log has come since configuring
            assert status is not None
            pose = self._pose()
            self._checks = run_checks(
                Ground(
                    mission=self._mission,
                    protocol=self._link.protocol,
                    firmware=self._link.firmware,
                    round_trip=self._link.round_trip,
                    could_fly=could_fly,
                    status=status,
                    wanted=wanted,
                    read_back=read_back,
                    poses=tuple(self._recent),
                    pose_age=self._now() - pose.time,
                    estimate=estimate,
                    variance=variance if variance is not None else (math.inf,),
                    waking=Lateness.of(tuple(self._waking), 0),
                )
            )
            if all(check.passed for check in self._checks):
                break
        for check in self._checks:
            text = f"{check.name}: {check.value} ({check.threshold})"
            self._say(Level.INFO if check.passed else Level.ERROR, text)
        failed = [check for check in self._checks if not check.passed]
        if failed:
            raise PreflightError(
                "; ".join(f"{check.name}: {check.value}, must be {check.threshold}" for check in failed),
                where="preflight",
                hint=failed[0].hint,
            )
        self._link.stop_variance_log()

    # In the air.

    def _perform(self) -> None:
        self._take_off()
        self._go_to_start()
        self._fly_plan()
        self._hand_back()
        self._land()

    def _take_off(self) -> None:
        self._enter(Phase.TAKE_OFF)
        height = self._mission.take_off_height
        duration = manoeuvre_time(height - self._floor, self._limits.ground.take_off_speed)
        code = self._ask(lambda: self._link.take_off(height, duration), TAKE_OFF)
        if code:
            raise PreflightError(
                f"the vehicle refuses to take off (code {code})", hint="restart the vehicle, and look at its battery"
            )
        self._airborne = True
        self._pause(duration)
        self._until(lambda: abs(self._pose().position[2] - height) < _AT_START_WITHIN, 2.0)
        if self._pose().position[2] - self._floor < (height - self._floor) / 2:
            raise Tripped(Trip(Rung.LAND, ExitCode.ENDED_BY_SAFETY, "the vehicle does not rise"))

    def _go_to_start(self) -> None:
        self._enter(Phase.GO_TO_START)
        start, yaw = self._mission.start
        duration = manoeuvre_time(math.dist(self._pose().position, start), self._limits.ground.go_to_speed)
        self._must(self._ask(lambda: self._link.go_to(start, yaw, duration), GO_TO), "to go to the start")
        self._pause(duration)
        near_since = math.inf

        def settled() -> bool:
            nonlocal near_since
            now = self._now()
            near = math.dist(self._pose().position, start) < _AT_START_WITHIN
            near_since = min(near_since, now) if near else math.inf
            return now - near_since > 0.5

        if not self._until(settled, 5.0):
            away = math.dist(self._pose().position, start)
            raise Tripped(Trip(Rung.LAND, ExitCode.ENDED_BY_SAFETY, f"still {away:.2f} m from the start"))

    def _fly_plan(self) -> None:
        self._enter(Phase.STREAM)
        # The first setpoint is due with the next tick.
        self._plan.start = self._pace.upcoming
        skipped = self._pace.skipped
        self._stream = self._plan
        self._until(lambda: self._now() > self._plan.end, math.inf)
        self._skipped = self._pace.skipped - skipped
        self._enter(Phase.HOLD)
        self._pause(self._mission.hold_time)

    def _hand_back(self) -> None:
        self._enter(Phase.HAND_BACK)
        (end, yaw) = self._mission.end
        self._hand_over(lambda: self._link.go_to(end, yaw, 1.0), GO_TO, "to hover")
        self._pause(1.0)

    def _hand_over(self, command: Callable[[], None], number: int, what: str) -> None:
        """From the stream to the on-board commander: first a command, then the priority, so that motors never stop."""
        for _ in range(_TRIES):
            stream, self._stream = self._stream, None
            code = self._ask(command, number, tries=1)
            if code == 0:
                break
            self._stream = stream  # hold on while asking again
            self._pause(0.05)
        else:
            self._stream = None
            raise Tripped(Trip(Rung.CUT, ExitCode.ENDED_BY_SAFETY, f"the vehicle refuses {what}"))
        for _ in range(_TRIES):
            self._link.release_priority()
            if self._until(lambda: bool(self._bits(HIGH_LEVEL_ACTIVE)), _REPLY):
                return

    def _land(self) -> None:
        """Down, where it is, and wait until the vehicle says that it no longer flies."""
        self._enter(Phase.LAND)
        for _ in range(_TRIES):
            height = max(self._pose().position[2] - self._floor, 0.0)
            duration = manoeuvre_time(height, self._limits.ground.land_speed)
            floor = self._floor

            def land(duration: float = duration, floor: float = floor) -> None:
                self._link.land(floor, duration)

            if self._stream is not None:
                self._hand_over(land, LAND, "to land")
            else:
                self._ask(land, LAND)
            self._pause(duration)
            if self._until(lambda: not self._bits(FLYING), 4.0):
                self._airborne = False
                return
            if self._pose().position[2] - self._floor < _ON_THE_FLOOR:
                self._say(Level.WARNING, "on the floor with turning motors: stopping them")
                self._link.stop_motors()
                if self._until(lambda: not self._bits(FLYING), 4.0):
                    self._airborne = False
                    return
        raise Tripped(Trip(Rung.CUT, ExitCode.ENDED_BY_SAFETY, "the vehicle does not land"))

    # The abort ladder.

    def _leave_plan(self, trip: Trip) -> tuple[ExitCode, str]:
        first, texts = trip, [trip.text]
        while True:
            self._rung = self._reached = max(self._rung, trip.rung)
            self._say(Level.ERROR if trip.rung is Rung.CUT else Level.WARNING, f"{trip.rung.name.lower()}: {trip.text}")
            try:
                if self._airborne:
                    {Rung.BRAKE: self._brake, Rung.LAND: self._stop_and_land, Rung.CUT: self._cut}[trip.rung]()
                return first.exit_code, ", then ".join(texts)
            except Tripped as graver:
                trip = graver.trip
            except LinkLost:
                raise
            except Exception as error:  # only cutting is left when landing breaks
                if trip.rung is Rung.CUT:
                    raise
                trip = Trip(Rung.CUT, ExitCode.ENDED_BY_SAFETY, f"fault in the pilot: {error!r}")
            texts.append(trip.text)

    def _brake(self) -> None:
        self._stop()
        self._enter(Phase.HOLD)
        self._pause(_BRAKE_HOLD)
        self._land()

    def _stop_and_land(self) -> None:
        self._stop()
        self._land()

    def _stop(self) -> None:
        """Along the path to a hover, where the plan is being streamed; else the vehicle hovers or moves slowly."""
        if self._stream is not self._plan:
            if self._stream is not None:
                self._until(lambda: self._stream is None or self._now() > self._stream.end, math.inf)
            return
        index = self._plan.index(self._now())
        start = self._plan.start + index / self._mission.rate
        self._stream = Stream(self._mission.stops[index], self._mission.rate, start)
        self._stopped_at = start
        end = self._stream.end
        self._until(lambda: self._now() > end, math.inf)

    def _cut(self) -> None:
        self._stream = None
        for _ in range(_TRIES):
            self._link.emergency_stop()
            self._pause(0.02)
        self._airborne = False

    # The tick.

    def _tick(self) -> float:
        """One deadline: the setpoint, then the pose, then the look-out. The time after it, s."""
        due = self._pace.wait()
        now = self._now()
        stream = self._stream
        if stream is not None:
            index = stream.index(now)
            self._link.send(stream.packets[index])
            self._report(stream.sent(index, now, due))
            if stream is self._plan:
                self._late.append(now - due)
        self._waking.append(now - due)
        if self._feeding:
            self._forward_poses()
        self._keep_watch(now, now - due)
        return now

    def _forward_poses(self) -> None:
        newest = None
        for pose in self._source.poses():
            self._report(PoseReceived(pose.time, pose.received, pose.position, pose.quaternion))
            fault = self._freshness.fault(pose)
            if fault != self._pose_fault:
                self._pose_fault = fault
                self._say(Level.WARNING, f"pose: {fault}" if fault else "pose: good again")
            if not fault:
                newest = pose
                self._recent.append(pose)
                self._forecast.add(pose)
                self._note_deviation(pose)
        now = self._now()
        if newest is not None and now - newest.time < self._limits.pose.age_brake:
            self._link.send_pose(self._forecast.position(now), newest.quaternion)
        while len(self._recent) > 1 and self._recent[0].time < self._recent[-1].time - 1.0:
            self._recent.popleft()

    def _note_deviation(self, pose: Pose) -> None:
        if self._stream is not self._plan or pose.time < self._plan.start:
            return
        elapsed = pose.time - self._plan.start
        distance = math.dist(pose.position, self._plan.position(pose.time - self._mission.lead))
        self._off_plan.append((elapsed, distance))

    def _keep_watch(self, now: float, late: float) -> None:
        link = self._link
        if link.lost or (self._airborne and link.estimate is not None and now - link.estimate.time > LINK_GONE):
            raise LinkLost
        pose, stream = self._freshness.last, self._stream
        seen = Seen(
            now=now,
            order=self._orders.worst,
            main_gone=self._orders.gone,
            pose=pose,
            wanted=stream.position(pose.time - self._mission.lead) if stream is not None and pose is not None else None,
            estimate=link.estimate,
            status=link.status,
            late=late if stream is not None else 0.0,
        )
        trip = self._watch.gravest(seen) if self._airborne else self._watch.ordered(seen)
        if trip is not None and trip.rung > self._rung:
            raise Tripped(trip)

    def _look_at_orders(self) -> None:
        """What a tick does before there is a link."""
        trip = self._watch.ordered(Seen(self._now(), self._orders.worst, self._orders.gone))
        if trip is not None:
            raise Tripped(trip)

    def _restart_pace(self) -> None:
        """Deadlines from now on; those that something slow on the ground has missed do not count."""
        self._pace = Pace(self._mission.rate, self._now, self._sleep)

    def _until(self, done: Callable[[], bool], patience: float) -> bool:
        """Tick until it is done; whether it was, in time."""
        end = self._now() + patience
        while self._tick() < end:
            if done():
                return True
        return done()

    def _pause(self, duration: float) -> None:
        self._until(lambda: False, duration)

    def _ask(self, command: Callable[[], None], number: int, tries: int = _TRIES) -> int | None:
        """Command the on-board commander; its answer, or None where there is none."""
        for _ in range(tries):
            command()
            if self._until(lambda: number in self._link.replies, _REPLY):
                return self._link.replies[number]
        return None

    def _must(self, code: int | None, what: str) -> None:
        if code != 0:
            answer = "does not answer" if code is None else f"refuses (code {code})"
            raise Tripped(Trip(Rung.LAND, ExitCode.ENDED_BY_SAFETY, f"the vehicle {answer} when asked {what}"))

    def _pose(self) -> Pose:
        pose = self._freshness.last
        assert pose is not None  # nothing asks before the feed has begun
        return pose

    def _bits(self, mask: int) -> int:
        status = self._link.status
        return status.supervisor & mask if status is not None else 0

    def _enter(self, phase: Phase) -> None:
        now = self._now()
        self._phases.append((phase, now))
        self._report(PhaseEntered(now, phase))

    def _say(self, level: Level, text: str) -> None:
        self._report(Event(self._now(), level, text))

    # The end.

    def _finish(self) -> None:
        """Disarm and close, on the ground; in the air only a lost link brings the pilot here, and it closes nothing."""
        if self._connected and not self._airborne:
            self._enter(Phase.DISARM)
            self._rung = Rung.CUT  # nothing ends what is over
            self._stream = None
            try:
                self._link.arm(False)
                self._until(lambda: not self._bits(ARMED), 0.5)
            except (LinkLost, Tripped):
                self._say(Level.WARNING, "the link went before the vehicle was disarmed")
            self._link.close()
        if self._feeding:
            self._source.close()
        self._enter(Phase.CLOSED)

    def _outcome(self, exit_code: ExitCode, reason: str) -> FlightOutcome:
        start, ends = self._plan.start, self._mission.motion_ends + self._mission.lead
        moved = min((self._stopped_at or self._now()) - start, ends) if start else 0.0
        last = self._freshness.last
        nowhere: Triple = (math.nan, math.nan, math.nan)
        return FlightOutcome(
            exit_code=exit_code,
            reason=reason,
            rung=self._reached,
            checks=self._checks,
            phases=tuple(self._phases),
            first_setpoint=start,
            flown=moved,
            lateness=Lateness.of(self._late, self._skipped),
            deviation=Deviation.of([sample for sample in self._off_plan if sample[0] <= ends]),
            settled_after=settle_time([(t - ends, off) for t, off in self._off_plan if t > ends], SETTLED_WITHIN),
            end_position=last.position if last is not None else nowhere,
        )
