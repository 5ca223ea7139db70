"""Preflight: the table of checks before arming, each a small function with a value, a threshold and a verdict."""

import math
import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.firmware import NEWEST_KNOWN, Timeouts, earlier_deviation, timeouts_of, version_of, version_text
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.on_board.fall import falls_from
from cfplan.flight.on_board.go_to import go_to_states
from cfplan.flight.pilot.deadlines import Lateness
from cfplan.flight.pilot.health import GONE, LOG_GONE, Health
from cfplan.flight.pilot.mission import Mission, manoeuvre_time
from cfplan.flight.pilot.outcome import Check
from cfplan.flight.pilot.vehicle_rules import COMMANDER_SIGNS, PARAMETER_GROUPS, ParameterRule, Traffic
from cfplan.flight.radio.supervisor_bits import FAULTS, FLYING
from cfplan.flight.setpoints.commitment import QUANTUM
from cfplan.flight.setpoints.packets import positions_of
from cfplan.flight.telemetry import Estimate, Triple, VehicleStatus
from cfplan.numbers import coordinates, shown
from cfplan.safety.limits import Limits
from cfplan.safety.space import SIDES, inside
from cfplan.vehicle.rotations import tilt_of, yaw_of

OLDEST_PROTOCOL = 8  # the first with the go-to command that cfplan sends
LARGEST_VARIANCE = 1e-3  # m², a standard deviation of 3 cm
LARGEST_ROUND_TRIP = 0.05  # s
_COMMITS_SINCE = re.compile(r"\d ?[+-][1-9]")  # a build after a release, as "2026.08 +37"
_WAY_STEP = 0.01  # m between the checked places on the way to the start
LARGEST_HEIGHT = 0.3  # m, of the tracked body above the floor: the vehicle may stand on a box
LARGEST_TILT = math.radians(5.0)  # of the tracked body on the floor: floors are flatter


@dataclass(frozen=True, slots=True)
class PreflightSnapshot:
    """The state of the vehicle before it is armed."""

    mission: Mission
    protocol: int
    firmware: str  # as reported; empty if it is not
    round_trip: float  # s
    could_fly: bool
    """The supervisor reported at least once in the last second that it can fly or, as brushless vehicles do, that it
    waits to be armed."""
    status: VehicleStatus
    traffic: Traffic
    parameters: Mapping[str, float]  # those of the table that the vehicle has, as read back
    poses: Sequence[Pose]  # of about the last second, oldest first
    pose_age: float  # s, of the newest
    stood: Triple  # m, pose of the vehicle when its filter was set
    estimate: Estimate
    variance: Sequence[float]  # m², of position along x, y, z
    health: Health
    waking: Lateness  # how late this computer met its deadlines in the last second
    uses_fifo_scheduling: bool = False
    """Whether the stream runs ahead of ordinary programs, which the system must permit."""


def run_checks(snapshot: PreflightSnapshot) -> tuple[Check, ...]:
    """All checks, in the order of the table; parameters have one line per group, and one for each that is wrong."""
    more = ON_BOARD_CHECKS if snapshot.mission.on_board is not None else ()
    return (*(check(snapshot) for check in (*CHECKS, *more)), *check_parameters(snapshot))


def check_protocol(snapshot: PreflightSnapshot) -> Check:
    return Check(
        "radio protocol", str(snapshot.protocol), f"≥ {OLDEST_PROTOCOL}", snapshot.protocol >= OLDEST_PROTOCOL,
        "update the vehicle's firmware",
    )  # fmt: skip


def check_firmware(snapshot: PreflightSnapshot) -> Check:
    return firmware_check(snapshot.firmware, snapshot.mission.limits)


def firmware_check(firmware: str, limits: Limits) -> Check:
    """Compare the version with the oldest and the newest that may fly; how a newer one behaves is unknown."""
    oldest, newest, found = limits.firmware.oldest, limits.firmware.newest, version_of(firmware)
    named = found
    if found == newest and _COMMITS_SINCE.search(firmware):
        year, month, patch = (*found, 0)[:3]
        named = year, month, patch + 1  # the next release, as safety.yaml names only those
    if named > newest:
        return Check(
            "firmware", firmware, "≤ " + version_text(newest), False,
            "time-outs and controller were read from older firmware: fly with that; or compare them, and write "
            f'newest: "{version_text(named)}" under firmware: in safety.yaml',
        )  # fmt: skip
    value, hint, deviation = firmware or "unknown", "update the vehicle's firmware", earlier_deviation(found)
    if deviation:
        value += f", which deviates by {deviation}"
        hint += f'; or accept that deviation by oldest: "{version_text(found)}" under firmware: in safety.yaml'
    elif found:
        hint += ": older filters go wrong with yaw beyond 90°"
    return Check("firmware", value, "≥ " + version_text(oldest), bool(found) and found >= oldest, hint)


def check_round_trip(snapshot: PreflightSnapshot) -> Check:
    return Check(
        "link round trip", f"{snapshot.round_trip * 1e3:.1f} ms", f"≤ {LARGEST_ROUND_TRIP * 1e3:.0f} ms",
        0.0 < snapshot.round_trip <= LARGEST_ROUND_TRIP, "move closer, or choose a freer channel",
    )  # fmt: skip


def check_logs(snapshot: PreflightSnapshot) -> Check:
    silent = [name for name in ("estimate", "status") if getattr(snapshot.health, name) is GONE]
    return Check(
        "vehicle's logs", f"{' and '.join(silent)} silent" if silent else "estimate and status come",
        f"heard within {LOG_GONE:g} s", not silent,
        "end every other client of this vehicle, as a client that connects deletes all logs; then restart it",
    )  # fmt: skip


def check_supervisor(snapshot: PreflightSnapshot) -> Check:
    faults = [text for bit, text in FAULTS.items() if snapshot.status.supervisor & bit]
    if snapshot.status.supervisor & FLYING:
        faults.append("flying already")
    if not faults and not snapshot.could_fly:
        faults.append("cannot fly")
    return Check(
        "supervisor", ", ".join(faults) or "can fly", "can fly", not faults,
        "set the vehicle upright and restart it; after a fault of a deck, take the deck off",
    )  # fmt: skip


def check_battery(snapshot: PreflightSnapshot) -> Check:
    least = snapshot.mission.limits.battery.at_rest
    voltage = snapshot.status.battery_voltage
    return Check("battery at rest", f"{voltage:.2f} V", f"≥ {least:.2f} V", voltage >= least, "charge the battery")


def check_endurance(snapshot: PreflightSnapshot) -> Check:
    longest = snapshot.mission.limits.battery.endurance
    flight = snapshot.mission.duration + snapshot.mission.hold_time
    return Check("flight time", f"{flight:.1f} s", f"≤ {longest:.0f} s", flight <= longest, "plan a shorter path")


def check_timeouts(snapshot: PreflightSnapshot) -> Check:
    return timeouts_check(snapshot.firmware)


def timeouts_check(firmware: str) -> Check:
    """Compare the supervisor's time-outs, known by firmware version, with those assumed for link loss."""
    version, assumed = version_of(firmware), Timeouts()
    try:
        found = timeouts_of(version)
    except ValueError:
        found = None
    text = f"level after {found.level_out:g} s, off after {found.motors_off:g} s" if found else "unknown"
    if version > NEWEST_KNOWN:
        text += f" as in {version_text(NEWEST_KNOWN)}, the newest that cfplan knows"
    return Check(
        "supervisor's time-outs", text, f"level after {assumed.level_out:g} s, off after {assumed.motors_off:g} s",
        found == assumed, "fly with a firmware from 2023.06 on",
    )  # fmt: skip


def check_parameters(snapshot: PreflightSnapshot) -> tuple[Check, ...]:
    """Return one line per group of parameters that are in order, and one for each parameter that is wrong."""
    found: list[Check] = []
    for group, rules in PARAMETER_GROUPS.items():
        checks = [check_rule(rule, snapshot.parameters.get(rule.name), snapshot.mission.limits) for rule in rules]
        wrong = [check for check in checks if not check.passed]
        found += wrong or [Check(group, f"{len(rules)} in order", "as docs/preflight.md lists them", True)]
    return tuple(found)


def check_rule(rule: ParameterRule, value: float | None, limits: Limits) -> Check:
    """Check one parameter; None if the vehicle lacks it."""
    passed = rule.accepts(value, limits)
    return Check(
        rule.name, "missing" if value is None else f"{value:g}", rule.threshold(limits), passed,
        "" if passed else f"{rule.hint}. {rule.reason}",
    )  # fmt: skip


def check_commanders(snapshot: PreflightSnapshot) -> Check:
    return check_traffic(snapshot.traffic)


def check_traffic(traffic: Traffic) -> Check:
    seen = [sign for sign in COMMANDER_SIGNS if sign.seen(traffic)]
    return Check(
        "other commanders", "; ".join(sign.name for sign in seen) or "none heard", "none", not seen,
        f"end every other client, app and remote control of this vehicle. {seen[0].reason}" if seen else "",
    )  # fmt: skip


def check_pose_rate(snapshot: PreflightSnapshot) -> Check:
    least = snapshot.mission.limits.pose.rate_min
    first, last = snapshot.poses[0].time, snapshot.poses[-1].time
    rate = (len(snapshot.poses) - 1) / (last - first) if last > first else 0.0
    return Check(
        "pose rate", f"{rate:.0f} Hz", f"≥ {least:.0f} Hz", rate >= least, "are all markers seen, is the body tracked?"
    )


def check_pose_age(snapshot: PreflightSnapshot) -> Check:
    most = snapshot.mission.limits.pose.age_warning
    return Check(
        "pose age", f"{snapshot.pose_age * 1e3:.0f} ms", f"≤ {most * 1e3:.0f} ms", snapshot.pose_age <= most,
        "look at the network between motion capture and this computer",
    )  # fmt: skip


def check_agreement(snapshot: PreflightSnapshot) -> Check:
    most = snapshot.mission.limits.pose.agreement
    distance = math.dist(snapshot.estimate.position, snapshot.poses[-1].position)
    return Check(
        "estimate against pose", f"{distance * 1e3:.0f} mm", f"≤ {most * 1e3:.0f} mm", distance <= most,
        "is the tracked body this vehicle, and are poses in metres with z up?",
    )  # fmt: skip


def check_standing(snapshot: PreflightSnapshot) -> Check:
    return standing_check(snapshot.stood, snapshot.poses[-1].position, snapshot.mission.limits)


def standing_check(stood: Triple, seen: Triple, limits: Limits) -> Check:
    """Check that the standing body has not moved since its filter was set; nobody carries it now.

    After a gap, motion capture may have confused it with another body, or shifted its frame.
    """
    most, moved = limits.pose.agreement, math.dist(stood, seen)
    return Check(
        "drift of the standing body", f"{moved * 1e3:.0f} mm", f"≤ {most * 1e3:.0f} mm", moved <= most,
        "if nobody moved the vehicle, motion capture has confused it with another body or shifted its frame: check "
        "both, then start again",
    )  # fmt: skip


def check_yaw_agreement(snapshot: PreflightSnapshot) -> Check:
    most = snapshot.mission.limits.pose.yaw_agreement
    apart = yaw_of(snapshot.estimate.quaternion) - yaw_of(snapshot.poses[-1].quaternion)
    apart = abs(math.remainder(apart, math.tau))
    return Check(
        "yaw against pose", f"{math.degrees(apart):.1f}°", f"≤ {math.degrees(most):.1f}°", apart <= most,
        "define the tracked body with the vehicle's front along x",
    )  # fmt: skip


def check_tilt(snapshot: PreflightSnapshot) -> Check:
    tilt = statistics.median(float(tilt_of(pose.quaternion)) for pose in snapshot.poses)
    return Check(
        "tilt of the body", f"{math.degrees(tilt):.1f}°", f"≤ {math.degrees(LARGEST_TILT):.0f}°", tilt <= LARGEST_TILT,
        "define the tracked body while the vehicle stands level, with its own axes",
    )  # fmt: skip


def check_height(snapshot: PreflightSnapshot) -> Check:
    """Check the height of the body: its tilt is zero in any frame, so only the height shows whether z is up."""
    height = snapshot.poses[-1].position[2] - snapshot.mission.limits.space.low[2]
    return Check(
        "height of the body", f"{shown(height, '.2f')} m above the floor", f"within {LARGEST_HEIGHT:.1f} m",
        abs(height) <= LARGEST_HEIGHT,
        "is z up in motion capture, not y, and is z = 0 its floor? Lift the vehicle by hand: only z must change",
    )  # fmt: skip


def check_variance(snapshot: PreflightSnapshot) -> Check:
    worst = max(snapshot.variance)
    return Check(
        "estimator deviation", f"{math.sqrt(max(worst, 0.0)) * 1e3:.0f} mm",
        f"≤ {math.sqrt(LARGEST_VARIANCE) * 1e3:.0f} mm", worst <= LARGEST_VARIANCE, "let the vehicle stand still",
    )  # fmt: skip


def check_start_place(snapshot: PreflightSnapshot) -> Check:
    """Check that the column above the vehicle, up to the take-off height, is inside the space."""
    space, (x, y, _) = snapshot.mission.limits.space, snapshot.poses[-1].position
    above = np.array([(x, y, snapshot.mission.take_off_height)])
    (top,), _ = space.nearest(above)
    (column,), (face,) = space.above_floor(above)
    worst = max(float(top), float(column))
    beside = f", beside {space.faces[face]}" if column >= top and face >= SIDES else ""
    return Check(
        "take-off position", f"{coordinates((x, y), '.2f')} m, {shown(-worst, '.2f')} m inside{beside}",
        "inside the space less its margin", bool(inside(worst)), "move the vehicle towards the middle of the room",
    )  # fmt: skip


def check_way_to_start(snapshot: PreflightSnapshot) -> Check:
    """Check that no obstacle is on or below the way from take-off to the start, where link loss would end."""
    mission, limits = snapshot.mission, snapshot.mission.limits
    space, (x, y, _), (start, _) = limits.space, snapshot.poses[-1].position, mission.start
    name, threshold = "way to the start", "clear of obstacles by the margin, and so what is beneath"
    if not space.obstacles:  # without obstacles, a straight way is inside if both ends are
        return Check(name, "no obstacles", threshold, True)
    begin, end = np.array([x, y, mission.take_off_height]), np.array(start)
    way = np.linspace(begin, end, int(np.linalg.norm(end - begin) / _WAY_STEP) + 2)
    beyond, face = space.nearest(way) if limits.link_loss.only_warn else space.above_floor(way)
    at = int(np.argmax(beyond))
    return Check(
        name,
        f"{shown(-float(beyond[at]), '.2f')} m inside at {coordinates(way[at], '.2f')} m, by {space.faces[face[at]]}",
        threshold, bool(inside(beyond[at], QUANTUM)), "place the vehicle where nothing stands between it and the start",
    )  # fmt: skip


def check_plan_inside(snapshot: PreflightSnapshot) -> Check:
    """Check each setpoint and each stop; all are on the path or within rounding of it."""
    space = snapshot.mission.limits.space
    planned, stops = (positions_of(each).reshape(-1, 3) for each in (snapshot.mission.payloads, snapshot.mission.stops))
    worst = max(space.farthest(planned), space.farthest(stops))
    return Check(
        "plan and stops in the space", f"{shown(-worst, '.3f')} m inside", "inside the space less its margin",
        bool(inside(worst, QUANTUM)), "plan again with this safety.yaml",
    )  # fmt: skip


def check_waking(snapshot: PreflightSnapshot) -> Check:
    most = snapshot.mission.limits.lateness
    how = "by SCHED_FIFO" if snapshot.uses_fifo_scheduling else "without SCHED_FIFO"
    return Check(
        "this computer's lateness", f"p99 {snapshot.waking.p99 * 1e3:.1f} ms {how}", f"≤ {most * 1e3:.0f} ms",
        snapshot.waking.p99 <= most,
        "close what else runs on this computer"
        + ("" if snapshot.uses_fifo_scheduling else "; see `cfplan doctor` on priority"),
    )  # fmt: skip


CHECKS: tuple[Callable[[PreflightSnapshot], Check], ...] = (
    check_protocol,
    check_firmware,
    check_timeouts,
    check_round_trip,
    check_logs,
    check_supervisor,
    check_commanders,
    check_battery,
    check_endurance,
    check_pose_rate,
    check_pose_age,
    check_agreement,
    check_standing,
    check_yaw_agreement,
    check_tilt,
    check_height,
    check_variance,
    check_start_place,
    check_way_to_start,
    check_plan_inside,
    check_waking,
)


def check_memory(snapshot: PreflightSnapshot) -> Check:
    """Report the trajectory memory, which was read back and compared when it was written."""
    program = snapshot.mission.on_board
    assert program is not None
    kind = "compressed pieces" if program.compressed else "pieces"
    return Check("trajectory memory", f"{program.pieces} {kind}, {len(program.memory)} bytes", "as uploaded", True)


def check_watchdog(snapshot: PreflightSnapshot) -> Check:
    """Check the watchdog: the on-board commander has no time-out, so a vehicle without a link would fly on, blind."""
    on, seconds = snapshot.mission.limits.firmware.watchdog, Timeouts().keep_alive
    return Check(
        "link loss on board", f"motors stop {seconds:g} s later" if on else "it flies on, blind",
        "motors stop", on, "set firmware.watchdog to true in safety.yaml",
    )  # fmt: skip


def check_fall(snapshot: PreflightSnapshot) -> Check:
    """Check the fall after link loss in take-off and on the way to the start; the trajectory was checked before."""
    mission, limits = snapshot.mission, snapshot.mission.limits
    assert mission.on_board is not None
    (x, y, z), height = snapshot.poses[-1].position, mission.take_off_height
    ways = [_hover_to_hover((x, y, z), (x, y, height), limits.ground.take_off_speed)]
    ways.append(_hover_to_hover((x, y, height), mission.on_board.begin[:3], limits.ground.go_to_speed))
    falls = falls_from(np.concatenate(ways), limits, mission.on_board.deviation)
    beyond = float(falls.beyond[falls.worst])
    where = limits.space.describe(beyond, int(falls.face[falls.worst]))
    found = f"trajectory {mission.on_board.falls}; before it {where}"
    return Check(
        "fall after link loss", found, "inside the walls", bool(inside(beyond)) or limits.link_loss.only_warn,
        "move the vehicle towards the middle of the room, or lower `ground.go_to_speed`",
    )  # fmt: skip


def _hover_to_hover(begin: Triple, end: Triple, speed: float) -> NDArray:
    """Return states, (N, 5, 4), of the commander's way between two places, m, at a mean speed, m/s."""
    hover = np.zeros((1, 3, 4))
    hover[0, 0, :3] = begin
    return go_to_states(hover, np.array([[*end, 0.0]]), manoeuvre_time(math.dist(begin, end), speed), 100)[0]


ON_BOARD_CHECKS: tuple[Callable[[PreflightSnapshot], Check], ...] = (check_memory, check_watchdog, check_fall)
