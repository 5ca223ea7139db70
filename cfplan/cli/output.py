"""How the commands speak: a line a step for people, one JSON document for scripts."""

import json
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import click

from cfplan.errors import CfplanError, ExitCode

_FILE_WIDTH = 170  # characters, of tables that go to a file or a pipe


class Steps:
    """Prints one line a step, with its number, as each one ends; silent where JSON is asked for."""

    def __init__(self, *, as_json: bool):
        self.as_json = as_json

    @contextmanager
    def step(self, name: str) -> Iterator[list[str]]:
        """Time a step. What the block appends to the list is printed behind the step's name."""
        started = time.perf_counter()
        said: list[str] = []
        try:
            yield said
        except CfplanError:
            self._line("✗", name, "", started)
            raise
        self._line("✓", name, ", ".join(said), started)

    def failed(self, name: str, text: str) -> None:
        """A step that ran to its end and whose verdict is no."""
        if not self.as_json:
            click.echo(f"{click.style('✗', fg='red')} {name:<12} {text}")

    def say(self, text: str = "") -> None:
        """A line that is no step."""
        if not self.as_json:
            click.echo(text)

    def _line(self, mark: str, name: str, text: str, started: float) -> None:
        if self.as_json:
            return
        took = f"{(time.perf_counter() - started) * 1e3:.0f} ms"
        color = "green" if mark == "✓" else "red"
        click.echo(f"{click.style(mark, fg=color)} {name:<12} {took:>8}  {text}".rstrip())


def print_json(document: Any) -> None:
    """One document on standard output; what is not finite becomes null, as JSON has no word for it."""
    click.echo(json.dumps(finite(document), indent=2, ensure_ascii=False))


def print_error(error: CfplanError, *, as_json: bool) -> None:
    """One line on standard error, and the same as JSON on standard output where that was asked for."""
    click.echo(f"{click.style('error:', fg='red')} {error}", err=True)
    if as_json:
        code = int(error.exit_code)
        print_json({"error": error.what, "where": error.where, "hint": error.hint, "exit_code": code})


def print_table(title: str, columns: list[str], rows: Sequence[Sequence[str]]) -> None:
    """A table; the first column to the left, numbers to the right."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, title_justify="left", header_style="bold", box=box.SIMPLE_HEAD)
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index == 0 else "right")
    for row in rows:
        table.add_row(*map(Text, row))
    console = Console()
    if not console.is_terminal:
        console.width = _FILE_WIDTH
    console.print(table)


def finite(value: Any) -> Any:
    """The same as JSON knows it: what is not finite becomes None."""
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, bool | str | int) or value is None:
        return value
    number = float(value)
    return number if math.isfinite(number) else None


def exit_with(code: ExitCode) -> None:
    """End the command with this code."""
    raise click.exceptions.Exit(int(code))
