"""The phases before take-off: connect, configure, converge, check and arm."""

import math
from collections.abc import Callable

from cfplan.errors import InputError, PreflightError
from cfplan.flight.pilot.deadlines import Lateness
from cfplan.flight.pilot.flight_loop import ATTEMPTS, FlightLoop
from cfplan.flight.pilot.on_board_manoeuvres import upload_program
from cfplan.flight.pilot.outcome import Check
from cfplan.flight.pilot.preflight import PreflightSnapshot, check_traffic, run_checks, standing_check
from cfplan.flight.pilot.vehicle_rules import PARAMETER_RULES, Action, Traffic
from cfplan.flight.radio.link import Link
from cfplan.flight.radio.supervisor_bits import ARMED, CAN_BE_ARMED, CAN_FLY
from cfplan.flight.real_time import uses_fifo_scheduling
from cfplan.flight.setpoints.commitment import warm_up
from cfplan.flight.telemetry import Level, Phase, Triple
from cfplan.vehicle.rotations import yaw_of

CONVERGED_WITHIN = 0.03  # m, estimate from pose
CONVERGED_FOR = 1.0  # s
_OBSERVATION_TIME = 1.0  # s
LISTEN_WHILE_ARMED = 0.2  # s, several messages of each log
_ALL = 0xFFFF  # bits of supervisor.info


def prepare(
    loop: FlightLoop, connect: Callable[[Callable[[], None]], Link], enter_real_time: Callable[[], None] = lambda: None
) -> float:
    """Run all phases on the ground, until the vehicle is armed; return the height, m, of its pose on the floor.

    `enter_real_time` is called before anything is measured.

    Raises a CfplanError if the vehicle or its poses are not available, or a check fails, and what a tick raises.
    """
    warm_up(loop.commitment, loop.mission.limits)
    loop.history.enter(Phase.CONNECT)
    loop.connect(connect)
    loop.history.enter(Phase.RELEASE)
    loop.link.release_priority()
    loop.history.enter(Phase.CONFIGURE)
    loop.restart_deadlines()
    read = _configure(loop)
    if loop.mission.on_board is not None:
        upload_program(loop, loop.mission.on_board)
    loop.link.start_logs()
    loop.until(lambda: loop.link.estimate is not None and loop.link.status is not None, 3.0)
    if loop.link.estimate is None or loop.link.status is None:
        raise InputError("the vehicle sends no log", where=loop.link.uri, hint="restart the vehicle")
    enter_real_time()
    _feed(loop)
    stood = _converge(loop)
    _preflight(loop, read, stood)
    loop.watch_motor_test()
    loop.await_clearance(Phase.ARM)
    loop.history.enter(Phase.ARM)
    loop.restart_deadlines()
    floor = loop.pose().position[2]
    for _ in range(ATTEMPTS):  # a busy radio may drop one
        loop.link.arm(True)
        if loop.until(lambda: loop.bits(ARMED | CAN_FLY) == ARMED | CAN_FLY, 1.0):
            _listen_while_armed(loop)
            _require(standing_check(stood, loop.pose().position, loop.mission.limits), "motion capture")
            return floor
    raise PreflightError("the vehicle does not arm", hint="restart the vehicle")


def _configure(loop: FlightLoop) -> dict[str, float]:
    """Set the parameters of the table, and return all of them as read back."""
    link, limits = loop.link, loop.mission.limits
    for rule in PARAMETER_RULES:
        if link.has_parameter(rule.name):
            if rule.action is Action.SET:
                link.set_parameter(rule.name, rule.value(limits))
        elif rule.missing:
            loop.history.add_event(Level.WARNING, f"the vehicle has no {rule.name}: {rule.missing}")
    return link.read_parameters([rule.name for rule in PARAMETER_RULES])


def _feed(loop: FlightLoop) -> None:
    loop.history.enter(Phase.FEED)
    loop.open_poses()
    if not loop.until(lambda: len(loop.tracker.recent) >= 20, 5.0):
        raise InputError(
            f"no good pose comes: {loop.pose_fault}" if loop.pose_fault else "no pose comes",
            where="motion capture",
            hint="is the body tracked, and is its name right?",
        )


def _converge(loop: FlightLoop) -> Triple:
    """Set the vehicle's filter to the pose of motion capture, and wait until both agree. Return its position, m."""
    loop.history.enter(Phase.CONVERGE)
    pose = loop.pose()
    for name, value in zip(("X", "Y", "Z"), pose.position, strict=True):
        loop.link.set_parameter(f"kalman.initial{name}", value)
    loop.link.set_parameter("kalman.initialYaw", yaw_of(pose.quaternion))
    loop.link.set_parameter("kalman.resetEstimation", 1)
    loop.pause(0.1)
    loop.link.set_parameter("kalman.resetEstimation", 0)
    loop.restart_deadlines()
    agreed_since = math.inf

    def agreed() -> bool:
        nonlocal agreed_since
        variance, estimate = loop.link.position_variance, loop.link.estimate
        good = (
            variance is not None
            and estimate is not None
            and max(variance) < CONVERGED_WITHIN**2
            and math.dist(estimate.position, loop.pose().position) < CONVERGED_WITHIN
        )
        now = loop.now()
        agreed_since = min(agreed_since, now) if good else math.inf
        return now - agreed_since >= CONVERGED_FOR

    if not loop.until(agreed, 10.0):
        loop.history.add_event(Level.WARNING, "the vehicle's estimate does not settle")
    return pose.position


def _preflight(loop: FlightLoop, read: dict[str, float], stood: Triple) -> None:
    """Run the preflight checks, up to three times: an auto-arming vehicle is briefly not ready."""
    loop.history.enter(Phase.PREFLIGHT)
    for _ in range(ATTEMPTS):
        loop.history.checks = run_checks(_observe(loop, read, stood))
        if all(check.passed for check in loop.history.checks):
            break
    for check in loop.history.checks:
        text = f"{check.name}: {check.value} ({check.threshold})"
        loop.history.add_event(Level.INFO if check.passed else Level.ERROR, text)
    failed = [check for check in loop.history.checks if not check.passed]
    if failed:
        raise PreflightError(
            "; ".join(f"{check.name}: {check.value}, must be {check.threshold}" for check in failed),
            where="preflight",
            hint=failed[0].hint,
        )


def _observe(loop: FlightLoop, read: dict[str, float], stood: Triple) -> PreflightSnapshot:
    """Observe the vehicle for a second and return the snapshot for preflight."""
    traffic = _listen(loop, _OBSERVATION_TIME)
    link = loop.link
    assert link.estimate is not None  # received since configuring
    assert link.status is not None
    return PreflightSnapshot(
        mission=loop.mission,
        protocol=link.protocol,
        firmware=link.firmware,
        round_trip=link.round_trip,
        could_fly=bool(traffic.supervisor & (CAN_FLY | CAN_BE_ARMED)),
        traffic=traffic,
        status=link.status,
        parameters=read,
        poses=tuple(loop.tracker.recent),
        pose_age=loop.now() - loop.pose().time,
        stood=stood,
        estimate=link.estimate,
        variance=link.position_variance or (math.inf,),
        health=loop.health,
        waking=Lateness.of(tuple(loop.waking), 0),
        uses_fifo_scheduling=uses_fifo_scheduling(),
    )


def _listen(loop: FlightLoop, duration: float) -> Traffic:
    """Return the signs of other commanders within `duration`, s."""
    bits, setpoint = 0, False
    loop.link.replies.clear()  # a late answer to an earlier connection

    def look() -> bool:
        nonlocal bits, setpoint
        bits, setpoint = bits | loop.bits(_ALL), setpoint or loop.link.has_setpoint
        return False

    loop.until(look, duration)
    return Traffic(bits, tuple(loop.link.replies), setpoint)


def _listen_while_armed(loop: FlightLoop) -> None:
    """Listen again, as a vehicle that is not armed drops setpoints and shows none. Raises PreflightError."""
    heard = check_traffic(_listen(loop, LISTEN_WHILE_ARMED))
    loop.link.stop_preflight_logs()
    _require(heard, "vehicle")


def _require(check: Check, where: str) -> None:
    """Raise PreflightError unless a check passed."""
    if not check.passed:
        raise PreflightError(f"{check.name}: {check.value}, must be {check.threshold}", where=where, hint=check.hint)
