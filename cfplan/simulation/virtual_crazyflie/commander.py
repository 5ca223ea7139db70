"""Whose setpoint counts: the priorities of the firmware's commander."""

from collections.abc import Callable
from enum import IntEnum

from cfplan.simulation.virtual_crazyflie.setpoints import Setpoint


class Priority(IntEnum):
    """Who may be overruled by whom; it never sinks by itself."""

    DISABLE = 0
    HIGH_LEVEL = 1
    RADIO = 2


class Commander:
    """Keeps the latest setpoint of the highest priority yet seen."""

    def __init__(self, stop_planner: Callable[[], None]):
        self.setpoint = Setpoint()
        self.priority = Priority.DISABLE
        self._stop_planner = stop_planner

    def offer(self, setpoint: Setpoint, priority: Priority, tick: int) -> bool:
        """Take the setpoint unless a higher priority holds; one from the radio stops the on-board planner."""
        if priority < self.priority:
            return False
        setpoint.tick = tick
        self.setpoint, self.priority = setpoint, priority
        if priority > Priority.HIGH_LEVEL:
            self._stop_planner()
        return True

    def relax(self) -> None:
        """What notify_setpoint_stop does: the on-board planner may speak again."""
        self.priority = Priority.HIGH_LEVEL
