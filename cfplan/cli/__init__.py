"""The command line: one small file per command, wiring only. Heavy packages are imported inside the commands."""

import gc
import io
import os
import signal
import sys

import click

from cfplan.cli.bench import bench
from cfplan.cli.check import check
from cfplan.cli.dataset import dataset
from cfplan.cli.doctor import doctor
from cfplan.cli.export import export
from cfplan.cli.fly import fly
from cfplan.cli.identify import identify
from cfplan.cli.init import init
from cfplan.cli.mocap import mocap
from cfplan.cli.output import print_error, print_json
from cfplan.cli.plan import plan
from cfplan.cli.replay import replay
from cfplan.cli.report import report
from cfplan.cli.robustness import robustness
from cfplan.cli.sim import sim
from cfplan.cli.train import train
from cfplan.cli.validate import validate
from cfplan.cli.virtual import virtual
from cfplan.errors import CfplanError, InputError
from cfplan.version import __version__

EPILOG = """\b
Examples:
  cfplan init --room 4x6x2.5               write a safety.yaml and a first path for this room
  cfplan fly flights/figure8.yaml          fly the virtual Crazyflie
  cfplan check flights/circle.yaml         check the plan against every limit
  cfplan replay records/<flight>           look at a flight in rerun

\b
Exit codes: 0 ok, 2 usage, 3 infeasible, 4 certificate or dry run failed, 5 preflight failed,
6 ended by the operator, 7 ended by a safety rule, 8 link lost."""


def _print_version(context: click.Context, _: click.Parameter, asked: bool) -> None:
    if not asked:
        return
    from cfplan.learning.model_files import load_card, models_folder
    from cfplan.version import commit

    cards = [load_card(file.parent) for file in sorted(models_folder().glob("*/card.json"))]
    models = ", ".join(f"{card.name} ({card.weights_sha256[:12]}, {card.date[:10]})" for card in cards)
    click.echo(f"cfplan {__version__}, commit {commit()[:12]}; models: {models}")
    context.exit()


class _Commands(click.Group):
    """A group that lists the commands in the order in which a new user needs them."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands, in that order."""
        return list(self.commands)


@click.group(
    cls=_Commands, epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110}
)
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_version,
    help="Show version, commit and model.",
)
def cfplan() -> None:
    """Plan, certify, rehearse, fly and replay time-optimal Crazyflie flights."""


COMMANDS = (
    init, plan, check, export, sim, robustness, fly, virtual, replay, report, identify, validate, mocap, dataset, train,
    bench, doctor,
)  # fmt: skip
for command in COMMANDS:
    cfplan.add_command(command)


def main() -> None:
    """Run the command line as a process, with rarer garbage collection, and none at exit.

    Collecting the thousands of objects that imports create takes a third of a short command's time.
    """
    gc.set_threshold(50_000, 20, 20)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # of characters that a terminal's encoding does not have
    try:
        run_command()
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C, or a late one, must not print a traceback
        gc.disable()
        gc.freeze()


def run_command() -> None:
    """Run the command that sys.argv names, and exit with its code."""
    sys.exit(_exit_code())


def _exit_code() -> int:
    """Run a command and return the exit code; a user's mistake is reported in one line, without a traceback."""
    try:
        result = cfplan.main(prog_name="cfplan", standalone_mode=False)
    except click.exceptions.Exit as ending:
        return ending.exit_code
    except click.ClickException as error:
        error.show()
        return _with_document(error.exit_code, error.format_message(), hint="--help lists commands and options")
    except (click.Abort, KeyboardInterrupt):
        print("stopped", file=sys.stderr)
        return _with_document(130, "stopped")
    except BrokenPipeError:  # the reader of the output has exited, as `| head` does
        sys.stderr.close()
        return 0
    except OSError as error:
        return _report(_unusable(error))
    except CfplanError as error:
        return _report(error)
    return result if isinstance(result, int) else 0


def _unusable(error: OSError) -> InputError:
    """Return the error of a file that is not read or written by a function that names it."""
    subject, where = ("", str(error.filename)) if error.filename else ("a file, or the output, ", "")
    hint = "check its name, its permissions, the space on its disk, and that the working folder still exists"
    return InputError(f"{subject}cannot be used ({error.strerror or error})", where=where, hint=hint)


def _report(error: CfplanError) -> int:
    """Print an error, and return its exit code."""
    print_error(error)
    return _with_document(int(error.exit_code), error.what, where=error.where, hint=error.hint)


def _with_document(exit_code: int, what: str, *, where: str = "", hint: str = "") -> int:
    """Return the exit code of an error, which with --json is printed as a document too, if the output can be used."""
    try:
        if "--json" in sys.argv:
            print_json({"error": what, "where": where, "hint": hint, "exit_code": exit_code})
        print(end="", flush=True)
    except OSError:  # as of a full disk; what is left to write would fail again at exit, and change the exit code
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return exit_code
