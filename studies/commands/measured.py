"""What makes a command of a study: its options, one thread, progress, and its result as tables and as JSON."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cfplan.cli import options
from cfplan.cli.output import print_json, print_table
from cfplan.errors import InputError

if TYPE_CHECKING:
    from studies.runner.items import Running
    from studies.runner.result import StudyResult

Study = Callable[..., "StudyResult"]
Option = Callable[[Callable[..., Any]], Callable[..., Any]]

PATH = click.argument("path_file", metavar="PATH", type=click.Path(path_type=Path))
PATHS = click.argument("path_files", metavar="PATH...", type=click.Path(path_type=Path), nargs=-1, required=True)
YAW = click.option("--yaw", type=click.Choice(["fixed", "tangent", "free"]), default="free", show_default=True)
BOXES = click.option("--box", "boxes", multiple=True, help="4.5x8x2 or 10x10x10; may be given twice.  [default: both]")
SETS = click.option("--limits", "limit_sets", multiple=True, help="hardware or simulation.  [default: both]")
NODES = click.option("--nodes", type=int, default=100, show_default=True, help="Grid intervals.")
PLANNER = click.option("--planner", default="expert", show_default=True)
JOBS = click.option("--jobs", type=click.IntRange(1), default=1, show_default=True, help="Processes.")
MINUTES = click.option(
    "--minutes", type=click.FloatRange(0, min_open=True), help="Begin no flight after them.  [default: all]"
)
WORKERS = click.option(
    "--workers", type=click.IntRange(1), default=1, show_default=True, help="Processes on this machine."
)
SCHEDULER = click.option("--scheduler", help="Work on a Dask cluster instead: tcp://host:port.")
_OUTPUT = click.option("-o", "--output", type=click.Path(path_type=Path), help="Write the result here, as JSON.")


def count(default: int, text: str) -> Option:
    """Return --paths."""
    return click.option("--paths", type=int, default=default, show_default=True, help=text)


def seed(default: int, text: str = "Of the first path.") -> Option:
    """Return --seed."""
    return click.option("--seed", "first_seed", type=int, default=default, show_default=True, help=text)


def measured(
    what: str, example: str, *extra: Option, one_thread: bool = True, short_help: str | None = None
) -> Callable[[Callable[[], Study]], click.Command]:
    """Make a command of a function that imports and returns a study, to be called with the `extra` options as given.

    It has the function's name and text, ends in an `example`, and says `what` it does beside its progress.
    """

    def command(find: Callable[[], Study]) -> click.Command:
        @wraps(find)
        def run(output: Path | None, as_json: bool, **given: Any) -> None:
            if one_thread:  # before the study imports numpy
                use_one_thread()
            _measure(find(), what, given, output, as_json)

        callback: Callable[..., Any] = run
        for option in reversed((*extra, _OUTPUT, options.as_json)):
            callback = option(callback)
        name = find.__name__.replace("_", "-")
        return click.command(name, epilog=f"Example: {example}", short_help=short_help)(callback)

    return command


def safety_file_of(path_file: Path) -> Path:
    """Return the safety.yaml nearest to this folder or the path file. Raises InputError where there is none."""
    return options.find_safety_file(None, path_file)


def use_one_thread() -> None:
    """Keep numpy, torch and the solvers to one thread."""
    from studies.runner.machine import one_thread

    one_thread()


def _measure(run: Study, what: str, given: dict[str, Any], output: Path | None, as_json: bool) -> None:
    """Run a study with the options that were given, show its progress, then write and print its result."""
    from studies.runner.provenance import provenance

    if output is not None and not output.parent.is_dir():  # before an hour is spent measuring
        raise InputError("no such folder", where=str(output.parent), hint="make it first")
    provenance()  # of the beginning
    chosen = {
        name: value for name, value in given.items() if value not in ((), None)
    }  # the rest is the study's own default
    if "yaw" in chosen:
        from cfplan.geometry.yaw import YawMode

        chosen["yaw"] = YawMode(chosen["yaw"])
    if "workers" in given:
        chosen["running"] = _running(output, workers=chosen.pop("workers"), scheduler=chosen.pop("scheduler", None))
    with shown_progress(quiet=as_json) as begin:
        result = run(**chosen, progress=begin(what))
    if output is not None:
        _write(result, output)
    if as_json:
        print_json(result.to_json())
        return
    for table in result.tables:
        print_table(table.title, *table.cells())


def _running(output: Path | None, **how: Any) -> "Running":
    from studies.runner.items import Running

    return Running(**how, result=output, tell=lambda text: click.echo(text, err=True))


def _write(result: "StudyResult", output: Path) -> None:
    """Write the result; what is kept beside it is not needed any more, unless it was interrupted."""
    from studies.runner.items import forget_unfinished

    result.write(output)
    if not result.interrupted:
        forget_unfinished(output)


@contextmanager
def shown_progress(*, quiet: bool) -> Iterator[Callable[[str], Callable[[int, int], None]]]:
    """Yield a function from a name to what is told of its progress: a bar on stderr, with the time left."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    from studies.runner.time_left import TimeLeft, duration_text

    class Left(TextColumn):
        def render(self, task: Any) -> Any:
            left: TimeLeft = task.fields["left"]
            self.text_format = "" if left.seconds is None else f"{duration_text(left.seconds)} left"
            return super().render(task)

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), Left(""))
    with Progress(*columns, console=Console(stderr=True, quiet=quiet)) as bar:

        def begin(name: str) -> Callable[[int, int], None]:
            left = TimeLeft()
            task = bar.add_task(name, total=None, left=left)

            def show(done: int, total: int) -> None:
                left.step(done, total)
                bar.update(task, completed=done, total=total)

            return show

        yield begin
