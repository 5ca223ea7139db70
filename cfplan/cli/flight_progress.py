"""Live progress of a flight on the terminal: a line per phase, a bar along the path, and the keys that end it."""

import contextlib
import math
import sys
from collections.abc import Iterable
from types import TracebackType
from typing import TYPE_CHECKING

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
from cfplan.numbers import coordinates

if TYPE_CHECKING:
    from rich.console import RenderableType

_NOTES = 4.0  # s between lines within a phase, without a bar
KEYS = "space lands · Esc cuts the motors · Ctrl-C lands, twice cuts"
SIGNALS_ALONE = "Ctrl-C lands, twice cuts the motors"  # if standard input is not a terminal


class FlightProgress:
    """Shows telemetry: on a terminal as a bar, elsewhere as lines with phase and, every few seconds, progress."""

    def __init__(self, *, duration: float, steps: Steps, clock: Clock = REAL_CLOCK):
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn
        from rich.text import Text

        self._keys = KEYS if sys.stdin.isatty() else SIGNALS_ALONE
        console = Console(stderr=True, quiet=steps.as_json)
        keys = Text(f"  {self._keys}", style="bold")

        class BarWithKeys(Progress):
            def get_renderables(self) -> "Iterable[RenderableType]":
                yield from super().get_renderables()
                yield keys

        self._bar = BarWithKeys(
            TextColumn("  {task.description:<12}"),
            BarColumn(),
            TextColumn("{task.fields[numbers]}"),
            console=console,
            disable=steps.as_json or not console.is_terminal,
            transient=True,
        )
        self._duration = duration
        self._task = self._bar.add_task("", total=None, numbers="")
        self._setpoint: SetpointSent | None = None
        self._first_index_time: float | None = None  # s, while the path is streamed
        self._pose: PoseReceived | None = None
        self._battery: float | None = None  # V
        self.heard_vehicle = False
        self._phase, self._noted = "", math.inf  # the phase, and when its progress was last printed, s
        self._entered = math.inf  # s
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
        """Show a message. A closed terminal does not end the flight."""
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
        self._draw(self._clock.now())

    def _enter(self, message: PhaseEntered) -> None:
        elapsed = message.time - self._began
        if message.phase is Phase.ARM and self._bar.disable:  # without a bar, which otherwise shows the keys
            self._bar.console.print(f"  {self._keys}", highlight=False)
        self._bar.console.print(f"  {elapsed:6.2f} s  {message.phase}", highlight=False)
        self._phase, self._entered, self._noted = str(message.phase), message.time, message.time
        streaming = message.phase is Phase.STREAM
        self._first_index_time = message.time if streaming else None
        # without a total the bar only pulses
        self._bar.reset(self._task, total=self._duration if streaming else None, description=str(message.phase))

    def _draw(self, now: float) -> None:
        numbers = []
        done = 0.0
        if self._first_index_time is not None and self._setpoint is not None:
            done = min(max(self._setpoint.time - self._first_index_time, 0.0), self._duration)
            numbers.append(f"{done:.1f} of {self._duration:.1f} s")
        elif self._bar.disable:
            numbers.append(f"{now - self._entered:.0f} s")
        if self._pose is not None:
            numbers.append(f"{coordinates(self._pose.position, '.2f')} m")
        if self._battery is not None:
            numbers.append(f"{self._battery:.2f} V")
        self._bar.update(self._task, completed=done, numbers="  ".join(numbers))
        if self._bar.disable and now - self._noted >= _NOTES:
            self._noted = now
            self._bar.console.print(f"  … {self._phase}, {', '.join(numbers)}", highlight=False)
