"""Output of the commands: a line per step for people, one JSON document for scripts."""

import json
import os
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

import click

from cfplan.errors import CfplanError, printable
from cfplan.files.json_values import json_value
from cfplan.flight.clock import REAL_CLOCK, Clock, Repeated
from cfplan.preparation.steps import StepResults, StepState, step

VERBOSE = f"{__name__}.verbose"  # in click's context: --verbose was given
_FIRST_NOTE, _TERMINAL_NOTES, _OTHER_NOTES = 1.0, 0.5, 4.0  # s until a note, between notes on a terminal, elsewhere
_MARKS = {StepState.FINISHED: ("✓", "green"), StepState.WARNED: ("!", "yellow"), StepState.FAILED: ("✗", "red")}
_NARROWEST = 30  # characters; a step's result is not wrapped to fewer
_FILE_WIDTH = 80  # characters, of tables written to a file or a pipe, unless COLUMNS is set


class Steps:
    """Prints one line per step when it ends, with the time that it took; silent with --json.

    While a step takes longer than a second, a note shows its name and the time passed: on a terminal in a line that is
    overwritten, elsewhere in a new line every few seconds.
    """

    def __init__(self, *, as_json: bool, clock: Clock = REAL_CLOCK):
        self.as_json, self._clock = as_json, clock
        context = click.get_current_context(silent=True)
        self.verbose = bool(context and context.meta.get(VERBOSE))  # whether details of steps are shown
        self.meanwhile: Callable[[], str] = str  # background work, shown in the note of a wait
        self._begun = 0.0
        self._waiting: Repeated | None = None

    def __call__(self, name: str, state: StepState, result: str) -> None:
        """Show the state of a step; an OnStep."""
        if self.as_json:
            return
        if state is StepState.DETAIL:
            if self.verbose:
                click.echo(_line(" ", " " * 23, result))
            return
        if state is StepState.BEGUN:
            self._begun = self._clock.now()
            note = _WaitingNote(name, self, self._clock)
            self._waiting = self._clock.repeat(note.show, name="waiting note", last=note.wipe)
            return
        self._end_waiting()
        sign, colour = _MARKS[state]
        took = f"{(self._clock.now() - self._begun) * 1e3:.0f} ms"
        click.echo(_line(styled(sign, colour), f"{name:<12} {took:>8}  ", result))

    def _end_waiting(self) -> None:
        if self._waiting is not None:
            self._waiting.stop()
            self._waiting = None

    @contextmanager
    def waiting(self, name: str) -> Iterator[None]:
        """Show a note if the block takes longer than a second; nothing is printed at its end."""
        self(name, StepState.BEGUN, "")
        try:
            yield
        finally:
            self._end_waiting()

    def step(self, name: str) -> AbstractContextManager[StepResults]:
        """Time a step of a command. Texts that the block appends to the list are printed after the step's name."""
        return step(self, name)

    def failed(self, name: str, text: str) -> None:
        """Print the line of a step that ran to its end with a negative verdict."""
        if not self.as_json:
            click.echo(_line(styled("✗", "red"), f"{name:<12} ", text))

    def print(self, text: str = "") -> None:
        """Print a line that does not belong to a step."""
        if not self.as_json:
            click.echo(text)


def _line(mark: str, head: str, result: str) -> str:
    """Return a step's line; on a narrow terminal it is wrapped with the result's indentation."""
    text = printable(result)
    room = shutil.get_terminal_size().columns - 2 - len(head)
    if sys.stdout.isatty() and len(text) > room >= _NARROWEST:
        text = textwrap.fill(text, room, break_on_hyphens=False).replace("\n", "\n" + " " * (2 + len(head)))
    return f"{mark} {head}{text}".rstrip()


def _compiling_here() -> str:
    """Return a note if this process is compiling, without importing the compiler."""
    compiles = getattr(sys.modules.get("cfplan.machine_code"), "compiles", None)  # None while the module is loading
    return "compiling, once for this machine" if compiles and compiles() else ""


class _WaitingNote:
    """Prints the step that a command waits for, repeatedly."""

    def __init__(self, name: str, steps: Steps, clock: Clock):
        self._name, self._steps, self._clock = name, steps, clock
        self._begun, self._on_terminal = clock.now(), on_terminal()
        self._calls = 0

    def show(self) -> float | None:
        """Show the note, except on the first call; return the time until the next call, s."""
        self._calls += 1
        if self._calls == 1:
            return _FIRST_NOTE
        text = f"… {self._name}, {self._clock.now() - self._begun:.0f} s"
        if meanwhile := self._steps.meanwhile() or _compiling_here():
            text += f" ({meanwhile})"
        try:
            click.echo(f"\r\033[K{text}" if self._on_terminal else text, nl=not self._on_terminal)
        except BrokenPipeError:  # the reader of the output has exited, as `| head` does
            return None
        return _TERMINAL_NOTES if self._on_terminal else _OTHER_NOTES

    def wipe(self) -> None:
        """Clear the terminal's line."""
        if self._on_terminal and self._calls > 1:
            with suppress(BrokenPipeError):
                click.echo("\r\033[K", nl=False)


def print_json(document: Any) -> None:
    """Print one document on standard output, in ASCII; numbers that are not finite become null."""
    click.echo(json.dumps(json_value(document), indent=2))


def print_error(error: CfplanError) -> None:
    """Print one line on standard error."""
    click.echo(f"{styled('error:', 'red')} {error}", err=True)


def print_table(title: str, columns: list[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table, numbers right-aligned, no wider than the terminal, or than 80 characters without one."""
    from rich.console import Console

    from cfplan.cli.tables import print_fitting

    console = Console(highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _FILE_WIDTH
    print_fitting(console, title, columns, [[printable(cell) for cell in row] for row in rows])


def styled(text: str, colour: str) -> str:
    """Return text in a colour, or unchanged if the environment has NO_COLOR (https://no-color.org)."""
    return text if os.environ.get("NO_COLOR") else click.style(text, fg=colour)


def on_terminal() -> bool:
    """Return whether standard output is a terminal that can overwrite a line."""
    return sys.stdout.isatty() and os.environ.get("TERM") != "dumb"


def short_path(file: Path) -> str:
    """Return a path relative to the working folder if it lies in it, else unchanged."""
    try:
        return str(file.resolve().relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(file)
