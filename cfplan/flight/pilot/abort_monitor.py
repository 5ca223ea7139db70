"""The abort monitor: every trigger of the abort ladder in one place, checked a hundred times a second in the air."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from cfplan.errors import ExitCode
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.pilot.health import FRESH, GONE, LOG_GONE, UPLINK_GONE, Health
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.radio.supervisor_bits import FAULTS
from cfplan.flight.telemetry import Estimate, Triple, VehicleStatus
from cfplan.safety.limits import Ladder, Limits
from cfplan.safety.quantities import ON_LADDER
from cfplan.safety.space import inside

LATEST_SETPOINT = 0.25  # s that a setpoint may be late; the vehicle stops following after 0.5 s
DISAGREEMENT_FACTOR = 5.0  # times preflight's limit that estimate and pose may be apart in the air
FALLEN = 0.15  # m below its setpoint, of a vehicle on the floor that got there without being asked


@dataclass(frozen=True, slots=True)
class Abort:
    """A reason to leave the plan, and how."""

    rung: Rung
    exit_code: ExitCode
    text: str


@dataclass(slots=True)
class Observation:
    """What the pilot knows at one moment, in s on the clock of time.monotonic(), m, and radians."""

    now: float  # s
    pose: Pose | None = None  # the last good one
    pose_fault: str = ""  # why none has come since
    health: Health = Health()  # noqa: RUF009  it is frozen
    wanted: Triple | None = None
    """m, where the vehicle should have been when the pose was taken; None where no setpoint says so."""
    estimate: Estimate | None = None  # None while its log is gone
    asked: Triple | None = None
    """m, where the vehicle should have been at the time of its estimate; None where no setpoint says so."""
    status: VehicleStatus | None = None  # None while its log is gone
    late: float = 0.0  # s, by which the last setpoint missed its deadline


# The measured value of each quantity that has a ladder; None while the log that reports it is gone.
MEASURED: Mapping[str, Callable[[Observation], Triple | None]] = MappingProxyType(
    {
        "speed": lambda seen: seen.estimate.velocity if seen.estimate is not None else None,
        "acceleration": lambda seen: seen.estimate.acceleration if seen.estimate is not None else None,
        "angular_velocity": lambda seen: seen.status.body_rate if seen.status is not None else None,
    }
)


class AbortMonitor:
    """Finds the gravest reason to leave the plan; keeps a short history of battery and motion."""

    def __init__(self, limits: Limits):
        self._limits = limits
        self._voltage: float | None = None
        self._voltage_time = 0.0
        self._since: dict[str, float] = {}

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
            yield safety_abort(Rung.BRAKE, f"a setpoint was {observation.late:.2f} s late")

    def _silence(self, observation: Observation) -> Abort:
        """Return the abort that the present health calls for; its text names the most important silent source."""
        health, pose = observation.health, observation.pose
        rung, age_brake = health.reaction.rung, self._limits.pose.age_brake
        if health.uplink is GONE:
            return safety_abort(rung, f"the vehicle has acknowledged nothing for {UPLINK_GONE:g} s")
        if health.poses is not FRESH and pose is None:
            return safety_abort(rung, "there is no pose")
        if health.poses is not FRESH and pose is not None:
            age, why = observation.now - pose.time, observation.pose_fault
            if age <= age_brake:
                return safety_abort(rung, f"no pose goes to the vehicle: {why or f'they come {age:.2f} s late'}")
            bracket = f" ({why})" if why else ""
            return safety_abort(rung, f"the last good pose is {age:.2f} s old{bracket}")
        silent = " and ".join(name for name in ("estimate", "status") if getattr(health, name) is GONE)
        return safety_abort(rung, f"the vehicle's log of its {silent} has been silent for {LOG_GONE:g} s")

    def _vehicle(self, observation: Observation) -> Iterator[Abort]:
        if observation.status is None:
            return
        for bit, fault in FAULTS.items():
            if observation.status.supervisor & bit:
                yield safety_abort(Rung.CUT, f"the vehicle {fault}")
        voltage = self._loaded_voltage(observation.status)
        if voltage < self._limits.battery.under_load:
            yield safety_abort(Rung.LAND, f"the battery is down to {voltage:.2f} V")

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
            yield _rung(limits.fence, 0.0 if inside(beyond) else beyond, "{:.2f} m beyond the fence")
            if observation.wanted is not None:
                deviation = math.dist(observation.pose.position, observation.wanted)
                yield _rung(limits.deviation, deviation, "{:.2f} m from the setpoint")
        estimate = observation.estimate
        if (
            observation.pose is not None
            and estimate is not None
            and observation.health.estimate is FRESH
            and observation.now - observation.pose.time <= self._limits.pose.age_warning
        ):
            apart = math.dist(observation.pose.position, estimate.position)
            if apart > DISAGREEMENT_FACTOR * self._limits.pose.agreement:
                yield safety_abort(Rung.BRAKE, f"pose and estimate are {apart:.2f} m apart")
        for quantity in ON_LADDER:
            measured, exceeded = MEASURED[quantity.ladder](observation), _NO_ABORT
            if measured is not None:
                text = f"{quantity.name} of {{:.1f}} {quantity.unit}"
                exceeded = _rung(getattr(limits, quantity.ladder), math.hypot(*measured), text)
            yield self._lasting(quantity.name, observation.now, exceeded)

    def _fallen(self, observation: Observation) -> Iterator[Abort]:
        """Yield that a vehicle without poses lies on the floor: what it believes after that is worth nothing."""
        estimate, asked = observation.estimate, observation.asked
        if estimate is None or asked is None or observation.health.poses is FRESH:
            return
        floor, below = self._limits.space.low[2], asked[2] - estimate.position[2]
        if estimate.position[2] < floor < asked[2] and below > FALLEN:  # landings ask for places beneath the floor
            yield safety_abort(Rung.CUT, f"it is on the floor without poses, {below:.2f} m below its setpoint")

    def _beyond_fence(self, position: Triple) -> float:
        """Return how far, m, a position is beyond the space less its margin; the floor does not count."""
        space, (x, y, z) = self._limits.space, position
        above_middle = max(z, (space.low[2] + space.high[2]) / 2)
        return float(space.beyond((x, y, above_middle)).max())

    def _lasting(self, name: str, now: float, abort: Abort) -> Abort:
        """Return the abort if its reason has lasted; a single noisy value is no reason."""
        if not abort.rung:
            self._since.pop(name, None)
            return abort
        since = self._since.setdefault(name, now)
        return abort if now - since >= self._limits.flight.patience else Abort(Rung.NONE, abort.exit_code, abort.text)


def ordered(order: Order | None, *, main_gone: bool) -> Abort | None:
    """Return an abort for an operator command or the loss of the main process; both also count on the ground."""
    if order is Order.CUT:
        return Abort(Rung.CUT, ExitCode.ENDED_BY_OPERATOR, "the operator cut the motors")
    if order is Order.LAND:
        return Abort(Rung.LAND, ExitCode.ENDED_BY_OPERATOR, "the operator ended the flight")
    return safety_abort(Rung.LAND, "the main process is gone") if main_gone else None


def safety_abort(rung: Rung, text: str) -> Abort:
    """Return an abort that counts as ended by a safety rule."""
    return Abort(rung, ExitCode.ENDED_BY_SAFETY, text)


def fault_abort(error: Exception, rung: Rung = Rung.LAND) -> Abort:
    """Return the abort for a fault of this program or an unexpected error."""
    return safety_abort(rung, f"fault in the pilot: {error!r}")


_NO_ABORT = safety_abort(Rung.NONE, "")


def _rung(ladder: Ladder, value: float, text: str) -> Abort:
    """Return the abort of a measured value, and write the value into the text.

    Not a number means that the measurement cannot be trusted: land.
    """
    if value <= ladder.brake:
        return _NO_ABORT
    rung = Rung.CUT if value > ladder.cut else Rung.LAND if value > ladder.land or math.isnan(value) else Rung.BRAKE
    return safety_abort(rung, text.format(value))
