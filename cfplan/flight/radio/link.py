"""The connection to one Crazyflie: cflib does the work, with bounded waits where cflib would wait for ever.

cflib connects, fetches the tables and carries parameters and logs. What is sent in flight goes straight to the link
driver: cflib's own sending holds a lock while a dying link joins the thread that waits for it.
"""

import math
import struct
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import IO, Any

import numpy as np

from cfplan.errors import LinkError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.radio.log_block import LOG_PORT, SETTINGS_CHANNEL, LogBlock
from cfplan.flight.radio.perishable import EXTERNAL_POSE, LOCALIZATION_PORT
from cfplan.flight.radio.restart import restart_vehicle
from cfplan.flight.radio.trajectory_upload import upload
from cfplan.flight.setpoints.packets import CRTP_PORT, decompress_quaternion
from cfplan.flight.telemetry import Estimate, Telemetry, Triple, VehicleStatus
from cfplan.vehicle.airframe import GRAVITY

HIGH_LEVEL_PORT, GENERIC_PORT, SUPERVISOR_PORT, PLATFORM_PORT = 8, CRTP_PORT, 9, 13
_PARAMETER_PORT, _READ_PARAMETER, _WRITE_PARAMETER = 2, 1, 2  # a port and two of its channels
_MOTOR_TEST = "motorPowerSet.enable"

_MILLI = 1e-3
_CLOCK_DRIFT = 5e-4  # by which the vehicle's clock may differ
_STAMPS_WRAP = (1 << 24) * _MILLI  # s
_ESTIMATE = [f"stateEstimateZ.{name}" for name in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az")]
ESTIMATE_LOG = ([(name, "int16_t") for name in _ESTIMATE] + [("stateEstimateZ.quat", "uint32_t")], 10)
STATUS_LOG = (
    [(f"stateEstimateZ.{name}", "int16_t") for name in ("rateRoll", "ratePitch", "rateYaw")]
    + [(f"motor.m{motor}", "uint16_t") for motor in (1, 2, 3, 4)]
    + [("pm.vbatMV", "uint16_t"), ("supervisor.info", "uint16_t")],
    20,
)
# The setpoint in force: place, velocity and acceleration, and from firmware 2026.08 on the modes, which tell of any.
TARGET_LOG = ([(f"ctrltargetZ.{name}", "int16_t") for name in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az")], 40)
TARGET_MODES = [(f"ctrltarget.mode_{name}", "uint8_t") for name in ("x", "y", "z", "roll", "pitch", "yaw", "quat")]
VARIANCE_LOG = ([(f"kalman.var{axis}", "float") for axis in "XYZ"], 10)


class Link:
    """A connected Crazyflie, made by `connection.connect`."""

    def __init__(
        self,
        crazyflie: Any,
        uri: str,
        report: Callable[[Telemetry], None],
        clock: Clock = REAL_CLOCK,
        radio_lock: IO[str] | None = None,  # keeps other pilots from the radio until the link closes
    ):
        self._crazyflie, self.uri, self._report, self._clock = crazyflie, uri, report, clock
        self._radio_lock = radio_lock
        self.lost = ""  # why the link is gone; empty while it stands
        self.acknowledged = clock.now()  # s, when the vehicle last answered one of cflib's pings, ten a second
        self.estimate: Estimate | None = None
        self.status: VehicleStatus | None = None
        self.position_variance: Triple | None = None  # m² along x, y, z
        self.has_setpoint = False  # the controller has one, from whomever; known until `stop_preflight_logs`
        self.replies: dict[int, int] = {}  # command of the on-board commander: the code that it answered, 0 for done
        self.motor_test = False  # a motor test overrides the controller, by the last answer to `ask_motor_test`
        self._motor_test = b""  # the number of its parameter, as packets have it, once it was asked for
        self.firmware = ""
        self._preflight_blocks: list[Any] = []
        self._revivals: dict[str, Iterator[bytes | None]] = {}  # packets that create a log anew, by its name
        # s, when the vehicle's clock of ms was zero, according to the quickest messages; when the last message came
        self._log_zero, self._log_heard = math.inf, 0.0
        # The radio chip acknowledges each packet by itself; a ping is answered by the processor that flies.
        crazyflie.link_statistics.latency_updated.add_callback(lambda _: self.note_acknowledgement())
        crazyflie.add_port_callback(HIGH_LEVEL_PORT, self._on_reply)
        crazyflie.add_port_callback(PLATFORM_PORT, self._on_platform)
        crazyflie.add_port_callback(_PARAMETER_PORT, self._on_parameter)

    @property
    def protocol(self) -> int:
        return int(self._crazyflie.platform.get_protocol_version())

    @property
    def round_trip(self) -> float:
        """Return the round trip, s: 95th percentile of the last echoes; 0 before the first."""
        return float(self._crazyflie.link_statistics.latency.latency) * _MILLI

    # Sent in flight: these never wait.

    def _send(self, port: int, channel: int, data: bytes) -> None:
        self.send(packet(port, channel, data))

    def send(self, prepared: Any) -> None:
        """Send a packet made by `packet`. A link that is gone takes it silently: watch `lost`."""
        driver = self._crazyflie.link
        if driver is not None:
            driver.send_soon(prepared)

    def send_pose(self, position: Sequence[float], quaternion: Sequence[float]) -> None:
        self._send(LOCALIZATION_PORT, 1, struct.pack("<B7f", EXTERNAL_POSE, *position, *quaternion))

    def release_priority(self) -> None:
        """Give the vehicle back to its on-board commander."""
        self._send(GENERIC_PORT, 1, struct.pack("<BI", 0, 0))

    def command(self, command: bytes) -> None:
        """Send a command of `on_board.commands`; its answer is one of `replies`."""
        self._send(HIGH_LEVEL_PORT, 0, command)

    def stop_setpoint(self) -> None:
        """Switch the motors off until another setpoint comes."""
        self._send(GENERIC_PORT, 0, b"\0")

    def arm(self, do_arm: bool) -> None:
        if self.protocol >= 12:
            self._send(SUPERVISOR_PORT, 1, bytes([1, do_arm]))
        else:
            self._send(PLATFORM_PORT, 0, bytes([1, do_arm]))

    def emergency_stop(self) -> None:
        """Cut the motors at once, also in the air; the vehicle must be restarted afterwards."""
        if self.protocol >= 12:
            self._send(SUPERVISOR_PORT, 1, b"\x03")
        else:
            self._send(LOCALIZATION_PORT, 1, b"\x03")

    def keep_alive(self) -> None:
        """Feed the vehicle's emergency-stop watchdog, which the first call starts for good."""
        if self.protocol >= 12:
            self._send(SUPERVISOR_PORT, 1, b"\x04")
        else:
            self._send(LOCALIZATION_PORT, 1, b"\x04")

    def ask_motor_test(self) -> None:
        """Ask whether a motor test is on; `motor_test` is set when the answer comes."""
        number = self.parameter_number(_MOTOR_TEST)
        if number is not None:
            self._motor_test = struct.pack("<H", number)
            self._send(_PARAMETER_PORT, _READ_PARAMETER, self._motor_test)

    def end_motor_test(self) -> None:
        """Switch a motor test off: it turns the motors whatever controller, arming and emergency stop say."""
        number = self.parameter_number(_MOTOR_TEST)
        if number is not None:
            self._send(_PARAMETER_PORT, _WRITE_PARAMETER, struct.pack("<HB", number, 0))

    def revive_log(self, name: str) -> None:
        """Send the next packet that creates `estimate` or `status` anew; call it each tick while that is silent."""
        payload = next(self._revivals[name])
        if payload is not None:
            self._send(LOG_PORT, SETTINGS_CHANNEL, payload)

    # For the ground only: these wait for an answer.

    def parameter_number(self, name: str) -> int | None:
        """Return the number by which packets name a parameter; None if the vehicle lacks it."""
        element = self._crazyflie.param.toc.get_element_by_complete_name(name)
        return None if element is None else int(element.ident)

    def has_parameter(self, name: str) -> bool:
        return self.parameter_number(name) is not None

    def has_log_variable(self, name: str) -> bool:
        return self._crazyflie.log.toc.get_element_by_complete_name(name) is not None

    def read_parameters(self, names: Sequence[str], patience: float = 2.0) -> dict[str, float]:
        """Return the values of those parameters that the vehicle has, as it has them now.

        Raises LinkError if the vehicle does not answer for `patience`, s.
        """
        known = [name for name in names if self.has_parameter(name)]
        values: dict[str, float] = {}
        answered = threading.Event()

        def note(name: str, text: str) -> None:
            values[name] = float(text)
            answered.set()

        parameters = self._crazyflie.param
        for name in known:
            parameters.add_update_callback(*name.split("."), note)
        try:
            for name in known:
                parameters.request_param_update(name)
            while len(values) < len(known):
                if not self._clock.wait(answered, patience):
                    missing = next(name for name in known if name not in values)
                    raise LinkError(f"no answer to reading {missing}", where=self.uri, hint="check the radio link")
                answered.clear()
        finally:
            for name in known:
                parameters.remove_update_callback(*name.split("."), note)
        return values

    def set_parameter(self, name: str, value: float, patience: float = 2.0) -> float:
        """Write a parameter and return it as read back. Raises LinkError if the vehicle lacks it or does not answer."""
        group, _, short = name.partition(".")
        values: list[float] = []
        answered = threading.Event()

        def note(_: str, text: str) -> None:
            values.append(float(text))
            if len(values) == 2:  # the first answers the writing, the second the reading
                answered.set()

        self._crazyflie.param.add_update_callback(group, short, note)
        try:
            self._crazyflie.param.set_value(name, value)
            self._crazyflie.param.request_param_update(name)
            if not self._clock.wait(answered, patience):
                raise LinkError(f"no answer to setting {name}", where=self.uri, hint="check the radio link")
        except (KeyError, AttributeError) as error:
            raise LinkError(
                f"the vehicle has no parameter {name} that can be set", where=self.uri, hint="update its firmware"
            ) from error
        finally:
            self._crazyflie.param.remove_update_callback(group, short, note)
        return values[-1]

    def upload_trajectory(self, content: bytes) -> bytes:
        """Write the beginning of the trajectory memory, and return what it holds there. Raises as upload()."""
        return upload(self._crazyflie, content, self.uri, self._clock)

    def start_logs(self) -> None:
        """Start the logs of `estimate`, `status`, `position_variance` and `has_setpoint`; report the first two."""
        self._log("estimate", ESTIMATE_LOG, self._on_estimate)
        self._log("status", STATUS_LOG, self._on_status)
        variables, period_ms = TARGET_LOG
        variables = variables + [each for each in TARGET_MODES if self.has_log_variable(each[0])]
        self._preflight_blocks = [
            self._log("variance", VARIANCE_LOG, self._on_variance),
            self._log("target", (variables, period_ms), self._on_target),
        ]

    def stop_preflight_logs(self) -> None:
        """Stop the logs of `position_variance` and `has_setpoint`: in flight the radio has better to do."""
        for block in self._preflight_blocks:
            block.stop()

    def _log(self, name: str, variables: tuple[list[tuple[str, str]], int], note: Callable[..., None]) -> Any:
        from cflib.crazyflie.log import LogConfig

        names, period_ms = variables
        block = LogConfig(name, period_ms)
        for variable, kind in names:
            block.add_variable(variable, kind)
        block.data_received_cb.add_callback(note)
        try:
            self._crazyflie.log.add_config(block)
        except KeyError as error:
            raise LinkError(f"{error.args[0]}", where=self.uri, hint="update the vehicle's firmware") from error
        block.start()
        table = self._crazyflie.log.toc
        numbered = tuple((kind, int(table.get_element_id(variable))) for variable, kind in names)
        self._revivals[name] = LogBlock(block.id, period_ms, numbered).revival()
        return block

    def ask_firmware(self) -> None:
        """Ask for the firmware's version; `firmware` is set when the answer comes."""
        self._send(PLATFORM_PORT, 1, b"\x01")

    def close(self) -> None:
        """Close the link. On the ground only: it sends a zero setpoint, which stops the motors."""
        closing = threading.Thread(target=self._crazyflie.close_link, daemon=True)
        closing.start()
        closing.join(timeout=2.0)
        if self._radio_lock is not None:
            self._radio_lock.close()

    def restart(self) -> None:
        """Restart the vehicle's main processor, after `close`; takes 2 s. Raises LinkError if it does not confirm."""
        restart_vehicle(self.uri, self._clock)

    def note_acknowledgement(self) -> None:
        """Remember that the vehicle has just acknowledged a packet; a callback of cflib."""
        self.acknowledged = self._clock.now()

    def note_loss(self, _: str, reason: str = "the link was closed") -> None:
        """Remember why the link is gone; a callback of cflib."""
        self.lost = self.lost or reason

    # Callbacks: these run in cflib's thread and must be quick.

    def _when(self, stamp_ms: int) -> float:
        """Return when, s, the vehicle wrote a message: after a pause of the radio, old ones arrive."""
        now = self._clock.now()
        zero = now - stamp_ms * _MILLI
        if abs(zero - self._log_zero) > _STAMPS_WRAP / 2:  # the first, or the vehicle's 24 bits began anew
            self._log_zero = zero
        self._log_zero = min(self._log_zero + _CLOCK_DRIFT * (now - self._log_heard), zero)
        self._log_heard = now
        return self._log_zero + stamp_ms * _MILLI

    def _on_estimate(self, stamp_ms: int, data: dict[str, int], _: Any) -> None:
        x, y, z, vx, vy, vz, ax, ay, az = (data[name] * _MILLI for name in _ESTIMATE)
        q = decompress_quaternion(np.array([data["stateEstimateZ.quat"]], dtype=np.uint32))[0]
        self.estimate = Estimate(
            time=self._when(stamp_ms),
            position=(x, y, z),
            velocity=(vx, vy, vz),
            acceleration=(ax, ay, az - GRAVITY),  # the log counts gravity in
            quaternion=(float(q[0]), float(q[1]), float(q[2]), float(q[3])),
        )
        self._report(self.estimate)

    def _on_status(self, stamp_ms: int, data: dict[str, int], _: Any) -> None:
        roll, pitch, yaw = (data[f"stateEstimateZ.{name}"] * _MILLI for name in ("rateRoll", "ratePitch", "rateYaw"))
        self.status = VehicleStatus(
            time=self._when(stamp_ms),
            body_rate=(roll, -pitch, yaw),  # the log's pitch rate is nose up
            motor=(data["motor.m1"], data["motor.m2"], data["motor.m3"], data["motor.m4"]),
            battery_voltage=data["pm.vbatMV"] * _MILLI,
            supervisor=data["supervisor.info"],
        )
        self._report(self.status)

    def _on_variance(self, _: int, data: dict[str, float], __: Any) -> None:
        self.position_variance = data["kalman.varX"], data["kalman.varY"], data["kalman.varZ"]

    def _on_target(self, _: int, data: dict[str, int], __: Any) -> None:
        self.has_setpoint = any(data.values())

    def _on_reply(self, packet: Any) -> None:
        if len(packet.data) >= 4:
            self.replies[packet.data[0]] = packet.data[3]

    def _on_parameter(self, packet: Any) -> None:
        if packet.channel == _READ_PARAMETER and packet.data[:2] == self._motor_test and len(packet.data) == 4:
            self.motor_test = bool(packet.data[3])

    def _on_platform(self, packet: Any) -> None:
        if packet.channel == 1 and len(packet.data) > 1 and packet.data[0] == 1:
            self.firmware = bytes(packet.data[1:]).split(b"\0")[0].decode("ascii", "replace")


def packet(port: int, channel: int, data: bytes) -> Any:
    """Return a CRTP packet for `Link.send`."""
    from cflib.crtp.crtpstack import CRTPPacket

    made = CRTPPacket()
    made.set_header(port, channel)
    made.data = bytearray(data)
    return made
