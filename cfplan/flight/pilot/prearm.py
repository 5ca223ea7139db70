"""From nothing to an armed vehicle: the phases that a flight goes through on the ground."""

import math
from collections.abc import Callable

from cfplan.errors import InputError, PreflightError
from cfplan.flight.pilot.deadlines import Lateness
from cfplan.flight.pilot.flight_loop import TRIES, Cockpit
from cfplan.flight.pilot.mission import yaw_of
from cfplan.flight.pilot.preflight import Ground, run_checks
from cfplan.flight.radio.link import Link
from cfplan.flight.radio.supervisor_bits import ARMED, CAN_BE_ARMED, CAN_FLY
from cfplan.flight.real_time import uses_fifo_scheduling
from cfplan.flight.telemetry import Level, Phase

CONVERGED_WITHIN = 0.03  # m, estimate from pose
CONVERGED_FOR = 1.0  # s


def prepare(
    cockpit: Cockpit, connect: Callable[[Callable[[], None]], Link], enter_real_time: Callable[[], None] = lambda: None
) -> None:
    """All phases on the ground, to an armed vehicle. `enter_real_time` is called before anything is measured.

    Raises a CfplanError where the vehicle or its poses cannot be had, or a check fails, and what a tick raises.
    """
    mission = cockpit.mission
    cockpit.enter(Phase.CONNECT)
    cockpit.restart_pace()
    cockpit.link = connect(cockpit.look_at_orders)
    cockpit.connected = True
    cockpit.enter(Phase.RELEASE)
    cockpit.link.release_priority()
    cockpit.enter(Phase.CONFIGURE)
    cockpit.restart_pace()
    wanted = mission.parameters
    for name, value in mission.parameters_if_known.items():
        if cockpit.link.has_parameter(name):
            wanted[name] = value
        else:
            cockpit.say(Level.WARNING, f"the vehicle has no {name}: expect it some centimetres off at speed")
    read_back = {name: cockpit.link.set_parameter(name, value) for name, value in wanted.items()}
    cockpit.link.start_logs()
    cockpit.until(lambda: cockpit.link.estimate is not None and cockpit.link.status is not None, 3.0)
    if cockpit.link.estimate is None or cockpit.link.status is None:
        raise InputError("the vehicle sends no log", where=cockpit.link.uri, hint="restart the vehicle")
    enter_real_time()
    _feed(cockpit)
    _converge(cockpit)
    _preflight(cockpit, wanted, read_back)
    cockpit.enter(Phase.ARM)
    cockpit.restart_pace()
    cockpit.floor = cockpit.pose().position[2]
    for _ in range(TRIES):  # a busy radio may give one up
        cockpit.link.arm(True)
        if cockpit.until(lambda: cockpit.bits(ARMED | CAN_FLY) == ARMED | CAN_FLY, 1.0):
            break
    else:
        raise PreflightError("the vehicle does not arm", hint="restart the vehicle")


def _feed(cockpit: Cockpit) -> None:
    cockpit.enter(Phase.FEED)
    cockpit.source.open()
    cockpit.feeding = True
    cockpit.restart_pace()
    if not cockpit.until(lambda: len(cockpit.recent) >= 20, 5.0):
        raise InputError(
            f"no good pose comes: {cockpit.pose_fault}" if cockpit.pose_fault else "no pose comes",
            where="motion capture",
            hint="is the body tracked, and is its name right?",
        )


def _converge(cockpit: Cockpit) -> None:
    """Set the vehicle's filter to where motion capture sees it, and wait until both agree."""
    cockpit.enter(Phase.CONVERGE)
    pose = cockpit.pose()
    for name, value in zip(("X", "Y", "Z"), pose.position, strict=True):
        cockpit.link.set_parameter(f"kalman.initial{name}", value)
    cockpit.link.set_parameter("kalman.initialYaw", yaw_of(pose.quaternion))
    cockpit.link.set_parameter("kalman.resetEstimation", 1)
    cockpit.pause(0.1)
    cockpit.link.set_parameter("kalman.resetEstimation", 0)
    cockpit.restart_pace()
    agreed_since = math.inf

    def agreed() -> bool:
        nonlocal agreed_since
        variance, estimate = cockpit.link.position_variance, cockpit.link.estimate
        good = (
            variance is not None
            and estimate is not None
            and max(variance) < CONVERGED_WITHIN**2
            and math.dist(estimate.position, cockpit.pose().position) < CONVERGED_WITHIN
        )
        now = cockpit.now()
        agreed_since = min(agreed_since, now) if good else math.inf
        return now - agreed_since >= CONVERGED_FOR

    if not cockpit.until(agreed, 10.0):
        cockpit.say(Level.WARNING, "the vehicle's estimate does not settle")


def _preflight(cockpit: Cockpit, wanted: dict[str, float], read_back: dict[str, float]) -> None:
    """The table. An auto-arming vehicle is not ready for moments, so a table that fails gets two more tries."""
    cockpit.enter(Phase.PREFLIGHT)
    for _ in range(TRIES):
        cockpit.checks = run_checks(_look_around(cockpit, wanted, read_back))
        if all(check.passed for check in cockpit.checks):
            break
    for check in cockpit.checks:
        text = f"{check.name}: {check.value} ({check.threshold})"
        cockpit.say(Level.INFO if check.passed else Level.ERROR, text)
    failed = [check for check in cockpit.checks if not check.passed]
    if failed:
        raise PreflightError(
            "; ".join(f"{check.name}: {check.value}, must be {check.threshold}" for check in failed),
            where="preflight",
            hint=failed[0].hint,
        )
    cockpit.link.stop_variance_log()


def _look_around(cockpit: Cockpit, wanted: dict[str, float], read_back: dict[str, float]) -> Ground:
    """What a second of looking shows."""
    could_fly = False

    def look() -> bool:
        nonlocal could_fly
        could_fly = could_fly or bool(cockpit.bits(CAN_FLY | CAN_BE_ARMED))
        return False

    cockpit.until(look, 1.0)
    link = cockpit.link
    assert link.estimate is not None  # the log has come since configuring
    assert link.status is not None
    return Ground(
        mission=cockpit.mission,
        protocol=link.protocol,
        firmware=link.firmware,
        round_trip=link.round_trip,
        could_fly=could_fly,
        status=link.status,
        wanted=wanted,
        read_back=read_back,
        poses=tuple(cockpit.recent),
        pose_age=cockpit.now() - cockpit.pose().time,
        estimate=link.estimate,
        variance=link.position_variance or (math.inf,),
        waking=Lateness.of(tuple(cockpit.waking), 0),
        uses_fifo_scheduling=uses_fifo_scheduling(),
    )
