"""Manoeuvres: the phases in the air, and what streamed and on-board flight have in common."""

import math
from collections.abc import Callable
from dataclasses import asdict
from typing import Protocol

from cfplan.errors import PreflightError
from cfplan.flight.pilot.abort_reasons import AbortReason
from cfplan.flight.pilot.flight_loop import AbortRaised, FlightLoop
from cfplan.flight.pilot.health import FRESH, Health
from cfplan.flight.pilot.hover_check import check_hover
from cfplan.flight.pilot.mission import manoeuvre_time
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.pilot.stream import Stream
from cfplan.flight.radio.supervisor_bits import ARMED, CAN_FLY, FAULTS, FLYING
from cfplan.flight.telemetry import Phase, Triple
from cfplan.vehicle.rotations import yaw_of

Place = tuple[float, float, float, float]  # m, m, m, and yaw, rad
_AT_PLACE_WITHIN = 0.06  # m
_AT_START_FOR = 0.5  # s
READY_TIMEOUT = 1.0  # s; a vehicle that arms itself is briefly not ready now and then
# m above the floor: once the setpoint is at the first height, the pose must be at the second
_SETPOINT_RISE, _POSE_RISE = 0.12, 0.015


class Manoeuvres(Protocol):
    """The phases of a flight in the air. Each may raise AbortRaised and LinkLost."""

    def take_off(self) -> None:
        """Climb to a hover. Raises PreflightError if the vehicle stays on the floor."""

    def go_to_start(self) -> None:
        """Fly to where the plan begins."""

    def fly_plan(self) -> None:
        """Fly the plan to its end, and hover."""

    def land(self) -> None:
        """Land after the plan, and stop the motors."""

    def land_by_setpoints(self) -> None:
        """Land by setpoints from wherever the vehicle is: the last resort before its motors are cut."""

    def brake(self) -> None:
        """Leave the plan: brake to a hover, hold it, and land."""

    def stop_and_land(self) -> None:
        """Leave the plan: brake, and land at once."""


def _require_ready(loop: FlightLoop) -> None:
    """Wait until all sources are fresh and the supervisor reports that the vehicle can fly; else it ignores setpoints.

    Raises PreflightError if the vehicle cannot fly, or poses or one of its logs have gone since preflight.
    """

    def can_fly() -> bool:
        return loop.status is not None and loop.bits(ARMED | CAN_FLY) == ARMED | CAN_FLY

    if loop.until(lambda: can_fly() and loop.health == Health(), READY_TIMEOUT):
        return
    if can_fly():
        silent = [f"{name} {fresh}" for name, fresh in asdict(loop.health).items() if fresh is not FRESH]
        raise PreflightError(
            f"the vehicle may not take off: {', '.join(silent)}",
            where="vehicle",
            hint="look at motion capture and the radio, and start again",
        )
    if loop.status is None:
        raise PreflightError("the vehicle does not report its status", where="vehicle", hint="restart it and try again")
    faults = " and ".join(fault for bit, fault in FAULTS.items() if loop.bits(bit))
    armed = "is armed and not ready to fly" if loop.bits(ARMED) else "is no longer armed"
    raise PreflightError(
        f"the vehicle may not take off: it {faults or armed}",
        where="vehicle",
        hint="restart it on a level floor; its console says more",
    )


def begin_take_off(
    loop: FlightLoop, floor: float, way_between: Callable[[Place, Place, float], Stream]
) -> tuple[Stream, float]:
    """Begin to fly; return setpoints straight up from the `floor`, m, to a hover, and their duration, s.

    `way_between` makes setpoints between two places. Raises PreflightError if the vehicle cannot fly.
    """
    loop.await_clearance(Phase.TAKE_OFF)
    loop.history.enter(Phase.TAKE_OFF)
    height, (x, y, _) = loop.mission.take_off_height, loop.pose().position
    yaw = yaw_of(loop.pose().quaternion)
    duration = manoeuvre_time(height - floor, loop.limits.ground.take_off_speed)
    way = way_between((x, y, floor, yaw), (x, y, height, yaw), duration)
    if way.stop_from is not None:
        way.stop_from(0)  # the first call is slow, so make it on the ground
    _require_ready(loop)
    loop.lift_off()
    return way, duration


def climb(loop: FlightLoop, way: Stream, floor: float, height: float, stop: Callable[[], object]) -> None:
    """Wait until the vehicle has climbed along `way` from the `floor` to a `height`, m; `stop` stops its motors.

    Raises PreflightError if it stays on the floor, and AbortRaised if it hardly rises or if its hover shows a thrust
    other than was certified.
    """

    def stays() -> bool:
        return _pose_stays(loop, way, floor)

    if loop.until(lambda: loop.now() > way.end or stays(), math.inf) and stays():
        _stay_down(loop, stop)
    loop.until(lambda: abs(loop.pose().position[2] - height) < _AT_PLACE_WITHIN, 2.0)
    if loop.pose().position[2] - floor < (height - floor) / 2:
        raise AbortRaised(AbortReason.DOES_NOT_RISE.abort(Rung.LAND))
    check_hover(loop)


def _pose_stays(loop: FlightLoop, way: Stream, floor: float) -> bool:
    """Return whether the tracked body stays on the floor while the vehicle must rise.

    On the ground the vehicle cannot be distinguished from another body that stands still. With the pose of that body
    the vehicle's controller would climb at full thrust.
    """
    pose = loop.pose()
    asked = way.position(pose.time - loop.mission.lead)[2]
    return asked - floor > _SETPOINT_RISE and pose.position[2] - floor < _POSE_RISE


def _stay_down(loop: FlightLoop, stop: Callable[[], object]) -> None:
    """Stop the motors, at most a quarter of a metre above the floor, and raise PreflightError."""
    turning = bool(loop.bits(FLYING))
    stop()
    loop.touch_down()
    if not turning:
        raise PreflightError(
            "the vehicle does not start its motors",
            where="vehicle",
            hint="restart it; its console may say why its supervisor ignores setpoints",
        )
    raise PreflightError(
        "the tracked body stays on the floor while the vehicle takes off",
        where="motion capture",
        hint="is it a different body, or are two bodies swapped? Otherwise check battery and propellers",
    )


def settle_at(loop: FlightLoop, start: Triple) -> None:
    """Wait until the vehicle rests at the start, m. Raises AbortRaised if it does not arrive."""
    near_since = math.inf

    def settled() -> bool:
        nonlocal near_since
        now = loop.now()
        near = math.dist(loop.pose().position, start) < _AT_PLACE_WITHIN
        near_since = min(near_since, now) if near else math.inf
        return now - near_since > _AT_START_FOR

    if not loop.until(settled, 5.0):
        away = math.dist(loop.pose().position, start)
        raise AbortRaised(AbortReason.NOT_AT_START.abort(Rung.LAND, metres=away))
