"""The pilot's link to one Crazyflie: commands in flight, and the vehicle's reports."""

import math
import struct
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import IO, Any

import numpy as np

from cfplan.flight.radio.crtp import Port, pack
from cfplan.flight.radio.log_block import SETTINGS_CHANNEL, LogBlock
from cfplan.flight.radio.perishable import EXTERNAL_POSE
from cfplan.flight.radio.session import READ_PARAMETER, WRITE_PARAMETER, Session
from cfplan.flight.setpoints.packets import decompress_quaternion
from cfplan.flight.telemetry import Estimate, Telemetry, Triple, VehicleStatus
from cfplan.vehicle.airframe import GRAVITY

_MOTOR_TEST = "motorPowerSet.enable"
_ANSWER_TIMEOUT = 2.0  # s
_CLOSE_TIMEOUT = 2.0  # s for closing

_MILLI = 1e-3
_CLOCK_DRIFT = 5e-4  # relative difference of the vehicle's clock
_STAMPS_WRAP = (1 << 24) * _MILLI  # s
_WRAP_TOLERANCE = 60.0  # s
_ESTIMATE = [f"stateEstimateZ.{name}" for name in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az")]
ESTIMATE_LOG = ([(name, "int16_t") for name in _ESTIMATE] + [("stateEstimateZ.quat", "uint32_t")], 10)
STATUS_LOG = (
    [(f"stateEstimateZ.{name}", "int16_t") for name in ("rateRoll", "ratePitch", "rateYaw")]
    + [(f"motor.m{motor}", "uint16_t") for motor in (1, 2, 3, 4)]
    + [("pm.vbatMV", "uint16_t"), ("supervisor.info", "uint16_t")],
    20,
)
# The setpoint in force: position, velocity and acceleration; from firmware 2026.08 on also its modes.
TARGET_LOG = ([(f"ctrltargetZ.{name}", "int16_t") for name in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az")], 40)
TARGET_MODES = [(f"ctrltarget.mode_{name}", "uint8_t") for name in ("x", "y", "z", "roll", "pitch", "yaw", "quat")]
VARIANCE_LOG = ([(f"kalman.var{axis}", "float") for axis in "XYZ"], 10)


class Link:
    """A connected Crazyflie, made by `connection.connect` or by a stepped lab."""

    def __init__(
        self,
        session: Session,
        report: Callable[[Telemetry], None],
        restart: Callable[[], None],  # restarts the vehicle's main processor once the link is closed; raises LinkError
        radio_lock: IO[str] | None = None,  # keeps other pilots from the radio until the link closes
    ):
        self._session, self._report, self._clock = session, report, session.clock
        self.uri, self.restart, self._radio_lock = session.uri, restart, radio_lock
        self.estimate: Estimate | None = None
        self.status: VehicleStatus | None = None
        self.position_variance: Triple | None = None  # m² along x, y, z
        self.has_setpoint = False  # the controller has one, from any client; known until `stop_preflight_logs`
        self.replies: dict[int, int] = {}  # by command of the on-board commander: the code of its answer, 0 for done
        self.motor_test = False  # whether a motor test is on, by the last answer to `ask_motor_test`
        self._motor_test = b""  # packed number of its parameter, once it was queried
        self._preflight_blocks: list[LogBlock] = []
        self._log_recreation: dict[str, Iterator[bytes | None]] = {}  # packets that recreate a log, by its name
        # s: zero of the vehicle's clock according to the quickest messages; arrival of the last message
        self._log_zero, self.log_heard = math.inf, 0.0
        session.listen(Port.HIGH_LEVEL, self._on_reply)
        session.listen(Port.PARAMETERS, self._on_parameter)

    @property
    def lost(self) -> str:
        """Return why the link is lost; empty while it is up."""
        return self._session.lost

    @property
    def acknowledged(self) -> float:
        """Return when, s, the vehicle last answered a ping, ten a second."""
        return self._session.acknowledged

    @property
    def round_trip(self) -> float:
        """Return the round trip, s: 95th percentile of the last pings; 0 before the first."""
        return self._session.round_trip

    @property
    def protocol(self) -> int:
        return self._session.protocol

    @property
    def firmware(self) -> str:
        return self._session.firmware

    # Sent in flight: these never wait.

    def _send(self, port: Port, channel: int, data: bytes) -> None:
        self.send(pack(port, channel, data))

    def send(self, packet: bytes) -> None:
        """Send a packet; a lost link drops it silently, see `lost`."""
        self._session.send(packet)

    def send_pose(self, position: Sequence[float], quaternion: Sequence[float]) -> None:
        self._send(Port.LOCALIZATION, 1, struct.pack("<B7f", EXTERNAL_POSE, *position, *quaternion))

    def release_priority(self) -> None:
        """Hand the vehicle back to its on-board commander."""
        self._send(Port.SETPOINT, 1, struct.pack("<BI", 0, 0))

    def command(self, command: bytes) -> None:
        """Send a command of `on_board.commands`; its answer is one of `replies`."""
        self._send(Port.HIGH_LEVEL, 0, command)

    def stop_setpoint(self) -> None:
        """Switch the motors off until another setpoint comes."""
        self._send(Port.SETPOINT, 0, b"\0")

    def arm(self, do_arm: bool) -> None:
        if self.protocol >= 12:
            self._send(Port.SUPERVISOR, 1, bytes([1, do_arm]))
        else:
            self._send(Port.PLATFORM, 0, bytes([1, do_arm]))

    def emergency_stop(self) -> None:
        """Cut the motors at once, also in the air; the vehicle must be restarted afterwards."""
        if self.protocol >= 12:
            self._send(Port.SUPERVISOR, 1, b"\x03")
        else:
            self._send(Port.LOCALIZATION, 1, b"\x03")

    def keep_alive(self) -> None:
        """Feed the vehicle's emergency-stop watchdog; the first call starts it, and it cannot be stopped."""
        if self.protocol >= 12:
            self._send(Port.SUPERVISOR, 1, b"\x04")
        else:
            self._send(Port.LOCALIZATION, 1, b"\x04")

    def ask_motor_test(self) -> None:
        """Ask whether a motor test is on; `motor_test` is set when the answer arrives."""
        number = self._parameter_number(_MOTOR_TEST)
        if number is not None:
            self._motor_test = struct.pack("<H", number)
            self._send(Port.PARAMETERS, READ_PARAMETER, self._motor_test)

    def end_motor_test(self) -> None:
        """Switch a motor test off; it overrides controller, arming and emergency stop."""
        number = self._parameter_number(_MOTOR_TEST)
        if number is not None:
            self._send(Port.PARAMETERS, WRITE_PARAMETER, struct.pack("<HB", number, 0))

    def recreate_log(self, name: str) -> None:
        """Send the next packet that recreates the log `estimate` or `status`; call it each tick while it is silent."""
        payload = next(self._log_recreation[name])
        if payload is not None:
            self._send(Port.LOG, SETTINGS_CHANNEL, payload)

    # For the ground only: these wait for an answer.

    def _parameter_number(self, name: str) -> int | None:
        """Return the number by which packets name a parameter; None if the vehicle lacks it."""
        found = self._session.parameters.get(name)
        return None if found is None else found[0]

    def has_parameter(self, name: str) -> bool:
        return name in self._session.parameters

    def has_log_variable(self, name: str) -> bool:
        return name in self._session.log_variables

    def read_parameters(self, names: Sequence[str], patience: float = _ANSWER_TIMEOUT) -> dict[str, float]:
        """Return the present values of those parameters that the vehicle has.

        Raises LinkError if the vehicle does not answer for `patience`, s.
        """
        return {name: self._session.read_parameter(name, patience) for name in names if self.has_parameter(name)}

    def set_parameter(self, name: str, value: float, patience: float = _ANSWER_TIMEOUT) -> float:
        """Write a parameter and return it as read back. Raises LinkError if the vehicle lacks it or does not answer."""
        self._session.write_parameter(name, value, patience)
        return self._session.read_parameter(name, patience)

    def upload_trajectory(self, content: bytes) -> bytes:
        """Write the beginning of the trajectory memory, and return the same bytes as read back. Raises LinkError."""
        return self._session.write_trajectory_memory(content)

    def start_logs(self) -> None:
        """Start the logs of `estimate`, `status`, `position_variance` and `has_setpoint`; report the first two.

        Raises LinkError if the vehicle lacks one of their variables or does not start one.
        """
        self._session.reset_logs()
        for name, (variables, period_ms), note in (
            ("estimate", ESTIMATE_LOG, self._on_estimate), ("status", STATUS_LOG, self._on_status),
        ):  # fmt: skip
            self._log_recreation[name] = self._session.start_log(variables, period_ms, note).recreation()
        variables, period_ms = TARGET_LOG
        variables = variables + [each for each in TARGET_MODES if self.has_log_variable(each[0])]
        self._preflight_blocks = [
            self._session.start_log(*VARIANCE_LOG, self._on_variance),
            self._session.start_log(variables, period_ms, self._on_target),
        ]

    def stop_preflight_logs(self) -> None:
        """Stop the logs of `position_variance` and `has_setpoint`: in flight the radio is needed for other packets."""
        for block in self._preflight_blocks:
            self._send(Port.LOG, SETTINGS_CHANNEL, block.stop())

    def close(self) -> None:
        """Close the link. Only on the ground: in the air it is the only way to reach the vehicle."""
        closing = threading.Thread(target=self._session.close, daemon=True)  # a driver may wait for its thread
        closing.start()
        closing.join(timeout=_CLOSE_TIMEOUT)
        if self._radio_lock is not None:
            self._radio_lock.close()

    # Callbacks: these run in the transport's thread and must be quick.

    def _written_at(self, stamp_ms: int) -> float:
        """Return when, s, the vehicle wrote a message; after a pause of the radio, old ones arrive."""
        now = self._clock.now()
        zero = now - stamp_ms * _MILLI
        if math.isinf(self._log_zero) or abs(zero - self._log_zero - _STAMPS_WRAP) < _WRAP_TOLERANCE:
            self._log_zero = zero  # the first message, or the 24 bits wrapped; after a restart all messages seem old
        self._log_zero = min(self._log_zero + _CLOCK_DRIFT * (now - self.log_heard), zero)
        self.log_heard = now
        return self._log_zero + stamp_ms * _MILLI

    def _on_estimate(self, stamp_ms: int, data: dict[str, Any]) -> None:
        x, y, z, vx, vy, vz, ax, ay, az = (data[name] * _MILLI for name in _ESTIMATE)
        q = decompress_quaternion(np.array([data["stateEstimateZ.quat"]], dtype=np.uint32))[0]
        self.estimate = Estimate(
            time=self._written_at(stamp_ms),
            position=(x, y, z),
            velocity=(vx, vy, vz),
            acceleration=(ax, ay, az - GRAVITY),  # the log includes gravity
            quaternion=(float(q[0]), float(q[1]), float(q[2]), float(q[3])),
        )
        self._report(self.estimate)

    def _on_status(self, stamp_ms: int, data: dict[str, Any]) -> None:
        roll, pitch, yaw = (data[f"stateEstimateZ.{name}"] * _MILLI for name in ("rateRoll", "ratePitch", "rateYaw"))
        self.status = VehicleStatus(
            time=self._written_at(stamp_ms),
            body_rate=(roll, -pitch, yaw),  # the log's pitch rate is nose up
            motor=(data["motor.m1"], data["motor.m2"], data["motor.m3"], data["motor.m4"]),
            battery_voltage=data["pm.vbatMV"] * _MILLI,
            supervisor=data["supervisor.info"],
        )
        self._report(self.status)

    def _on_variance(self, _: int, data: dict[str, Any]) -> None:
        self.position_variance = data["kalman.varX"], data["kalman.varY"], data["kalman.varZ"]

    def _on_target(self, _: int, data: dict[str, Any]) -> None:
        self.has_setpoint = any(data.values())

    def _on_reply(self, _: int, payload: bytes) -> None:
        if len(payload) >= 4:
            self.replies[payload[0]] = payload[3]

    def _on_parameter(self, channel: int, payload: bytes) -> None:
        if channel == READ_PARAMETER and payload[:2] == self._motor_test and len(payload) == 4:
            self.motor_test = bool(payload[3])
