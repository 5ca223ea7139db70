"""The firmware's commander: select the setpoint to fly, by priority."""

from collections.abc import Callable
from enum import IntEnum

from cfplan.simulation.virtual_crazyflie.setpoints import Setpoint


class Priority(IntEnum):
    """A higher priority overrules a lower one; it never falls by itself."""

    DISABLE = 0
    HIGH_LEVEL = 1
    RADIO = 2


class Commander:
    """Keeps the latest setpoint of the highest priority so far."""

    def __init__(self, stop_planner: Callable[[], None]):
        self.setpoint = Setpoint()
        self.priority = Priority.DISABLE
        self._stop_planner = stop_planner

    def offer(self, setpoint: Setpoint, priority: Priority, tick: int) -> bool:
        """Take the setpoint unless a higher priority holds, and return if so; one from the radio stops the planner."""
        if priority < self.priority:
            return False
        setpoint.tick = tick
        self.setpoint, self.priority = setpoint, priority
        if priority > Priority.HIGH_LEVEL:
            self._stop_planner()
        return True

    def relax(self) -> None:
        """Let the on-board planner's setpoints count again, as notify_setpoint_stop does."""
        self.priority = Priority.HIGH_LEVEL
