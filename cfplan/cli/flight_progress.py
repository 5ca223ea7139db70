"""The flight on the terminal while it goes on: a line a phase, and a bar along the path."""

import contextlib
import math
from types import TracebackType

from cfplan.cli.output import Steps
from cfplan.errors import printable
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.telemetry import (
    Event,
    Level,
    Phase,
    PhaseEntered,
    PoseReceived,
    SetpointSent,
    Telemetry,
    VehicleStatus,
)

_REFRESH = 0.1  # s


class FlightProgress:
    """Shows telemetry. On a terminal the bar moves; elsewhere only lines are printed."""

    def __init__(self, *, duration: float, steps: Steps, clock: Clock = REAL_CLOCK):
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        self._quiet = steps.as_json
        console = Console(stderr=True, quiet=self._quiet)
        self._bar = Progress(
            TextColumn("  {task.description:<12}"),
            BarColumn(),
            TextColumn("{task.fields[numbers]}"),
            TimeRemainingColumn(compact=True),
            console=console,
            disable=self._quiet or not console.is_terminal,
            transient=True,
        )
        self._task = self._bar.add_task("", total=duration, numbers="")
        self._console = console
        self._setpoint: SetpointSent | None = None
        self._first_index_time = 0.0
        self._pose: PoseReceived | None = None
        self._battery = 0.0
        self.heard_vehicle = False
        self._shown = -math.inf  # s
        self._clock, self._began = clock, clock.now()

    def __enter__(self) -> "FlightProgress":
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(OSError):
            self._bar.stop()

    def show(self, message: Telemetry) -> None:
        """Take a message; draw at most ten times a second. A terminal that has closed is no reason to land."""
        with contextlib.suppress(OSError):
            self._show(message)

    def _show(self, message: Telemetry) -> None:
        if isinstance(message, PhaseEntered):
            self._enter(message)
        elif isinstance(message, Event) and message.level is not Level.INFO:
            style = "red" if message.level is Level.ERROR else "yellow"
            self._bar.console.print(f"  {printable(message.text)}", style=style, highlight=False, markup=False)
        elif isinstance(message, SetpointSent):
            self._setpoint = message
        elif isinstance(message, PoseReceived):
            self._pose = message
        elif isinstance(message, VehicleStatus):
            self._battery = message.battery_voltage
            self.heard_vehicle = True
        now = self._clock.now()
        if now - self._shown > _REFRESH:
            self._shown = now
            self._draw()

    def _enter(self, message: PhaseEntered) -> None:
        elapsed = message.time - self._began
        self._bar.console.print(f"  {elapsed:6.2f} s  {message.phase}", highlight=False)
        self._bar.update(self._task, description=str(message.phase))
        if message.phase is Phase.STREAM:
            self._first_index_time = message.time

    def _draw(self) -> None:
        done = self._setpoint.time - self._first_index_time if self._setpoint is not None else 0.0
        numbers = f"battery {self._battery:.2f} V"
        if self._pose is not None:
            x, y, z = self._pose.position
            numbers = f"({x:+.2f}, {y:+.2f}, {z:.2f}) m  {numbers}"
        self._bar.update(self._task, completed=done, numbers=numbers)
