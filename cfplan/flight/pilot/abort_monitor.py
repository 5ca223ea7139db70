"""The abort monitor: every trigger of the abort ladder in one place, checked a hundred times a second in the air."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from cfplan.errors import ExitCode
from cfplan.flight.firmware import Timeouts
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.pilot.abort_reasons import Abort, AbortReason
from cfplan.flight.pilot.health import FRESH, GONE, LOG_GONE, UPLINK_GONE, Health
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.radio.supervisor_bits import FAULTS
from cfplan.flight.telemetry import Estimate, Triple, VehicleStatus
from cfplan.safety.limits import Ladder, Limits
from cfplan.safety.quantities import ON_LADDER
from cfplan.safety.space import inside

LATEST_SETPOINT = 0.25  # s, latest setpoint; the vehicle stops following after 0.5 s
DISAGREEMENT_FACTOR = 5.0  # times preflight's limit on the distance between estimate and pose, in the air
_HEARD_SINCE = 0.1  # s; packets may have arrived this much later than the last ping that was answered
_QUEUE = 0.4  # s, for which logs of an outage may come before the answer to a ping; a restarted vehicle sends no logs
FALLEN = 0.15  # m; a vehicle on the floor that is farther below its setpoint has fallen


@dataclass(slots=True)
class Observation:
    """The pilot's observations at one moment, in s on the flight's clock, m, and radians."""

    now: float  # s
    pose: Pose | None = None  # the last good one
    pose_fault: str = ""  # why there has been none since
    health: Health = field(default_factory=Health)
    setpoint_at_pose: Triple | None = None
    """m, setpoint at the time of the pose; None if there was none."""
    estimate: Estimate | None = None  # None while its log is gone
    setpoint_at_estimate: Triple | None = None
    """m, setpoint at the time of the estimate; None if there was none."""
    status: VehicleStatus | None = None  # None while its log is gone
    late: float = 0.0  # s, lateness of the last setpoint
    uplink_silent: float = 0.0  # s, for which nothing has been acknowledged
    logs_silent: float = math.inf  # s, for which no log message has arrived, however old


# When each quantity that has a ladder was measured, s, and its value; None while the log that reports it is gone.
MEASURED: Mapping[str, Callable[[Observation], tuple[float, Triple] | None]] = MappingProxyType(
    {
        "speed": lambda seen: (seen.estimate.time, seen.estimate.velocity) if seen.estimate is not None else None,
        "acceleration": lambda seen: (
            (seen.estimate.time, seen.estimate.acceleration) if seen.estimate is not None else None
        ),
        "angular_velocity": lambda seen: (seen.status.time, seen.status.body_rate) if seen.status is not None else None,
    }
)
_RUNGS = (Rung.BRAKE, Rung.LAND, Rung.CUT)


class AbortMonitor:
    """Finds the gravest reason to leave the plan; keeps a short history of battery and motion."""

    def __init__(self, limits: Limits):
        self._limits = limits
        self._alone_after = Timeouts().motors_off_at_latest(limits.firmware.watchdog) + _HEARD_SINCE
        self._voltage: float | None = None
        self._voltage_time = 0.0
        self._since: dict[tuple[str, Rung], float] = {}
        """s, since when a quantity has been above the threshold of a rung, by the times of its messages."""

    def gravest(self, observation: Observation) -> Abort | None:
        """Return the gravest abort, None if there is no reason for one."""
        aborts = [abort for abort in self._aborts(observation) if abort.rung]
        return max(aborts, key=lambda abort: abort.rung, default=None)

    def _aborts(self, observation: Observation) -> Iterator[Abort]:
        yield self._silence(observation)
        yield from self._vehicle(observation)
        yield from self._motion(observation)
        yield from self._fallen(observation)
        if observation.late > LATEST_SETPOINT:
            yield AbortReason.LATE_SETPOINT.abort(Rung.BRAKE, seconds=observation.late)

    def _silence(self, observation: Observation) -> Abort:
        """Return the abort that the present health calls for; its text names the most important silent source."""
        health, pose = observation.health, observation.pose
        rung, age_brake = health.reaction.rung, self._limits.pose.age_brake
        queue = _QUEUE if observation.logs_silent < _HEARD_SINCE else 0.0
        if observation.uplink_silent > self._alone_after + queue:
            # It has stopped its motors, and may have restarted since: it must not be flown from where it lies.
            reason = f"nothing was acknowledged for {observation.uplink_silent:.1f} s"
            return AbortReason.LINK_LOST.abort(Rung.CUT, reason=reason)
        if health.uplink is GONE:
            return AbortReason.UPLINK_GONE.abort(rung, seconds=UPLINK_GONE)
        if health.poses is not FRESH and pose is None:
            return AbortReason.NO_POSE.abort(rung)
        if health.poses is not FRESH and pose is not None:
            age, why = observation.now - pose.time, observation.pose_fault
            if age <= age_brake:
                return AbortReason.POSE_NOT_SENT.abort(rung, reason=why or f"they come {age:.2f} s late")
            return AbortReason.POSE_OLD.abort(rung, seconds=age, reason=f" ({why})" if why else "")
        silent = " and ".join(name for name in ("estimate", "status") if getattr(health, name) is GONE)
        return AbortReason.LOG_GONE.abort(rung, log=silent, seconds=LOG_GONE)

    def _vehicle(self, observation: Observation) -> Iterator[Abort]:
        if observation.status is None:
            return
        for bit, fault in FAULTS.items():
            if observation.status.supervisor & bit:
                yield AbortReason.SUPERVISOR_FAULT.abort(Rung.CUT, fault=fault)
        voltage = self._loaded_voltage(observation.status)
        if voltage < self._limits.battery.under_load:
            yield AbortReason.BATTERY_LOW.abort(Rung.LAND, volts=voltage)

    def _loaded_voltage(self, status: VehicleStatus) -> float:
        """Return the voltage, V, averaged with a time constant of under_load_seconds."""
        if self._voltage is None:
            self._voltage = status.battery_voltage
        elapsed = max(status.time - self._voltage_time, 0.0) if self._voltage_time else 0.0
        self._voltage_time = status.time
        share = 1.0 - math.exp(-elapsed / self._limits.battery.under_load_seconds)
        self._voltage += share * (status.battery_voltage - self._voltage)
        return self._voltage

    def _motion(self, observation: Observation) -> Iterator[Abort]:
        limits = self._limits.flight
        if observation.pose is not None:
            beyond = self._beyond_fence(observation.pose.position)
            yield _ladder_abort(limits.fence, 0.0 if inside(beyond) else beyond, AbortReason.BEYOND_FENCE)
            if observation.setpoint_at_pose is not None:
                deviation = math.dist(observation.pose.position, observation.setpoint_at_pose)
                yield _ladder_abort(limits.deviation, deviation, AbortReason.DEVIATION)
        estimate = observation.estimate
        if (
            observation.pose is not None
            and estimate is not None
            and observation.health.estimate is FRESH
            and observation.now - observation.pose.time <= self._limits.pose.age_warning
        ):
            apart = math.dist(observation.pose.position, estimate.position)
            if apart > DISAGREEMENT_FACTOR * self._limits.pose.agreement:
                yield AbortReason.ESTIMATE_DISAGREES.abort(Rung.BRAKE, metres=apart)
        for quantity in ON_LADDER:
            time, exceeded = observation.now, _NO_ABORT
            if (measured := MEASURED[quantity.ladder](observation)) is not None:
                time, value = measured
                exceeded = _ladder_abort(
                    getattr(limits, quantity.ladder), math.hypot(*value), AbortReason.MOTION_LIMIT,
                    quantity=quantity.name, unit=quantity.unit,
                )  # fmt: skip
            yield self._lasting(quantity.name, time, exceeded)

    def _fallen(self, observation: Observation) -> Iterator[Abort]:
        """Yield the abort of a vehicle without poses that has fallen to the floor, where its estimate is worthless."""
        estimate, setpoint = observation.estimate, observation.setpoint_at_estimate
        if estimate is None or setpoint is None or observation.health.poses is FRESH:
            return
        floor, below = self._limits.space.low[2], setpoint[2] - estimate.position[2]
        if estimate.position[2] < floor < setpoint[2] and below > FALLEN:  # setpoints of landings are below the floor
            yield AbortReason.FALLEN.abort(Rung.CUT, metres=below)

    def _beyond_fence(self, position: Triple) -> float:
        """Return how far, m, a position is beyond the fence: walls and obstacles less the margin, without the floor."""
        return float(self._limits.space.nearest(np.array([position]), floor=False)[0][0])

    def _lasting(self, name: str, time: float, abort: Abort) -> Abort:
        """Return the abort at the gravest rung whose threshold has been exceeded for `patience`, by message times.

        Each rung has its own time, so that one value beyond a graver threshold is no reason for that rung; and a value
        that is repeated while its log is silent does not last.
        """
        lasting = Rung.NONE
        for rung in _RUNGS:
            since = self._since.setdefault((name, rung), time)
            if abort.rung < rung:
                del self._since[name, rung]
            elif time - since >= self._limits.flight.patience:
                lasting = rung
        return replace(abort, rung=lasting)


def ordered(order: Order | None, *, main_gone: bool) -> Abort | None:
    """Return an abort for an operator command or the loss of the main process; both also count on the ground."""
    if order is Order.CUT:
        return AbortReason.OPERATOR_CUT.abort(Rung.CUT)
    if order is Order.LAND:
        return AbortReason.OPERATOR_LAND.abort(Rung.LAND)
    return AbortReason.MAIN_PROCESS_GONE.abort(Rung.LAND) if main_gone else None


def fault_abort(error: Exception, rung: Rung = Rung.LAND) -> Abort:
    """Return the abort for a fault of this program or an unexpected error."""
    return AbortReason.PILOT_FAULT.abort(rung, error=error)


_NO_ABORT = Abort(Rung.NONE, ExitCode.OK, "")


def _ladder_abort(ladder: Ladder, value: float, reason: AbortReason, **texts: str) -> Abort:
    """Return the abort of a measured value, with the value in its message.

    NaN means that the measurement cannot be trusted: land.
    """
    if value <= ladder.brake:
        return _NO_ABORT
    rung = Rung.CUT if value > ladder.cut else Rung.LAND if value > ladder.land or math.isnan(value) else Rung.BRAKE
    return reason.abort(rung, value=value, **texts)
