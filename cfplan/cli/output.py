"""How the commands speak: a line a step for people, one JSON document for scripts."""

import json
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

import click

from cfplan.errors import CfplanError
from cfplan.files.json_values import json_value
from cfplan.preparation.steps import StepState, step

_FILE_WIDTH = 170  # characters, of tables that go to a file or a pipe


class Steps:
    """Prints one line a step as it ends, with the time that it took; silent where JSON is asked for."""

    def __init__(self, *, as_json: bool):
        self.as_json = as_json
        self._begun = 0.0

    def __call__(self, name: str, state: StepState, result: str) -> None:
        """Show how far a step is; an OnStep."""
        if state is StepState.BEGUN:
            self._begun = time.perf_counter()
        elif not self.as_json:
            mark = click.style("✓", fg="green") if state is StepState.FINISHED else click.style("✗", fg="red")
            took = f"{(time.perf_counter() - self._begun) * 1e3:.0f} ms"
            click.echo(f"{mark} {name:<12} {took:>8}  {result}".rstrip())

    def step(self, name: str) -> AbstractContextManager[list[str]]:
        """Time a step of a command. What the block appends to the list is printed behind the step's name."""
        return step(self, name)

    def failed(self, name: str, text: str) -> None:
        """Show a step that ran to its end with the verdict no."""
        if not self.as_json:
            click.echo(f"{click.style('✗', fg='red')} {name:<12} {text}")

    def say(self, text: str = "") -> None:
        """Print a line that is no step."""
        if not self.as_json:
            click.echo(text)


def print_json(document: Any) -> None:
    """One document on standard output; what is not finite becomes null, as JSON has no word for it."""
    click.echo(json.dumps(json_value(document), indent=2, ensure_ascii=False))


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
