"""What the certificate is judged by: the same quantities on a far finer grid, with no allowance between samples."""

from itertools import pairwise

import numpy as np

from cfplan.safety.limits import PlanLimits
from cfplan.safety.space import Space
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.motion import states_at
from cfplan.vehicle.trajectory import Trajectory, state_of

AIRFRAME = AIRFRAMES["crazyflie-2.1+"]
LIMITS = PlanLimits(
    speed=2.0, acceleration=5.0, angular_velocity=8.0, tilt=np.radians(30), motor_thrust_min=0.024,
    motor_thrust_max=0.109, specific_thrust_min=4.905,
)  # fmt: skip
SPACE = Space(low=(-2.25, -4.0, 0.0), high=(2.25, 4.0, 2.0), margin=0.2)


def worst_values(trajectory: Trajectory, space: Space, parts: int = 20) -> dict[str, float]:
    """Return the worst of each quantity, larger is worse, on a grid `parts` times as fine as the certificate's."""
    path, profile = trajectory.path, trajectory.profile
    edges = np.union1d(profile.s, path.breaks)
    worst: dict[str, float] = {}
    for left, right in pairwise(edges):  # both sides of every break
        if right - left < 1e-11:
            continue
        duration = float(trajectory.time_at(right) - trajectory.time_at(left))
        count = parts * max(10, int(np.ceil(duration / 1e-3)))
        s = np.append(np.linspace(left, right, count, endpoint=False), np.nextafter(right, 0))
        interval = np.full(len(s), int(profile.interval(np.array((left + right) / 2))))
        curve = path.derivatives(s)
        state = state_of(s, s, curve, states_at(trajectory.airframe, curve, profile.table(), s, interval))
        inside = np.minimum(state.position - space.low, np.array(space.high) - state.position)
        for name, value in {
            "speed": np.linalg.norm(state.velocity, axis=1).max(),
            "acceleration": np.linalg.norm(state.acceleration, axis=1).max(),
            "angular velocity": np.linalg.norm(state.body_rate, axis=1).max(),
            "angular acceleration": np.linalg.norm(state.angular_acceleration, axis=1).max(),
            # not by the cosine, which makes 1e-8 rad of a rounding error
            "tilt": np.arctan2(np.hypot(*state.thrust_axis[:, :2].T), state.thrust_axis[:, 2]).max(),
            "motor thrust, most": state.motor_thrust.max(),
            "motor thrust, least": -state.motor_thrust.min(),
            "specific thrust, least": -state.specific_thrust.min(),
            "distance to the walls": -inside.min(),
        }.items():
            worst[name] = max(worst.get(name, -np.inf), value)
    return worst
