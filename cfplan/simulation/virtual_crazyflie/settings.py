"""Settings of a virtual Crazyflie: its sensors, firmware and state at start."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from cfplan.simulation.virtual_crazyflie.battery import CAPACITY
from cfplan.simulation.virtual_crazyflie.firmware import Firmware
from cfplan.simulation.virtual_crazyflie.services import FIRMWARE_VERSION, PROTOCOL_VERSION
from cfplan.vehicle.airframe import Airframe

FirmwareFactory = Callable[[Airframe, "VehicleSettings"], Firmware]


@dataclass(frozen=True, slots=True)
class Sensors:
    """Errors of the inertial sensors that calibration at power-up leaves.

    The firmware then takes the gyroscope's mean for zero, and scales the accelerometer so that it measures 1 g
    (sensors_bmi088_bmp3xx.c: processGyroBias, processAccScale). A level vehicle's vertical offset is gone with that,
    and comes back with temperature: typically 0.015 °/s and 0.2 mg for each kelvin (BMI088, data sheet), here over
    10 K, as the board warms between power-up and flight. Vibration that the accelerometer rectifies is not known; half
    of the temperature's is allowed for it. Offsets to the sides stay, and count on the ground alone.
    """

    gyro_noise: float = 0.01  # rad/s, standard deviation of a sample
    gyro_bias: float = 0.0026  # rad/s, standard deviation about each axis
    acceleration_noise: float = 1.0  # m/s², standard deviation of a sample: vibration
    acceleration_bias: tuple[float, float, float] = (0.1, 0.1, 0.03)  # m/s², standard deviation along each axis


@dataclass(frozen=True, slots=True)
class VehicleSettings:
    """The state of a vehicle when it is switched on.

    A firmware other than cfplan's own need not heed `auto_arming`, `protocol`, `firmware`, `stored`, `stubborn` and
    `parameter_delay`.
    """

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m; its height is that of the floor
    yaw: float = 0.0  # rad
    auto_arming: bool | None = None
    """None: as the airframe's name says; brushed vehicles arm themselves, brushless ones wait for a request."""
    charge: float = 1.0  # fraction of the battery's capacity
    capacity: float = CAPACITY  # A s, of the battery
    sensors: Sensors = field(default_factory=Sensors)
    protocol: int = PROTOCOL_VERSION
    firmware: str = FIRMWARE_VERSION
    seed: int = 1  # of the sensors' noise
    stored: Mapping[str, float] = field(default_factory=dict)  # parameters whose values differ from the defaults
    stubborn: tuple[str, ...] = ()  # parameters that writing does not change
    parameter_delay: float = 0.0  # s until it answers a write
    make_firmware: FirmwareFactory | None = None  # None: as CFPLAN_FIRMWARE says, else cfplan's own

    @property
    def version(self) -> tuple[int, ...]:
        """Return the firmware's version."""
        return tuple(int(part) for part in re.findall(r"\d+", self.firmware))
