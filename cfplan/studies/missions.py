"""From a path file to the mission that flies it, as `cfplan fly` makes it."""

from pathlib import Path

from cfplan.errors import NotCertifiedError
from cfplan.flight.encoding import check_bytes, encode_trajectory
from cfplan.flight.mission import Mission, mission_of
from cfplan.geometry.path_file import load_path_file
from cfplan.planning.plan import plan
from cfplan.safety.limits import load_limits


def plan_mission(path_file: Path, safety_file: Path) -> Mission:
    """Plan, certify and encode. Raises what those raise, and NotCertifiedError where the plan does not pass."""
    limits = load_limits(safety_file)
    loaded = load_path_file(path_file)
    made = plan(
        loaded.path,
        limits.airframe,
        limits,
        yaw=loaded.yaw,
        yaw_angle=loaded.yaw_angle,
        speed_share=loaded.speed,
    )
    if not made.certificate.passed:
        raise NotCertifiedError("the plan does not pass its certificate", where=str(path_file))
    encoded = encode_trajectory(made.trajectory)
    check_bytes(encoded, made.trajectory, limits.plan)
    return mission_of(encoded, limits)
