"""The firmware interface of the virtual Crazyflie; another implementation can replace cfplan's own."""

from collections.abc import Sequence, Set
from typing import Protocol, runtime_checkable

from numpy.typing import NDArray

from cfplan.simulation.virtual_crazyflie.faults import VehicleFaultKind


class Firmware(Protocol):
    """The program of one vehicle's main processor, switched on when it is made. Called from one thread at a time."""

    @property
    def supervisor_state(self) -> int:
        """The supervisor's state, as `supervisor.State` counts them, which is as the firmware does."""

    def tick(
        self, gyroscope: NDArray, accelerometer: NDArray, without_vibration: NDArray, voltage: float
    ) -> Sequence[float] | NDArray | None:
        """Run for one millisecond, the next one, and return the command of each motor, (4,).

        `gyroscope` (3,) rad/s and `accelerometer` (3,) m/s², the specific force, are samples in right-handed body axes,
        x forward, y left, z up; errors of the sensors are in them. `without_vibration` (3,) m/s² is the specific force
        as a perfect low-pass filter would leave it. The arrays are used again: copy what must last. `voltage` is that
        of the battery under load, V.

        Commands are fractions of the airframe's largest thrust, times 65,535. None means that nothing commands the
        motors to turn, as without a setpoint or where the supervisor stops them: the lab counts such time in the air.
        """

    def receive(self, packet: bytes) -> None:
        """Take a packet from the radio: CRTP header and payload, 1 to 31 bytes unless the sender errs."""

    def sent(self) -> list[bytes]:
        """Return the packets for the radio since the last call, in order. Called after each tick and each packet."""

    def restart(self) -> None:
        """Start anew, as by switching power off and on; what is stored on board stays. The next tick is the first."""


@runtime_checkable
class FaultyFirmware(Firmware, Protocol):
    """A firmware in which faults can be simulated that are its own, and not of body, sensors or battery."""

    def fail(self, faults: Set[VehicleFaultKind]) -> None:
        """Let these of `FIRMWARE_FAULTS` act from now on, and no others."""
