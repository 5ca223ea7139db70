"""The commands of `python -m studies`: one per study, and those that make pages and figures from results."""

import importlib
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import click

from cfplan.errors import CfplanError, InputError
from studies import COMMANDS, STUDIES
from studies.runner.cases import Effort, run_study, write_result
from studies.runner.options import parameters, settings_of
from studies.runner.result import StudyResult, Table
from studies.runner.study import Progress, Study


class _Studies(click.Group):
    """A group of commands that imports a study only when it is run."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all studies, then of the commands that show their results."""
        return [*sorted(STUDIES), *sorted({*COMMANDS, *self.commands})]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the studies, each with the first sentence of its help."""
        found = ((name, self.get_command(ctx, name)) for name in self.list_commands(ctx))
        with formatter.section("Studies"):
            formatter.write_dl([(name, each.get_short_help_str(300)) for name, each in found if each is not None])

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """Return the command of this name. Raises InputError if there is none."""
        if name in self.commands:
            return self.commands[name]
        if name in COMMANDS:
            found: click.Command = getattr(importlib.import_module(COMMANDS[name]), name)
            return found
        if name not in STUDIES:
            near = get_close_matches(name, self.list_commands(ctx), n=1)
            meant = f"did you mean {near[0]}? " if near else ""
            raise InputError(
                f"no study {name!r}", where="studies", hint=f"{meant}known: {', '.join(self.list_commands(ctx))}"
            )
        return study_command(name, STUDIES[name])


def study_command(name: str, module: str) -> click.Command:
    """Return the command of the study in a module."""
    found = importlib.import_module(module)
    study: Study = found.STUDY

    def run(output: Path | None, workers: int, scheduler: str | None, minutes: float | None, **given: Any) -> None:
        if output is not None and not output.parent.is_dir():  # before hours of measuring
            raise InputError("no such folder", where=str(output.parent), hint="make it first")
        settings = settings_of(study.settings, given)
        with progress_bars() as bar:
            effort = Effort(workers, scheduler, minutes or float("inf"), output, note, bar)
            result = run_study(name, module, study, settings, effort)
        if output is not None:
            write_result(result, output)
        print_result(result)

    callback: Callable[..., Any] = run
    for parameter in reversed([*parameters(study.settings), *_EFFORT]):
        callback = parameter(callback)
    example = f"Example: python -m studies {name} {study.example}"
    return click.command(name, help=found.__doc__, epilog=example)(callback)


WORKERS = click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="Number of processes.")
SCHEDULER = click.option("--scheduler", metavar="ADDRESS", help="Dask cluster to use instead: tcp://host:port.")
_EFFORT = (
    WORKERS,
    SCHEDULER,
    click.option("--minutes", type=click.FloatRange(0, min_open=True), help="Minutes after which no case is begun."),
    click.option("-o", "--output", type=click.Path(path_type=Path), help="JSON file for the result."),
)


@click.group(cls=_Studies, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
def studies() -> None:
    """Measure cfplan: each study makes one result with its tables. Flying needs none of them."""


@studies.command()
@click.argument("folder", metavar="[REPOSITORY]", type=click.Path(path_type=Path), default=Path())
@click.option("--fresh", is_flag=True, help="Fail if README shows a figure of other sources; for releases.")
def pages(folder: Path, fresh: bool) -> None:
    """Update the figures in README and docs/ from results/, and list the results that are out of date."""
    from studies.runner.pages import stale_results, write_figures

    for page in write_figures(folder):
        click.echo(page)
    for file in stale_results(folder):
        click.echo(f"{file}: measured with other sources")
    if fresh and (old := stale_results(folder, [folder / "README.md"])):
        raise InputError(
            f"README shows figures of {', '.join(old)}, measured with other sources", where="README.md",
            hint="measure them anew; each result names its command",
        )  # fmt: skip


def print_result(result: StudyResult) -> None:
    """Print the tables of a result."""
    for each in result.tables:
        print_table(each)


def print_table(table: Table) -> None:
    """Print a table; at full width if standard output is not a terminal."""
    from rich import box
    from rich.console import Console
    from rich.table import Table as RichTable

    titles, rows = table.cells()
    shown = RichTable(title=table.title, title_justify="left", box=box.SIMPLE_HEAD)
    for number, title in enumerate(titles):
        shown.add_column(title, justify="right" if number else "left")
    for row in rows:
        shown.add_row(*row)
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = 500
    console.print(shown)


@contextmanager
def progress_bars() -> Iterator[Callable[[str], Progress]]:
    """Yield a function from a name to its progress callback, which shows a bar with the time left on stderr."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bars:

        def begin(name: str) -> Callable[[int, int], None]:
            task = bars.add_task(name, total=None, visible=False)
            return lambda done, total: bars.update(task, completed=done, total=total, visible=True)

        yield begin


def note(text: str) -> None:
    """Print a line on stderr."""
    click.echo(text, err=True)


def main() -> None:
    """Run the command line; a user's mistake is reported in one line, without a traceback."""
    try:
        sys.exit(studies.main(prog_name="python -m studies", standalone_mode=False) or 0)
    except click.exceptions.Exit as ending:
        sys.exit(ending.exit_code)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except CfplanError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(int(error.exit_code))
    except (click.Abort, KeyboardInterrupt):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        sys.exit(130)
