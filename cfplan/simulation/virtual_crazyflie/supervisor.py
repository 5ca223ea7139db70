"""The supervisor: when the motors may turn, and what happens when setpoints stop or the vehicle tumbles.

Twelve states, updated 25 times a second, with the firmware's order of transitions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class State(IntEnum):
    """The states of the firmware's supervisor."""

    NOT_INITIALIZED = 0
    CHECKS_NOT_PASSED = 1
    CHECKS_PASSED = 2
    ARMING = 3
    READY_TO_FLY = 4
    FLYING = 5
    LANDED = 6
    RESET = 7
    WARNING_LEVEL_OUT = 8
    FREE_FALL = 9
    LOCKED = 10
    CRASHED = 11


# Tuples: an enum's hash runs as Python, and these are looked up a thousand times a second.
_MAY_FLY = (State.READY_TO_FLY, State.FLYING, State.WARNING_LEVEL_OUT, State.LANDED)
_STAYS_ARMED = (*_MAY_FLY, State.ARMING)

PERIOD = 40  # ms
LEVEL_OUT_AFTER, SHUT_DOWN_AFTER = 500, 2000  # ms without a setpoint
_FLYING_HYSTERESIS = 2000  # ms without more than idle thrust
_KEEP_ALIVE_TIMEOUT = 1000  # ms between keep-alive packets, after the first one
_TILTED, _TILTED_FOR = 0.5, 1000  # g along the body's z axis, ms
_UPSIDE_DOWN, _UPSIDE_DOWN_FOR = -0.2, 100
_WEIGHTLESS = 0.1  # g


@dataclass(slots=True)
class Settings:
    """Parameters of the groups supervisor and stabilizer."""

    tumble_check: bool = True
    preflight_timeout: int = 30000  # ms armed without a flight
    landed_timeout: int = 3000  # ms
    crash_detection: float = 0.0  # g beyond 1; 0 is off
    stop: bool = False  # emergency stop
    idle_thrust: float = 0.0  # 16-bit units, of the power distribution


@dataclass(frozen=True, slots=True)
class _Conditions:
    armed: bool
    flying: bool
    tumbled: bool
    warning: bool
    timeout: bool
    emergency: bool
    preflight_over: bool
    landing_over: bool


class Supervisor:
    """The firmware's supervisor; `say` prints a line on the console."""

    def __init__(self, *, auto_arming: bool, say: Callable[[str], None]):
        self.state = State.NOT_INITIALIZED
        self.settings = Settings()
        self.auto_arming = auto_arming
        self.armed = False
        self.crashed = False
        self.tumbled = False
        self.deck_fault = False  # of a deck that tests itself
        self.ever_locked = False
        self._say = say
        self._emergency = False
        self._keep_alive: int | None = None
        self._thrust_tick: int | None = None
        self._tilted_since: int | None = None
        self._armed_tick = 0
        self._landed_tick: int | None = None

    @property
    def can_fly(self) -> bool:
        return self.state in _MAY_FLY

    @property
    def motors_allowed(self) -> bool:
        return self.state in _STAYS_ARMED

    @property
    def levels_out(self) -> bool:
        return self.state is State.WARNING_LEVEL_OUT

    @property
    def is_flying(self) -> bool:
        return self.state in (State.FLYING, State.WARNING_LEVEL_OUT)

    @property
    def locked(self) -> bool:
        return self.state is State.LOCKED

    def request_arming(self, arm: bool) -> bool:
        """Arm or disarm; disarming in flight cuts the motors. Return False if arming is not possible now."""
        if arm != self.armed:
            if arm and self.state is not State.CHECKS_PASSED:
                return False
            self.armed = arm
        return True

    def request_recovery(self) -> bool:
        """Recover after a crash; return False if the vehicle is not upright."""
        if self.crashed and self.tumbled:
            return False
        self.crashed = False
        return True

    def emergency_stop(self) -> None:
        """Stop the motors for good: only a restart helps."""
        self._emergency = True

    def keep_alive(self, tick: int) -> None:
        """Feed the emergency-stop watchdog; after the first call, calls must not stop."""
        self._keep_alive = tick

    def lock(self) -> None:
        """Lock, as an assertion in the firmware does."""
        self._enter(State.LOCKED, 0)

    def update(self, tick: int, setpoint_tick: int, acceleration: NDArray, motors: NDArray) -> None:
        """Update the state: `acceleration` (3,) g in body axes as measured, `motors` (4,) the commands of now."""
        conditions = self._conditions(tick, setpoint_tick, acceleration, motors)
        self.tumbled = conditions.tumbled
        state = self._next(conditions)
        if state is not self.state:
            self._enter(state, tick)

    def _conditions(self, tick: int, setpoint_tick: int, acceleration: NDArray, motors: NDArray) -> _Conditions:
        if any(motor > self.settings.idle_thrust for motor in motors.tolist()):
            self._thrust_tick = tick
        age = tick - setpoint_tick
        starved = self._keep_alive is not None and tick >= self._keep_alive + _KEEP_ALIVE_TIMEOUT
        return _Conditions(
            armed=self.armed,
            flying=self._thrust_tick is not None and tick - self._thrust_tick < _FLYING_HYSTERESIS,
            tumbled=self._is_tumbled(tick, acceleration) and self.settings.tumble_check,
            warning=age > LEVEL_OUT_AFTER,
            timeout=age > SHUT_DOWN_AFTER,
            emergency=self._emergency or starved or self.settings.stop,
            preflight_over=tick - self._armed_tick > self.settings.preflight_timeout,
            landing_over=self._landed_tick is not None and tick - self._landed_tick > self.settings.landed_timeout,
        )

    def _is_tumbled(self, tick: int, acceleration: NDArray) -> bool:
        limit = self.settings.crash_detection
        if limit > 0 and abs(np.sqrt(acceleration @ acceleration) - 1.0) > limit:
            return True
        if all(abs(along) < _WEIGHTLESS for along in acceleration.tolist()):
            self._tilted_since = None
        if acceleration[2] >= _TILTED:
            self._tilted_since = None
            return False
        if self._tilted_since is None:
            self._tilted_since = tick
        lasted = tick - self._tilted_since
        return lasted > _TILTED_FOR or (acceleration[2] < _UPSIDE_DOWN and lasted > _UPSIDE_DOWN_FOR)

    def _next(self, now: _Conditions) -> State:
        state = self.state
        if state is State.NOT_INITIALIZED or state is State.RESET:
            return State.CHECKS_NOT_PASSED
        if state is State.FREE_FALL:
            return State.LOCKED
        if state is State.CRASHED:
            if not self.crashed and not now.tumbled:
                return State.CHECKS_NOT_PASSED
            return State.LOCKED if now.emergency else state
        if state is State.LANDED:
            if now.landing_over or not now.armed:
                return State.RESET
            return State.FLYING if now.flying else state
        if state is State.WARNING_LEVEL_OUT:
            if now.timeout or now.tumbled or now.emergency or self.deck_fault:
                return State.FREE_FALL
            return state if now.warning else State.FLYING
        if state is State.LOCKED:
            return state
        if now.emergency:
            return State.FREE_FALL
        return self._in_flight(now) if state is State.FLYING else self._on_ground(now)

    def _in_flight(self, now: _Conditions) -> State:
        if now.timeout or self.deck_fault:
            return State.FREE_FALL
        if now.tumbled:
            return State.CRASHED
        if not now.armed:
            return State.RESET
        if now.warning:
            return State.WARNING_LEVEL_OUT
        return State.FLYING if now.flying else State.LANDED

    def _on_ground(self, now: _Conditions) -> State:
        if self.state is State.CHECKS_NOT_PASSED:
            return self.state if now.tumbled or self.deck_fault else State.CHECKS_PASSED
        if now.tumbled or (self.deck_fault and self.state is not State.ARMING):
            return State.CHECKS_NOT_PASSED
        if self.state is State.CHECKS_PASSED:
            return State.ARMING if now.armed else self.state
        if not now.armed:
            return State.CHECKS_NOT_PASSED
        if self.state is State.ARMING:
            return State.READY_TO_FLY
        if now.preflight_over:
            return State.CHECKS_NOT_PASSED
        return State.FLYING if now.flying else self.state

    def _enter(self, state: State, tick: int) -> None:
        self.state = state
        if state is State.READY_TO_FLY:
            self._armed_tick = tick
        elif state is State.LANDED:
            self._landed_tick = tick
        elif state is State.FREE_FALL:
            self._say("SUP: free falling!")
        elif state is State.LOCKED:
            self.ever_locked = True
            self._say("SUP: Locked, reboot required")
        elif state is State.CRASHED:
            self.crashed = True
            self._say("SUP: Crashed, recovery required")
        if state not in _STAYS_ARMED:
            self.armed = False
        if self.auto_arming and state is State.CHECKS_PASSED:
            self.armed = True

    def info(self, *, planner_active: bool, planner_finished: bool, planner_disabled: bool) -> int:
        """Return the bits of supervisor.info."""
        return (
            (self.state is State.CHECKS_PASSED)
            | self.armed << 1
            | self.auto_arming << 2
            | self.can_fly << 3
            | self.is_flying << 4
            | bool(self.tumbled) << 5
            | self.locked << 6
            | self.crashed << 7
            | planner_active << 8
            | planner_finished << 9
            | planner_disabled << 10
            | self.deck_fault << 11
        )
