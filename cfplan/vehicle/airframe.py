"""An airframe: mass, inertia, motors and motor mixing, drag."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

GRAVITY = 9.81  # m/s², as the firmware has it

# Motors 1 front right, 2 back right, 3 back left, 4 front left: the sign of each motor's torque about x, y, z.
MOTOR_TORQUE_SIGNS = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]], dtype=float)


@dataclass(frozen=True, slots=True)
class Airframe:
    """A quadrotor in X configuration."""

    name: str
    mass: float  # kg, as flown
    inertia: tuple[float, float, float]  # kg m², diagonal, body axes
    arm: float  # m, distance of a motor from the x and from the y axis
    thrust_to_torque: float  # m, yaw torque per thrust
    motor_thrust_min: float  # N, least thrust of a running motor
    motor_thrust_max: float  # N, most thrust of one motor
    motor_time_constant: float  # s, first-order lag of thrust
    drag: tuple[float, float]  # N s/m, linear rotor drag in the rotor plane and along the thrust axis
    source: str
    rotor_reaction: float = 0.0
    """N m s/N, yaw torque per rate of change of thrust: a rotor's inertia over the slope of its thrust by its speed."""

    @property
    def hover_thrust(self) -> float:
        """Return the thrust of each motor in hover, N."""
        return self.mass * GRAVITY / 4

    @property
    def command_per_thrust(self) -> float:
        """Return 16-bit units of a motor's command per N of collective thrust: what ctrlMel.massThrust should be."""
        return 65535 / (4 * self.motor_thrust_max)

    @property
    def mixing(self) -> NDArray:
        """Return (4, 4): [collective thrust, torque x, y, z] = mixing @ motor thrusts."""
        levers = np.array([self.arm, self.arm, self.thrust_to_torque])
        return np.vstack([np.ones(4), levers[:, None] * MOTOR_TORQUE_SIGNS])
