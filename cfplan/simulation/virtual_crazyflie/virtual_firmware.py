"""cfplan's own model of the firmware: from packets and measurements to packets and motor commands."""

from collections.abc import Callable, Mapping, Set
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.firmware import GAIN_PARAMETERS, YAW_CORRECT, Timeouts
from cfplan.flight.radio.crtp import LARGEST_PAYLOAD, Port, pack
from cfplan.simulation.virtual_crazyflie.catalogue import lacking
from cfplan.simulation.virtual_crazyflie.collision_avoidance import CollisionAvoidance
from cfplan.simulation.virtual_crazyflie.commander import Commander, Priority
from cfplan.simulation.virtual_crazyflie.defaults import (
    COMPLEMENTARY,
    DEFAULTS,
    KALMAN,
    MELLINGER,
    PID,
    PID_GAIN_PARAMETERS,
    PID_LIMIT_PARAMETERS,
    PID_SPEED_PARAMETERS,
    PRIOR_PARAMETERS,
)
from cfplan.simulation.virtual_crazyflie.faults import SILENCED, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.high_level import Goal, HighLevelCommander, PlannerState
from cfplan.simulation.virtual_crazyflie.localization import Localization
from cfplan.simulation.virtual_crazyflie.log_blocks import DATA_CHANNEL, LogBlocks, log_toc
from cfplan.simulation.virtual_crazyflie.log_variables import log_variables
from cfplan.simulation.virtual_crazyflie.parameters import Parameters, parameter_toc
from cfplan.simulation.virtual_crazyflie.services import Memories, answer_link, answer_platform
from cfplan.simulation.virtual_crazyflie.setpoints import AttitudeSetpoints, FirmwareAssert, Setpoint, decode_setpoint
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.stabilizer import Stabilizer
from cfplan.simulation.virtual_crazyflie.supervisor import PERIOD as SUPERVISOR_PERIOD
from cfplan.simulation.virtual_crazyflie.supervisor import State, Supervisor
from cfplan.simulation.virtual_crazyflie.toc import Toc
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.rotations import yaw_of

COMMANDER_PERIOD = 10  # ticks of 1 ms between runs of planner and log blocks
_BOOT = 2000  # ms from a restart until it answers
_CONNECTION_LASTS = round(1000 * Timeouts().connection)  # ms

_SETPOINT_CHANNEL, _META_CHANNEL = 0, 1
_NOTIFY_SETPOINT_STOP = 0
_SUPERVISOR_INFO, _SUPERVISOR_COMMAND = 0, 1
_ARM, _RECOVER, _EMERGENCY_STOP, _KEEP_ALIVE, _BITFIELD = 1, 2, 3, 4, 12
_RESPONSE = 0x80
_LEGACY_ARM, _LEGACY_RECOVER = 1, 2  # platform commands
_NO_POSES = np.zeros((0, 9))
_MOTORS_OFF = Setpoint()

_SUPERVISOR_SINCE = 12  # protocol with which the port came
_DECKS_SUPERVISED_SINCE = (2026, 8)  # firmware


def tables(settings: VehicleSettings) -> Mapping[Port, Toc]:
    """Return the tables of a firmware of that version."""
    without = lacking(settings.version)
    return {Port.LOG: log_toc(without), Port.PARAMETERS: parameter_toc(without)}


class VirtualFirmware:
    """The firmware of a vehicle of this airframe, switched on when it is made; see `firmware.Firmware`."""

    def __init__(self, airframe: Airframe, settings: VehicleSettings | None = None):
        self.settings = settings or VehicleSettings()
        self._airframe = airframe
        self._boot(0)

    def _boot(self, answers_from: int) -> None:
        """Start the processor: everything is as after power-on, and it answers from a tick on."""
        airframe, without = self._airframe, lacking(self.settings.version)
        self._tick = 0  # ms since power on
        self._answers_from = answers_from
        self._heard = 0  # tick of the last packet
        self._voltage = 0.0  # V of the battery, as measured last
        self._silent: tuple[str, ...] = ()  # variables whose log blocks are not sent
        self.parameters = Parameters(DEFAULTS, without=without, stubborn=self.settings.stubborn)
        self.stabilizer = Stabilizer(
            prior=np.array([0.0 if name in without else self.parameters[name] for name in PRIOR_PARAMETERS]),
            gains=np.array([self.parameters[name] for name in GAIN_PARAMETERS]),
        )
        wanted = self.settings.auto_arming
        auto_arming = "brushless" not in airframe.name if wanted is None else wanted
        self.supervisor = Supervisor(auto_arming=auto_arming, say=self.say)
        self.memories = Memories()
        self.planner = HighLevelCommander(self.memories.trajectory, self._where)
        self.commander = Commander(self.planner.stop)
        self.localization = Localization()
        self.setpoint = Setpoint()  # what the controller is given
        self._attitude_setpoints = AttitudeSetpoints()
        self._out: list[bytes] = []
        # to writes of parameters, each with the earliest tick at which it may leave
        self._answers: list[tuple[int, bytes]] = []
        self.log = LogBlocks(self.log_variables(), without=without)
        self._avoidance = CollisionAvoidance()
        self._watch_parameters()
        self.parameters.restore(self.settings.stored)

    def log_variables(self) -> Mapping[str, Callable[[], float]]:
        """Return a function for each log variable that has a value."""
        return log_variables(
            self.stabilizer.loop,
            localization=self.localization,
            supervisor=self.supervisor,
            voltage=lambda: self._voltage,
            airframe=self._airframe,
            setpoint=lambda: self.setpoint,
            info=self.info,
        )

    @property
    def supervisor_state(self) -> State:
        return self.supervisor.state

    def restart(self) -> None:
        self._boot(_BOOT)

    def fail(self, faults: Set[VehicleFaultKind]) -> None:
        self._silent = tuple(SILENCED[kind] for kind in faults if kind in SILENCED)
        self.supervisor.deck_fault = (
            VehicleFaultKind.DECK in faults and self.settings.version >= _DECKS_SUPERVISED_SINCE
        )
        if VehicleFaultKind.LOCK in faults and not self.supervisor.locked:
            self.supervisor.lock()

    def sent(self) -> list[bytes]:
        packets, self._out = self._out, []
        return packets

    def say(self, text: str) -> None:
        """Print a line on the console."""
        line = text.encode() + b"\n"
        for start in range(0, len(line), LARGEST_PAYLOAD):
            self._send(Port.CONSOLE, 0, line[start : start + LARGEST_PAYLOAD])

    def tick(
        self, gyroscope: NDArray, accelerometer: NDArray, without_vibration: NDArray, voltage: float
    ) -> NDArray | None:
        self._voltage = voltage
        self.stabilizer.loop.acceleration[:] = without_vibration
        if self._tick % COMMANDER_PERIOD == 0:
            self._command()
        supervisor = self.supervisor
        allowed = supervisor.motors_allowed
        self.setpoint = self.commander.setpoint if allowed else _MOTORS_OFF
        if self._avoidance.enable:
            self.setpoint = self._avoidance.rewrite(self.setpoint, self.stabilizer.loop.belief[0:3])
        self.stabilizer.set(self.setpoint, allowed=allowed, level=supervisor.levels_out, flying=supervisor.is_flying)
        poses = self._poses() if self.localization.waits else _NO_POSES
        commands = self.stabilizer.run(self._tick, gyroscope, accelerometer, poses)
        self._tick += 1
        return commands

    def receive(self, packet: bytes) -> None:
        if not packet or self._tick < self._answers_from:
            return
        self._heard = self._tick
        port, channel, payload = packet[0] >> 4, packet[0] & 3, packet[1 : 1 + LARGEST_PAYLOAD]
        answer: bytes | None = None
        if port == Port.LINK:
            answer = answer_link(channel, payload)
        elif port == Port.PLATFORM:
            answer = self._platform(channel, payload)
        elif port == Port.LOG:
            answer = self.log.receive(channel, payload, self._tick)
        elif port == Port.PARAMETERS:
            answer = self.parameters.receive(channel, payload)
            if answer is not None and self.settings.parameter_delay:
                self._answers.append(
                    (self._tick + round(1000 * self.settings.parameter_delay), bytes((channel,)) + answer)
                )
                answer = None
        elif port == Port.MEMORY:
            answer = self.memories.receive(channel, payload)
        elif port == Port.HIGH_LEVEL:
            answer = self.planner.receive(payload, self._tick / 1000, blocked=not self.supervisor.can_fly)
        elif port == Port.SUPERVISOR:
            answer = self._supervise(channel, payload)
        elif port == Port.LOCALIZATION:
            self._localize(channel, payload)
        elif port in (Port.SETPOINT, Port.ATTITUDE_SETPOINT):
            self._take_setpoint(Port(port), channel, payload)
        if answer is not None:
            self._send(Port(port), channel, answer)

    def info(self) -> int:
        """Return the bits of supervisor.info."""
        return self.supervisor.info(
            planner_active=self.planner.state in (PlannerState.FLYING, PlannerState.LANDING),
            planner_finished=self.planner.finished(self._tick / 1000),
            planner_disabled=self.planner.state is PlannerState.DISABLED,
        )

    def _send(self, port: Port, channel: int, payload: bytes) -> None:
        if self._tick >= self._answers_from:
            self._out.append(pack(port, channel, payload))

    def _command(self) -> None:
        """Run the slower loops: planner and log blocks at 100 Hz, supervisor at 25 Hz."""
        loop, tick = self.stabilizer.loop, self._tick
        can_fly = self.supervisor.can_fly
        if can_fly:
            wanted = self.planner.setpoint(tick / 1000)
            if wanted is not None:
                self.commander.offer(wanted, Priority.HIGH_LEVEL, tick)
        if tick % SUPERVISOR_PERIOD == 0:
            self.supervisor.update(
                tick, self.commander.setpoint.tick if can_fly else 0, loop.acceleration / GRAVITY, loop.motors
            )
        while self._answers and self._answers[0][0] <= tick:
            _, answer = self._answers.pop(0)
            self._send(Port.PARAMETERS, answer[0], answer[1:])
        if tick - self._heard > _CONNECTION_LASTS:
            self.log.clear()
        for payload in self.log.due(tick, self._silent):
            self._send(Port.LOG, DATA_CHANNEL, payload)

    def _poses(self) -> NDArray:
        """Return the measurements (n, 9) that have come, for the filter."""
        poses = self.localization.take(self.parameters["locSrv.extPosStdDev"], self.parameters["locSrv.extQuatStdDev"])
        if self.settings.version < YAW_CORRECT:
            _reproduce_residual_error(poses, self.stabilizer.loop.belief[6:10])
        return poses if self.parameters["stabilizer.estimator"] == KALMAN else _NO_POSES

    def _where(self) -> Goal:
        belief = self.stabilizer.loop.belief
        still = np.zeros(4)
        return Goal(np.append(belief[0:3], yaw_of(belief[6:10])), np.append(belief[3:6], 0.0), still, still)

    def _take_setpoint(self, port: Port, channel: int, payload: bytes) -> None:
        setpoint: Setpoint | None = None
        try:
            if port is Port.ATTITUDE_SETPOINT and channel == _SETPOINT_CHANNEL:
                first = self.commander.priority is Priority.DISABLE
                setpoint = self._attitude_setpoints.decode(payload, first=first)
            elif port is Port.SETPOINT and payload and channel == _SETPOINT_CHANNEL:
                setpoint = decode_setpoint(payload)
            elif port is Port.SETPOINT and payload and channel == _META_CHANNEL:
                self._meta(payload)
        except FirmwareAssert as why:
            self.say(f"Assert failed: {why}")
            self.supervisor.lock()
        if setpoint is not None:
            self.commander.offer(setpoint, Priority.RADIO, self._tick)

    def _meta(self, payload: bytes) -> None:
        if payload[0] != _NOTIFY_SETPOINT_STOP:
            return
        if len(payload) != 5:
            raise FirmwareAssert(f"notify setpoint stop with {len(payload) - 1} bytes")
        self.commander.relax()

    def _localize(self, channel: int, payload: bytes) -> None:
        self.localization.receive(channel, payload, self._tick)
        if self.localization.emergency_stop:
            self.supervisor.emergency_stop()
        if self.localization.kept_alive:
            self.localization.kept_alive = False
            self.supervisor.keep_alive(self._tick)

    def _platform(self, channel: int, payload: bytes) -> bytes | None:
        if channel == 0 and payload[:1] == bytes((_LEGACY_ARM,)) and len(payload) >= 2:
            done = self.supervisor.request_arming(bool(payload[1]))
            return bytes((_LEGACY_ARM, done, self.supervisor.armed))
        if channel == 0 and payload[:1] == bytes((_LEGACY_RECOVER,)):
            done = self.supervisor.request_recovery()
            return bytes((_LEGACY_RECOVER, done, not self.supervisor.crashed))
        return answer_platform(channel, payload, protocol=self.settings.protocol, firmware=self.settings.firmware)

    def _supervise(self, channel: int, payload: bytes) -> bytes | None:
        if not payload or self.settings.protocol < _SUPERVISOR_SINCE:
            return None
        command = payload[0]
        head = bytes((command | _RESPONSE,))
        if channel == _SUPERVISOR_INFO:
            bits = self.info()
            if command == _BITFIELD:
                return head + bits.to_bytes(2, "little")
            return head + bytes((bits >> (command - 1) & 1,)) if 1 <= command < _BITFIELD else None
        if channel != _SUPERVISOR_COMMAND:
            return None
        if command == _ARM and len(payload) >= 2:
            done = self.supervisor.request_arming(bool(payload[1]))
            return head + bytes((done, self.supervisor.armed))
        if command == _RECOVER:
            done = self.supervisor.request_recovery()
            return head + bytes((done, not self.supervisor.crashed))
        if command == _EMERGENCY_STOP:
            self.supervisor.emergency_stop()
        elif command == _KEEP_ALIVE:
            self.supervisor.keep_alive(self._tick)
        return None

    def _watch_parameters(self) -> None:
        def fill(array: NDArray, place: int):
            return lambda value: array.__setitem__(place, value)

        watch = self.parameters.watch
        for place, name in enumerate(GAIN_PARAMETERS):
            watch(name, fill(self.stabilizer.loop.gains, place))
        for place, name in enumerate(PRIOR_PARAMETERS):
            watch(name, fill(self.stabilizer.loop.prior, place))
        for loop, names in enumerate(PID_GAIN_PARAMETERS):
            for place, name in enumerate(names):
                watch(name, fill(self.stabilizer.loop.pid_gains[loop], place))
        for place, name in enumerate(PID_LIMIT_PARAMETERS):
            watch(name, fill(self.stabilizer.loop.pid_limits, place))
        for place, name in enumerate(PID_SPEED_PARAMETERS):
            watch(name, partial(self.stabilizer.limit_speed, place))
        supervised = self.supervisor.settings
        watch("supervisor.tmblChckEn", lambda value: setattr(supervised, "tumble_check", bool(value)))
        watch("supervisor.prefltTimeout", lambda value: setattr(supervised, "preflight_timeout", int(value)))
        watch("supervisor.landedTimeout", lambda value: setattr(supervised, "landed_timeout", int(value)))
        watch("supervisor.crashDetectGs", lambda value: setattr(supervised, "crash_detection", value))
        for place, name in enumerate(("enable", "m1", "m2", "m3", "m4")):
            watch(f"motorPowerSet.{name}", fill(self.stabilizer.loop.override, place))
        watch("powerDist.idleThrust", self._set_idle_thrust)
        avoided = self._avoidance
        watch("colAv.enable", lambda value: setattr(avoided, "enable", bool(value)))
        watch("colAv.horizon", lambda value: setattr(avoided, "horizon", value))
        watch("colAv.maxSpeed", lambda value: setattr(avoided, "max_speed", value))
        watch("colAv.sidestepThrsh", lambda value: setattr(avoided, "sidestep", value))
        watch("colAv.vorTol", lambda value: setattr(avoided, "tolerance", value))
        for place, axis in enumerate("XYZ"):
            watch(f"colAv.bboxMin{axis}", fill(avoided.low, place))
            watch(f"colAv.bboxMax{axis}", fill(avoided.high, place))
        watch("stabilizer.stop", lambda value: setattr(supervised, "stop", bool(value)))
        watch("stabilizer.controller", self._choose_controller)
        watch("stabilizer.estimator", self._choose_estimator)
        watch("kalman.resetEstimation", self._reset_estimation)

    def _set_idle_thrust(self, value: float) -> None:
        """Set what no motor falls below; the firmware ignores it in vehicles that arm themselves."""
        idle = 0.0 if self.supervisor.auto_arming else value
        self.stabilizer.loop.idle[0] = self.supervisor.settings.idle_thrust = idle

    def _choose_controller(self, value: float) -> None:
        if value not in (PID, MELLINGER):
            self.parameters["stabilizer.controller"] = PID
            if value != 0:
                self.say(f"Controller {value:.0f} is not simulated, PID flies")
        self.stabilizer.mellinger = value == MELLINGER
        self.stabilizer.reset_controller()

    def _choose_estimator(self, value: float) -> None:
        if value not in (COMPLEMENTARY, KALMAN):
            self.parameters["stabilizer.estimator"] = COMPLEMENTARY
        self.stabilizer.reset_estimator()

    def _reset_estimation(self, value: float) -> None:
        if value:
            self.stabilizer.reset_estimator()
            self.parameters["kalman.resetEstimation"] = 0


def _reproduce_residual_error(poses: NDArray, belief: NDArray) -> None:
    """Change measured quaternions so that their residual in body axes is the correct one in world axes.

    This was the filter's error before 2025.09.1 (crazyflie-firmware #1292): with yaw beyond 90° it corrected roll and
    pitch the wrong way.
    """
    from scipy.spatial.transform import Rotation  # slow to import, and few vehicles need it

    if not 0.0 < np.linalg.norm(belief) < np.inf:  # the filter has diverged
        return
    believed = Rotation.from_quat(belief)
    for row in poses:
        if 0.0 < np.linalg.norm(row[3:7]) < np.inf:
            measured = Rotation.from_quat(row[3:7])
            row[3:7] = (believed * measured * believed.inv()).as_quat()
