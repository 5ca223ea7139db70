"""From a path file to the mission that flies it, as `cfplan fly` makes it."""

from dataclasses import dataclass
from pathlib import Path

from cfplan.errors import NotCertifiedError
from cfplan.flight.pilot.mission import Mission, mission_of
from cfplan.flight.setpoints.encoding import HOLD, EncodedFlight, encode_checked
from cfplan.geometry.path_file import load_path_file
from cfplan.planning.plan import Plan, plan
from cfplan.safety.limits_file import load_limits


@dataclass(frozen=True, slots=True)
class PlannedMission:
    """A mission and what it was made of."""

    plan: Plan
    encoded: EncodedFlight
    mission: Mission


def plan_mission(path_file: Path, safety_file: Path) -> Mission:
    """Plan, certify and encode. Raises what those raise, and NotCertifiedError where the plan does not pass."""
    return planned_mission(path_file, safety_file).mission


def planned_mission(path_file: Path, safety_file: Path, *, stream_for: float = 0.0) -> PlannedMission:
    """The same with its plan; what is streamed lasts `stream_for` s at least, of which the last part is a hover."""
    limits = load_limits(safety_file)
    loaded = load_path_file(path_file)
    made = plan(
        loaded.path,
        limits.airframe,
        limits,
        yaw=loaded.yaw,
        yaw_angle=loaded.yaw_angle,
        speed_factor=loaded.speed,
    )
    if not made.certificate.passed:
        raise NotCertifiedError("the plan does not pass its certificate", where=str(path_file))
    encoded = encode_checked(made.trajectory, limits.plan, hold=max(HOLD, stream_for - made.trajectory.duration))
    return PlannedMission(made, encoded, mission_of(encoded, limits))
