"""The virtual Crazyflie: body, sensors, battery and the radio's processor of a vehicle, around its firmware.

Only the sensors and the recorder see the true state; the firmware flies by measurements and packets.
"""

import os
from importlib import import_module

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.flight.radio.crtp import Port, pack
from cfplan.flight.radio.restart import POWER, POWER_CHANNEL, SYSTEM_OFF, SYSTEM_ON
from cfplan.machine_code import njit
from cfplan.simulation.engine.body import TIME_STEP, step_and_feel
from cfplan.simulation.engine.layout import (
    ASKED,
    EFFICIENCY,
    FLOOR,
    MASS,
    MOTORS,
    STATE_SIZE,
    THRUST_MAX,
    WIND,
    at_rest,
    new_vehicle,
    pack_airframe,
)
from cfplan.simulation.virtual_crazyflie.battery import Battery
from cfplan.simulation.virtual_crazyflie.faults import FIRMWARE_FAULTS, VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.firmware import FaultyFirmware
from cfplan.simulation.virtual_crazyflie.settings import FirmwareFactory, Sensors, VehicleSettings
from cfplan.simulation.virtual_crazyflie.supervisor import State
from cfplan.simulation.virtual_crazyflie.virtual_firmware import VirtualFirmware
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.motor_commands import FULL_COMMAND

FIRMWARE_VARIABLE = "CFPLAN_FIRMWARE"
PERIOD = 10  # ticks of 1 ms between updates of battery and faults
IN_AIR = 0.05  # m above the floor; a landing ends a little above it
_NOISE_ROWS = 8191  # ms after which the sensors' noise repeats; a prime, so that it has no common period with anything


class VirtualCrazyflie:
    """A vehicle of this airframe, switched on at tick 0. Raises InputError if CFPLAN_FIRMWARE names no firmware."""

    def __init__(self, airframe: Airframe, settings: VehicleSettings | None = None):
        self.settings = settings = settings or VehicleSettings()
        self.tick = 0  # ms
        self._airframe = airframe
        position = np.array(settings.position, dtype=float)
        self._body = new_vehicle(at_rest(position, settings.yaw), pack_airframe(airframe, floor=float(position[2])))
        self.truth = self._body[:STATE_SIZE]  # (17,) as in `engine.layout`
        self.wind = self._body[WIND : WIND + 3]  # (3,) m/s
        self.efficiency = self._body[EFFICIENCY : EFFICIENCY + 4]  # (4,) fraction of its thrust that each motor gives
        self.motors = np.zeros(4)  # commands, 16 bits
        self.off_in_air = 0  # ms so far, in the air while nothing commanded the motors to turn
        self.noise = _sensor_noise(settings.sensors, settings.seed)  # (8191, 6) gyroscope rad/s, accelerometer m/s²
        self._gyroscope, self._accelerometer, self._force = np.zeros(3), np.zeros(3), np.array((0.0, 0.0, GRAVITY))
        self._per_command = airframe.motor_thrust_max / FULL_COMMAND  # N
        self.battery = Battery(settings.charge, settings.capacity)
        self._faults: list[tuple[int, float, VehicleFault]] = []  # with the ticks at which they begin and end
        self._thrust_left: float | None = None  # fraction that the wash of others leaves; None: nothing ever took any
        self._powered, self._powers_up = True, False
        self._locked = False
        self._out: list[bytes] = []
        make = settings.make_firmware or _chosen_firmware() or VirtualFirmware
        self.firmware = make(airframe, settings)
        self._faulty = self.firmware if isinstance(self.firmware, FaultyFirmware) else None

    @property
    def supervisor_state(self) -> State:
        """Return the supervisor's state, which without power is that before it starts."""
        return State(self.firmware.supervisor_state) if self._powered else State.NOT_INITIALIZED

    @property
    def locked(self) -> bool:
        """Return whether the supervisor was ever locked."""
        self._locked = self._locked or self.supervisor_state is State.LOCKED
        return self._locked

    def inject(self, fault: VehicleFault) -> None:
        """Add a fault; its start counts from now.

        Raises InputError for a fault of the firmware, if this one does not simulate any.
        """
        if fault.kind in FIRMWARE_FAULTS and self._faulty is None:
            raise InputError(
                f"this firmware does not simulate a fault of kind {fault.kind.value!r}",
                where=type(self.firmware).__name__,
                hint="choose a fault of body or battery, or cfplan's own firmware",
            )
        begin = self.tick + round(1000 * fault.start)
        self._faults.append((begin, begin + 1000 * fault.duration, fault))

    def lose_thrust(self, fraction: float) -> None:
        """Lose a fraction of all thrust, as in the air beneath another vehicle, until this is called again."""
        if fraction or self._thrust_left is not None:
            self._thrust_left = 1.0 - fraction

    def receive(self, packet: bytes) -> None:
        """Take a packet; its answer comes out of `sent`."""
        if packet[1:2] == _POWER and len(packet) > 2 and packet[0] & 0xF3 == _POWER_HEADER:
            self._switch(packet[2])
        elif self._powered:
            self.firmware.receive(packet)

    def sent(self) -> list[bytes]:
        """Return the packets sent since the last call."""
        packets = self.firmware.sent() if self._powered else []
        if self._out:
            packets, self._out = self._out + packets, []
        return packets

    def advance(self, ticks: int) -> None:
        """Advance by `ticks` milliseconds."""
        for _ in range(ticks):
            self.step()

    def step(self) -> None:
        """Advance by a millisecond."""
        if self.tick % PERIOD == 0:
            self._update()
        row = self.noise[self.tick % _NOISE_ROWS]
        commands = None
        _sense(self._body, self._force, row, self._gyroscope, self._accelerometer)
        if self._powered:
            commands = self.firmware.tick(self._gyroscope, self._accelerometer, self._force, self.battery.voltage)
        if commands is None:
            self.motors[:] = 0.0
            self.off_in_air += self.truth.item(2) > self._body.item(FLOOR) + IN_AIR
        else:
            self.motors[:] = commands
        _move(self._body, self.motors, self._per_command, self._force)
        self.tick += 1

    def _update(self) -> None:
        """Apply faults, drain the battery, and see whether the supervisor has locked."""
        if self._powers_up:
            self._powers_up, self._powered = False, True
            self.firmware.restart()
        if self._faults or self._thrust_left is not None:
            self._apply_faults()
        self.battery.drain(float(self.truth[MOTORS].sum()), PERIOD / 1000)
        self._body[THRUST_MAX] = self.battery.strength * self._airframe.motor_thrust_max
        self._locked = self.locked

    def _apply_faults(self) -> None:
        """Apply the faults of this moment."""
        acting = {fault.kind: fault.strength for begin, end, fault in self._faults if begin <= self.tick < end}
        self.efficiency[:] = 1.0 if self._thrust_left is None else self._thrust_left
        self.efficiency[0] *= acting.get(VehicleFaultKind.MOTOR, 1.0)
        if VehicleFaultKind.TUMBLE in acting:
            self.efficiency[2:4] = 0.0
        self.wind[1] = acting.get(VehicleFaultKind.GUST, 0.0)
        self._body[MASS] = self._airframe.mass * acting.get(VehicleFaultKind.MASS, 1.0)
        if VehicleFaultKind.BATTERY not in acting:
            self.battery.sag = 0.0
        elif self.battery.sag == 0.0:
            self.battery.sag = max(self.battery.voltage - acting[VehicleFaultKind.BATTERY], 0.0)
        if self._faulty is not None:
            self._faulty.fail(acting.keys() & FIRMWARE_FAULTS)

    def _switch(self, command: int) -> None:
        """Obey as the radio's own processor, which switches the main one off and on; the body stays where it is."""
        if command == SYSTEM_OFF:
            self._powered = self._powers_up = False
            self.truth[MOTORS] = 0.0
        elif command == SYSTEM_ON:
            self._powers_up = not self._powered
        self._out.append(pack(Port.LINK, POWER_CHANNEL, bytes((POWER, command))))


_POWER_HEADER, _POWER = pack(Port.LINK, POWER_CHANNEL, b"")[0] & 0xF3, bytes((POWER,))  # without the link's own bits


def _chosen_firmware() -> FirmwareFactory | None:
    """Return the factory that CFPLAN_FIRMWARE names, as `package.module:factory`; None where it is unset."""
    name = os.environ.get(FIRMWARE_VARIABLE)
    if not name:
        return None
    module, _, factory = name.partition(":")
    try:
        return getattr(import_module(module), factory)
    except (ImportError, AttributeError, ValueError) as why:
        raise InputError(
            f"no firmware {name!r}: {why}",
            where=FIRMWARE_VARIABLE,
            hint="package.module:factory, in a module that Python finds; unset it for cfplan's own firmware",
        ) from why


def _sensor_noise(sensors: Sensors, seed: int) -> NDArray:
    chance = np.random.default_rng(seed)
    noise = np.empty((_NOISE_ROWS, 6))
    noise[:, :3] = chance.normal(chance.normal(0.0, sensors.gyro_bias, 3), sensors.gyro_noise, (_NOISE_ROWS, 3))
    noise[:, 3:] = chance.normal(
        chance.normal(0.0, sensors.acceleration_bias), sensors.acceleration_noise, (_NOISE_ROWS, 3)
    )
    return noise


@njit(allocates=False)
def _sense(body: NDArray, force: NDArray, noise: NDArray, gyroscope: NDArray, accelerometer: NDArray) -> None:
    """Write what the sensors measure: true body rate and specific force, with errors, (6,)."""
    for axis in range(3):
        gyroscope[axis] = body[10 + axis] + noise[axis]
        accelerometer[axis] = force[axis] + noise[3 + axis]


@njit(allocates=False)
def _move(body: NDArray, commands: NDArray, per_command: float, force: NDArray) -> None:
    """Let the body move by a millisecond with its motors' commands, and write the specific force, (3,) m/s²."""
    for motor in range(4):
        body[ASKED + motor] = commands[motor] * per_command
    step_and_feel(body, TIME_STEP, force)
