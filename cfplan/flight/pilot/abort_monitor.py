"""The abort monitor: every trigger of the abort ladder in one place, checked a hundred times a second."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from cfplan.errors import ExitCode
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.radio.supervisor_bits import FAULTS
from cfplan.flight.telemetry import Estimate, Triple, VehicleStatus
from cfplan.safety.limits import Ladder, Limits
from cfplan.safety.quantities import ON_LADDER
from cfplan.safety.space import inside

LATEST_SETPOINT = 0.25  # s that a setpoint may be late; the vehicle stops following after 0.5 s
OLDEST_LOG = 0.5  # s without the vehicle's log
LINK_GONE = 10.0  # s without a log, after which the link counts as lost; until then it may come back
DISAGREEMENT_FACTOR = 5.0  # times preflight's limit that estimate and pose may be apart in the air
# m/s, horizontally and lasting, that the poses may move otherwise than the vehicle believes, while it flies slowly:
# 0.05 in the virtual lab, where the wind blows 0.15, and 0.4 once the vehicle cannot be held any more.
MOVES_OTHERWISE = Ladder(brake=0.2, land=0.2, cut=0.3)
FALLEN = 0.15  # m below its setpoint, of a vehicle on the floor that got there without being asked
# By what a quantity of the table with a ladder is measured.
MEASURED: Mapping[str, Callable[[Estimate, VehicleStatus], Triple]] = MappingProxyType(
    {
        "speed": lambda estimate, _: estimate.velocity,
        "acceleration": lambda estimate, _: estimate.acceleration,
        "angular_velocity": lambda _, status: status.body_rate,
    }
)


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
    order: Order | None = None
    main_gone: bool = False
    link_lost: str = ""
    pose: Pose | None = None  # the last good one
    pose_fault: str = ""  # why none has come since
    without_pose: float = 0.0  # s since the last pose that went to the vehicle: late ones do not
    wanted: Triple | None = None
    """m, where the vehicle should have been when the pose was taken; None where no setpoint says so."""
    estimate: Estimate | None = None
    asked: Triple | None = None
    """m, where the vehicle should have been at the time of its estimate; None where no setpoint says so."""
    status: VehicleStatus | None = None
    otherwise: float = 0.0
    """m/s, horizontally, between the motion of the poses and that of the estimate; 0 where that is not looked at."""
    late: float = 0.0  # s, by which the last setpoint missed its deadline


class AbortMonitor:
    """Finds the gravest reason to leave the plan; keeps a short history of battery and motion."""

    def __init__(self, limits: Limits):
        self._limits = limits
        self._voltage: float | None = None
        self._voltage_time = 0.0
        self._since: dict[str, float] = {}

    def ordered(self, observation: Observation) -> Abort | None:
        """Return an abort for an operator command or the loss of the main process; also checked on the ground."""
        if observation.order is Order.CUT:
            return Abort(Rung.CUT, ExitCode.ENDED_BY_OPERATOR, "the operator cut the motors")
        if observation.order is Order.LAND:
            return Abort(Rung.LAND, ExitCode.ENDED_BY_OPERATOR, "the operator ended the flight")
        if observation.main_gone:
            return Abort(Rung.LAND, ExitCode.ENDED_BY_SAFETY, "the main process is gone")
        return None

    def gravest(self, observation: Observation) -> Abort | None:
        """Return the gravest abort of all, None where there is no reason for one; checked in the air."""
        aborts = [abort for abort in self._aborts(observation) if abort.rung]
        ordered = self.ordered(observation)
        if ordered is not None:
            aborts.insert(0, ordered)
        return max(aborts, key=lambda abort: abort.rung, default=None)

    def _aborts(self, observation: Observation) -> Iterator[Abort]:
        yield from self._pose(observation)
        yield from self._vehicle(observation)
        yield from self._motion(observation)
        yield from self._fallen(observation)
        if observation.late > LATEST_SETPOINT:
            yield safety_abort(Rung.BRAKE, f"a setpoint was {observation.late:.2f} s late")

    def _pose(self, observation: Observation) -> Iterator[Abort]:
        limits = self._limits.pose
        if observation.pose is None:
            yield safety_abort(Rung.LAND, "there is no pose")
            return
        age = observation.now - observation.pose.time
        if age > limits.age_brake:
            rung = Rung.LAND if age > limits.age_land else Rung.BRAKE
            why = f" ({observation.pose_fault})" if observation.pose_fault else ""
            yield safety_abort(rung, f"the last good pose is {age:.2f} s old{why}")
        without = observation.without_pose
        if without > limits.age_land >= age:
            yield safety_abort(Rung.LAND, f"no pose for {without:.2f} s: they come {age:.2f} s late")

    def _vehicle(self, observation: Observation) -> Iterator[Abort]:
        if observation.estimate is None or observation.status is None:
            return
        silent = observation.now - max(observation.estimate.time, observation.status.time)
        if silent > OLDEST_LOG:
            yield safety_abort(Rung.LAND, f"the vehicle's log has been silent for {silent:.1f} s")
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
        if observation.estimate is None or observation.status is None:
            return
        newest = self._limits.pose.age_warning
        if (
            observation.pose is not None
            and observation.now - min(observation.pose.time, observation.estimate.time) <= newest
        ):
            apart = math.dist(observation.pose.position, observation.estimate.position)
            if apart > DISAGREEMENT_FACTOR * self._limits.pose.agreement:
                yield safety_abort(Rung.BRAKE, f"pose and estimate are {apart:.2f} m apart")
        moves = _rung(
            MOVES_OTHERWISE,
            observation.otherwise,
            "the tracked body moves by {:.2f} m/s otherwise than the vehicle believes: are its axes the vehicle's?",
        )
        yield self._lasting("moves otherwise", observation.now, moves)
        for quantity in ON_LADDER:
            value = math.hypot(*MEASURED[quantity.ladder](observation.estimate, observation.status))
            text = f"{quantity.name} of {{:.1f}} {quantity.unit}"
            measured = _rung(getattr(limits, quantity.ladder), value, text)
            yield self._lasting(quantity.name, observation.now, measured)

    def _fallen(self, observation: Observation) -> Iterator[Abort]:
        """Yield that a vehicle without poses lies on the floor: what it believes after that is worth nothing."""
        estimate, asked = observation.estimate, observation.asked
        if estimate is None or asked is None or observation.without_pose <= self._limits.pose.age_brake:
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


def safety_abort(rung: Rung, text: str) -> Abort:
    """Return an abort that counts as ended by a safety rule."""
    return Abort(rung, ExitCode.ENDED_BY_SAFETY, text)


_NO_ABORT = safety_abort(Rung.NONE, "")


def _rung(ladder: Ladder, value: float, text: str) -> Abort:
    """Return the abort of a measured value, and write the value into the text.

    Not a number means that the measurement cannot be trusted: land.
    """
    if value <= ladder.brake:
        return _NO_ABORT
    rung = Rung.CUT if value > ladder.cut else Rung.LAND if value > ladder.land or math.isnan(value) else Rung.BRAKE
    return safety_abort(rung, text.format(value))
