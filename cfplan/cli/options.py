"""Arguments and options that several commands share."""

import errno
import math
import os
import tempfile
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from cfplan.cli.output import VERBOSE, short_path
from cfplan.errors import InputError
from cfplan.files.nearest import nearest
from cfplan.files.suffixes import PLAN_SUFFIX

if TYPE_CHECKING:
    from cfplan.cli.output import Steps
    from cfplan.preparation.plan_flight import FlightOptions
    from cfplan.safety.limits import Limits

SAFETY_FILE = "safety.yaml"
NEW_PLAN = ("planner", "model", "nodes", "speed_factor")  # parameters of planning() that determine the plan
PLANNING = (*NEW_PLAN, "budget")

as_json = click.option("--json", "as_json", is_flag=True, help="Print one JSON document instead of text.")
_EXAMPLE = f"{__name__}.example"


def _remember_example(context: click.Context, _: click.Parameter, name: str | None) -> None:
    if name is not None:
        from cfplan.files.shipped import example

        context.meta[_EXAMPLE] = example(name)


def _or_example(context: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
    found: Path | None = context.meta.get(_EXAMPLE)
    if found is not None and path is not None:
        raise InputError("both a path and an example", where=str(path), hint="leave one of them out")
    return found or path


def _needed(context: click.Context, parameter: click.Parameter, path: Path | None) -> Path:
    found = _or_example(context, parameter, path)
    if found is None:
        hint = f"'{parameter.make_metavar(context).strip('[]')}' (or --example)"
        raise click.MissingParameter(ctx=context, param=parameter, param_hint=hint)
    return found


def _path(name: str, check: Callable) -> Callable:
    """Return a decorator that adds a path argument to a command, and --example as an alternative."""
    kind = click.Path(path_type=Path)
    argument = click.argument(
        name, metavar=f"[{name.removesuffix('_file').upper()}]", type=kind, required=False, callback=check
    )
    instead = click.option(
        "--example",
        metavar="NAME",
        is_eager=True,  # processed before the path that it replaces
        expose_value=False,
        callback=_remember_example,
        help="Instead of a path: an example that comes with cfplan, e.g. figure8.",
    )
    return lambda command: instead(argument(command))


path_file = _path("path_file", _needed)
path_or_plan = _path("path_or_plan", _needed)
path_or_plan_or_none = _path("path_or_plan", _or_example)


def _remember_verbose(context: click.Context, _: click.Parameter, verbose: bool) -> None:
    context.meta[VERBOSE] = verbose


class FiniteRange(click.FloatRange):
    """A range of numbers without NaN, which click's ranges let pass."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number; fail if it is not finite, or outside the range."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


class _SpeedFactor(FiniteRange):
    """A factor on the allowed speed, whose error message also explains that it is not in m/s."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter:
            self.fail(
                f"{value} is not a fraction of the allowed speed, above 0 and at most 1; it is not in m/s.", param, ctx
            )


_PLANNING = (
    click.option(
        "--safety",
        "safety_file",
        type=click.Path(path_type=Path),
        help=f"Limits to keep.  [default: the nearest {SAFETY_FILE} in or above this folder, else above the path file]",
    ),
    click.option(
        "--planner",
        default="auto",
        show_default=True,
        help="auto, learned, expert, toppquad, convex or minsnap.",
    ),
    click.option(
        "--model",
        type=click.Path(path_type=Path),
        help="Folder of the learned planner's model.  [default: search models/ beside the limits]",
    ),
    click.option("--nodes", type=click.IntRange(4), help="Grid intervals.  [default: by the path's length]"),
    click.option(
        "--budget",
        type=FiniteRange(0, min_open=True),
        help="Longest planning time, s, without compiling.  [default: 5, plus 0.02 per metre]",
    ),
    click.option(
        "--speed",
        "speed_factor",
        type=_SpeedFactor(0, 1, min_open=True),
        help="Factor on the allowed speed.  [default: the path file's, else 1]",
    ),
    click.option(
        "-v",
        "--verbose",
        is_flag=True,
        expose_value=False,
        callback=_remember_verbose,
        help="Print details of each step, e.g. the result of every planner.",
    ),
)


def planning(command: Callable) -> Callable:
    """Add the options of every command that plans."""
    for option in reversed(_PLANNING):
        command = option(command)
    return command


def find_safety_file(given: Path | None, path_file: Path) -> Path:
    """Return the safety.yaml to use: the one given, or the nearest in or above the working folder or the path file.

    Looks from the path file's folder upwards if it lies within the working folder; else from the working folder first.
    Raises InputError if there is none.
    """
    if given is not None:
        return given
    working, beside = Path.cwd(), path_file.resolve().parent
    found = nearest(SAFETY_FILE, *((beside, working) if beside.is_relative_to(working) else (working, beside)))
    if found is not None:
        return found
    raise InputError(
        f"no {SAFETY_FILE} in or above this folder, or above the path file",
        where=str(path_file),
        hint="`cfplan init` writes one; or name one with --safety",
    )


def check_place(uri: str, given: Path | None, records: Path) -> None:
    """Raise InputError if an example would fly hardware without --safety, or if no record could be written."""
    if _EXAMPLE in click.get_current_context().meta and not uri.startswith("sim://") and given is None:
        raise InputError(
            "an example flies hardware only with an explicit safety.yaml",
            where=uri,
            hint="name that of your room with --safety; `cfplan init` writes one",
        )
    _check_records_folder(records)


def _check_records_folder(root: Path) -> None:
    """Raise InputError if no record could be written under `root`, which need not exist yet."""
    there = root.absolute()
    while not there.exists() and there != there.parent:
        there = there.parent
    try:
        if not there.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        raise InputError(
            f"records cannot be written there ({error.strerror or error})",
            where=str(root),
            hint="name a folder that can be written with --records",
        ) from error


def refuse(names: Collection[str], what: str, hint: str) -> None:
    """Raise InputError if an option of the command by one of these parameter names is given on the command line."""
    context = click.get_current_context()
    for parameter in context.command.params:
        if (name := parameter.name) in names and context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise InputError(what, where=max(parameter.opts, key=len), hint=hint)


def flight_options(planning: dict[str, Any], given: Path | None, path_file: Path, **more: Any) -> "FlightOptions":
    """Return the options of planning() with the folders of models.

    Raises InputError if there is no such model.
    """
    from cfplan.preparation.plan_flight import FlightOptions

    rest = {name: value for name, value in planning.items() if name != "model"}
    model: Path | None = planning["model"]
    if model is not None and not (model / "card.json").is_file():
        raise InputError("no model there", where=str(model), hint="name the folder of a model, see `cfplan train`")
    beside = find_safety_file(given, path_file).resolve().parent / "models"
    found = model or (beside if any(beside.glob("*/card.json")) else None)
    return FlightOptions(**rest, **more, models=() if found is None else (found,))


def read_limits(given: Path | None, path_file: Path, steps: "Steps", *, compiled: bool = False) -> "Limits":
    """Find and read safety.yaml, as the first step of a command; `compiled` first compiles all that flights need.

    Raises InputError if safety.yaml is wrong, if there is no path file, or for an option that would change the plan of
    a plan file.
    """
    if path_file.suffix == PLAN_SUFFIX:
        refuse(PLANNING, "a plan file is flown as it was planned", "plan the path again with this option")
    if not path_file.exists():
        raise InputError("no such file", where=str(path_file), hint="check the name; it is relative to this folder")
    with steps.step("limits") as results:
        safety_file = find_safety_file(given, path_file)
        from cfplan.safety.limits_file import load_limits

        limits = load_limits(safety_file)
        plan = limits.plan
        results.append(f"{limits.vehicle}, {plan.speed:g} m/s, {plan.acceleration:g} m/s² ({short_path(safety_file)})")
    if compiled:
        from cfplan.cli.warm_up import warm_up

        warm_up(safety_file, steps)
    return limits
