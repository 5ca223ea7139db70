"""Required parameters of the vehicle and signs of another commander, each with its reason.

Preflight runs from these tables, and its page in the docs is rendered from them: a new row is enough for a parameter to
be set or read back, refused and documented.
"""

import math
from collections.abc import Callable
from dataclasses import astuple, dataclass
from enum import StrEnum

from cfplan.flight.firmware import FLIES_AS_PREDICTED, GAIN_PARAMETERS, gains_for
from cfplan.flight.radio.supervisor_bits import HIGH_LEVEL_ACTIVE, HIGH_LEVEL_DISABLED
from cfplan.flight.setpoints.rate_trade import GAIN_TOLERANCE
from cfplan.safety.limits import Limits
from cfplan.vehicle.airframe import GRAVITY

# Standard deviations of poses in the vehicle's filter.
EXTERNAL_POSITION_STD = 2e-3  # m
"""Well above 1 mm, the lower bound of the filter's own standard deviations (MIN_COVARIANCE of kalman_core.c).

At 1 mm, as Crazyswarm2 sets it, that bound distorts the gains when poses arrive at varying times between predictions:
at 2 m/s the estimated velocity is 0.1 m/s too low, and the vehicle deviates by 6 cm.
"""
EXTERNAL_ATTITUDE_STD = 5e-2  # rad, as in Crazyswarm2; with a smaller value the filter has trouble with yaw
GAIN_TOLERANCE_OF_FIRMWARE = 0.05
"""Relative tolerance of a gain; at a motor lag of 0.13 s it adds up to 0.3 cm of deviation."""
TRADED_GAIN_TOLERANCE = GAIN_TOLERANCE / (2.0 + GAIN_TOLERANCE)
"""The same for kR_xy and kw_xy, so that their ratio keeps its tolerance, which adds up to 1 cm."""
MIN_ARMED_TIME = 5000  # ms, enough for arming with repeats and for take-off
_FULL_COMMAND = 65535  # of one motor
_FLOAT32_TOLERANCE = 1e-6  # relative, of a value that is read back: parameters are float32

Interval = tuple[float, float]


class Action(StrEnum):
    """How cfplan handles a parameter."""

    SET = "set"  # written before each flight and read back; a restart restores the old value
    REFUSED = "refused"  # only read: other values refuse the flight


@dataclass(frozen=True, slots=True)
class ParameterRule:
    """One parameter of the vehicle that must have a certain value."""

    name: str
    allowed: Callable[[Limits], tuple[Interval, ...]]  # allowed intervals; the first begins with the value to set
    allowed_text: str  # the allowed values in words
    action: Action
    reason: str  # one sentence
    hint: str  # what to do
    since: tuple[int, ...] = ()  # first firmware with it; (): all that may fly
    optional: bool = False  # a vehicle without it may fly
    missing: str = ""  # warning for a vehicle without it

    def value(self, limits: Limits) -> float:
        """Return the value that cfplan writes; for a parameter that is only read, one that it accepts."""
        return self.allowed(limits)[0][0]

    def accepts(self, value: float | None, limits: Limits) -> bool:
        """Return whether a flight may start with this value; None if the vehicle lacks the parameter."""
        if value is None:
            return self.optional
        return any(
            (low <= value <= high)
            or math.isclose(value, low, rel_tol=_FLOAT32_TOLERANCE)
            or math.isclose(value, high, rel_tol=_FLOAT32_TOLERANCE)
            for low, high in self.allowed(limits)
        )

    def threshold(self, limits: Limits) -> str:
        """Return the allowed values, in figures and in words."""
        intervals = self.allowed(limits)
        figures = " or ".join(
            _figures(each) for each in intervals if not any(_within(each, wide) for wide in intervals)
        )
        words = self.allowed_text.replace("`", "")
        return f"{figures} ({words})" if any(map(str.isalpha, words)) else figures


def _within(interval: Interval, wide: Interval) -> bool:
    return interval != wide and wide[0] <= interval[0] and interval[1] <= wide[1]


def _figures(interval: Interval) -> str:
    low, high = interval
    if low == high:
        return f"{low:g}"
    return f"≥ {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"


def _exactly(value: Callable[[Limits], float]) -> Callable[[Limits], tuple[Interval, ...]]:
    return lambda limits: ((value(limits), value(limits)),)


def _always(*intervals: Interval) -> Callable[[Limits], tuple[Interval, ...]]:
    return lambda _: intervals


def _gain(place: int, share: float) -> Callable[[Limits], tuple[Interval, ...]]:
    """Return the interval of the gain at a place of `GAIN_PARAMETERS`; the firmware's own value comes first."""

    def allowed(limits: Limits) -> tuple[Interval, ...]:
        own = astuple(gains_for(limits.airframe))[place]
        return (own, own), (own * (1.0 - share), own * (1.0 + share))

    return allowed


def _drag(limits: Limits) -> float:
    """Return rotor drag over mass, 1/s."""
    return limits.airframe.drag[0] / limits.airframe.mass


def _idle(limits: Limits) -> tuple[Interval, ...]:
    airframe = limits.airframe
    return ((0.0, airframe.motor_thrust_min / airframe.motor_thrust_max * _FULL_COMMAND),)


def _crash(limits: Limits) -> tuple[Interval, ...]:
    return (0.0, 0.0), (limits.flight.acceleration.cut / GRAVITY, math.inf)


def _farthest(limits: Limits) -> tuple[Interval, ...]:
    corners = max(map(abs, (*limits.space.low, *limits.space.high)))
    return ((corners + limits.flight.fence.cut, math.inf),)


_GAIN_REASONS = {
    "ctrlMel.kR_xy": "Packets trade body rate for attitude by 2 kR_xy / kw_xy, in flight and for the loss of the link.",
    "ctrlMel.kw_xy": "Packets trade body rate for attitude by 2 kR_xy / kw_xy, in flight and for the loss of the link.",
    "ctrlMel.kd_omega_rp": "Each step of the body rates that are sent becomes a kick of the motors by this gain.",
}
_RESTART = "restart the vehicle; a value that comes back is stored in it and must be cleared there"


def _gain_rule(place: int, name: str) -> ParameterRule:
    share = TRADED_GAIN_TOLERANCE if name in ("ctrlMel.kR_xy", "ctrlMel.kw_xy") else GAIN_TOLERANCE_OF_FIRMWARE
    return ParameterRule(
        name, _gain(place, share), f"the firmware's own, within {100 * share:.2g} %", Action.REFUSED,
        _GAIN_REASONS.get(name, "The dry run and the fate after link loss are certified with this gain."),
        _RESTART,
    )  # fmt: skip


PARAMETER_RULES: tuple[ParameterRule, ...] = (
    ParameterRule(
        "stabilizer.estimator", _exactly(lambda limits: limits.firmware.estimator),
        "`firmware.estimator` of safety.yaml", Action.SET,
        "Only the Kalman filter takes poses in.", "restart the vehicle",
    ),
    ParameterRule(
        "stabilizer.controller", _exactly(lambda limits: limits.firmware.controller),
        "`firmware.controller` of safety.yaml", Action.SET,
        "Only the Mellinger controller uses the whole of a full-state setpoint.", "restart the vehicle",
    ),
    ParameterRule(
        "ctrlMel.mass", _exactly(lambda limits: limits.airframe.mass), "the airframe's mass", Action.SET,
        "The controller makes thrust of mass: 5 % too little costs 3 to 6 cm.", "restart the vehicle",
    ),
    ParameterRule(
        "ctrlMel.massThrust", _exactly(lambda limits: limits.airframe.command_per_thrust),
        "65535 over the thrust of all motors at full command", Action.SET,
        "It turns N into motor commands, and depends on the motors and their `thrust_scale`.", "restart the vehicle",
    ),
    ParameterRule(
        "locSrv.extPosStdDev", _exactly(lambda _: EXTERNAL_POSITION_STD), "2 mm", Action.SET,
        "Motion capture is better than the filter's own guess of 1 cm; 1 mm makes it believe up to 7 % less speed.",
        "restart the vehicle",
    ),
    ParameterRule(
        "locSrv.extQuatStdDev", _exactly(lambda _: EXTERNAL_ATTITUDE_STD), "0.05 rad", Action.SET,
        "A filter that trusts the measured attitude more has trouble with yaw.", "restart the vehicle",
    ),
    *(
        ParameterRule(
            f"kalman.dragB_{axis}", _exactly(_drag), "the airframe's rotor drag over its mass", Action.SET,
            "A filter that does not know of drag takes the tilt that holds against it for acceleration: at 2 m/s its "
            "attitude is 4° off.",
            "restart the vehicle", since=FLIES_AS_PREDICTED, optional=True,
            missing="its filter takes drag for tilt, so it deviates as the row of its firmware says",
        )
        for axis in "xy"
    ),
    ParameterRule(
        "commander.enHighLevel", _always((1, 1)), "1", Action.SET,
        "After a flight the on-board commander's null setpoints keep the supervisor from locking; since firmware "
        "2022.01 the parameter has no effect.",
        "restart the vehicle", optional=True,
    ),
    ParameterRule(
        "supervisor.tmblChckEn", _always((1, 1)), "1", Action.SET,
        "Without the tumble check, the motors of a vehicle that lies on its back run on.",
        "restart the vehicle", since=(2024, 10), optional=True,
    ),
    ParameterRule(
        "colAv.enable", _always((0, 0)), "0", Action.REFUSED,
        "On-board collision avoidance rewrites position and velocity of each setpoint, to 0.5 m/s by default, but not "
        "its acceleration and body rates.",
        "set colAv.enable to 0 if no other vehicle flies: cfplan does not switch off what protects others",
        optional=True,
    ),
    ParameterRule(
        "motorPowerSet.enable", _always((0, 0)), "0", Action.REFUSED,
        "The motors turn as motorPowerSet.m1 to m4 say, whatever the controller wants.",
        "end the motor test, or restart the vehicle", optional=True,
    ),
    ParameterRule(
        "powerDist.idleThrust", _idle, "at most the airframe's least motor thrust, in 16-bit units", Action.REFUSED,
        "No motor gives less than idle thrust once it is armed, and plans use the airframe's least thrust.",
        "set powerDist.idleThrust lower, or raise the airframe's motor_thrust_min", optional=True,
    ),
    ParameterRule(
        "stabilizer.stop", _always((0, 0)), "0", Action.REFUSED,
        "An emergency stop is in force, and locks the vehicle.", "restart the vehicle", optional=True,
    ),
    ParameterRule(
        "system.selftestPassed", _always((1, 1)), "1", Action.REFUSED,
        "The vehicle's own test of its sensors and decks failed when it started.",
        "restart the vehicle on a level floor and look at its console", optional=True,
    ),
    ParameterRule(
        "supervisor.prefltTimeout", _always((MIN_ARMED_TIME, math.inf)), f"at least {MIN_ARMED_TIME} ms",
        Action.REFUSED,
        "An armed vehicle that does not take off in this time disarms itself.",
        _RESTART, since=(2025, 2), optional=True,
    ),
    ParameterRule(
        "supervisor.crashDetectGs", _crash, "0, or at least `flight.acceleration` to cut in safety.yaml, in g",
        Action.REFUSED,
        "The vehicle cuts its motors where it measures so many g beyond one, before the abort ladder can act.",
        _RESTART, since=(2026, 8), optional=True,
    ),
    ParameterRule(
        "kalman.maxPos", _farthest, "at least the farthest corner of the space and the fence's cut", Action.REFUSED,
        "Where the estimate is farther from the origin, the filter starts anew in the air.", _RESTART, optional=True,
    ),
    ParameterRule(
        "kalman.maxVel", lambda limits: ((limits.flight.speed.cut, math.inf),),
        "at least `flight.speed` to cut in safety.yaml", Action.REFUSED,
        "Where the estimate is faster, the filter starts anew in the air.", _RESTART, optional=True,
    ),
    *(
        _gain_rule(place, name)
        for place, name in enumerate(GAIN_PARAMETERS)
        if name not in ("ctrlMel.mass", "ctrlMel.massThrust")
    ),
)  # fmt: skip

# Groups that preflight shows in one line each.
PARAMETER_GROUPS: dict[str, tuple[ParameterRule, ...]] = {
    "parameters read back": tuple(rule for rule in PARAMETER_RULES if rule.action is Action.SET),
    "settings on board": tuple(
        rule for rule in PARAMETER_RULES if rule.action is Action.REFUSED and not rule.name.startswith("ctrlMel.")
    ),
    "controller gains": tuple(
        rule for rule in PARAMETER_RULES if rule.action is Action.REFUSED and rule.name.startswith("ctrlMel.")
    ),
}


@dataclass(frozen=True, slots=True)
class Traffic:
    """Signs of other commanders heard in a second before take-off."""

    supervisor: int  # bits of supervisor.info that were set at any moment
    replies: tuple[int, ...]  # commands of the on-board commander that were answered, though cfplan sent none
    setpoint: bool  # the controller had a setpoint, though cfplan sent none


@dataclass(frozen=True, slots=True)
class CommanderSign:
    """A sign that another client commands the vehicle."""

    name: str
    seen: Callable[[Traffic], bool]
    reason: str  # one sentence
    since: tuple[int, ...] = ()


COMMANDER_SIGNS: tuple[CommanderSign, ...] = (
    CommanderSign(
        "the on-board commander flies a trajectory", lambda traffic: bool(traffic.supervisor & HIGH_LEVEL_ACTIVE),
        "Bit 8 of supervisor.info is set before cfplan has asked for anything, so an app or another client has.",
    ),
    CommanderSign(
        "the on-board commander is disabled", lambda traffic: bool(traffic.supervisor & HIGH_LEVEL_DISABLED),
        "Bit 10 of supervisor.info is set by an app that commands the vehicle instead, or after a command that was not "
        "a number. The commander's null setpoints then no longer keep the supervisor from locking.",
        since=(2025, 9),
    ),
    CommanderSign(
        "the on-board commander answers others", lambda traffic: bool(traffic.replies),
        "A vehicle sends its answers to whoever polls it next, so those to another client's commands arrive here.",
    ),
    CommanderSign(
        "the controller has a setpoint", lambda traffic: traffic.setpoint,
        "The setpoint in force, in the log group ctrltarget, is not empty although cfplan sends none: another client, "
        "an app or a remote control does, at the priority of cfplan's own or a higher one.",
    ),
)  # fmt: skip

# What cannot be read over the radio, each with the reason.
UNKNOWABLE: tuple[tuple[str, str], ...] = (
    ("who sends setpoints", "The firmware logs the setpoint in force, not where it came from."),
    (
        "setpoints for a vehicle that is not armed",
        "It drops them; so the setpoint in force is looked at once more after arming, before take-off.",
    ),
    (
        "another client's joystick at rest, before firmware 2026.08",
        "Zero thrust with zero tilt shows only in the setpoint's modes, which are logged from 2026.08 on.",
    ),
    (
        "an app that waits",
        "An app in the firmware has no sign before it commands something; it may take over at any priority.",
    ),
    (
        "a parameter that is changed after preflight",
        "Nobody is told of another client's writing; what cfplan rests on is read once, on the ground. Only "
        "motorPowerSet.enable is read ten times a second, to the end of the flight.",
    ),
    (
        "a running test of propellers or battery",
        "health.startPropTest and health.startBatTest read 0 as soon as the test has begun; the controller rests then.",
    ),
    ("a second source of poses", "The filter takes poses from everyone; the agreement of estimate and pose tells."),
)
