"""Settings of a virtual Crazyflie: its sensors, firmware and state at start."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from cfplan.simulation.virtual_crazyflie.services import FIRMWARE_VERSION, PROTOCOL_VERSION


@dataclass(frozen=True, slots=True)
class Sensors:
    """Errors of the inertial sensors.

    Chosen so that the estimate in hover without poses drifts as the firmware's filter was measured to: 0.8, 1.8,
    5 and 15 cm after 0.05, 0.2, 0.5 and 1 s, on average.
    """

    gyro_noise: float = 0.01  # rad/s, standard deviation of a sample
    gyro_bias: float = 0.006  # rad/s, standard deviation about each axis of what calibration leaves
    acceleration_noise: float = 1.0  # m/s², standard deviation of a sample: vibration
    acceleration_bias: tuple[float, float, float] = (0.1, 0.1, 0.3)  # m/s², standard deviation along each axis


@dataclass(frozen=True, slots=True)
class VehicleSettings:
    """How the vehicle is when it is switched on."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m; its height is that of the floor
    yaw: float = 0.0  # rad
    auto_arming: bool | None = None
    """None: as the airframe's name says; brushed vehicles arm themselves, brushless ones wait for a request."""
    charge: float = 1.0  # share of the battery's capacity
    sensors: Sensors = field(default_factory=Sensors)
    protocol: int = PROTOCOL_VERSION
    firmware: str = FIRMWARE_VERSION
    seed: int = 1  # of the sensors' noise
    stored: Mapping[str, float] = field(default_factory=dict)  # parameters that it has other values of than the usual
    stubborn: tuple[str, ...] = ()  # parameters that writing does not change
    parameter_delay: float = 0.0  # s until it answers a write
    busy: bool = False  # the vehicle refuses every command to the on-board commander
