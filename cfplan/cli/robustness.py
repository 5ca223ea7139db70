"""`cfplan robustness`: measure how a plan changes with its path."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cfplan.cli import options
from cfplan.cli.output import Steps, print_json, print_table
from cfplan.numbers import shown

if TYPE_CHECKING:
    from cfplan.preparation.path_robustness import PathRobustness, ScaleSummary

COLUMNS = [
    "perturbed by at most", "certified", "dry run passed", "time of flight: mean change", "largest",
    "speed: largest change", "yaw: largest change", "dry run: deviation", "largest",
]  # fmt: skip


@click.command(
    short_help="Test a plan against changes of its path.", epilog="Example: cfplan robustness flights/slalom.yaml"
)
@options.path_file
@click.option(
    "--safety", "safety_file", type=click.Path(path_type=Path), help="Limits.  [default: the nearest safety.yaml]"
)
@click.option("--planner", default="auto", show_default=True, help="auto, learned, expert, convex or minsnap.")
@click.option(
    "--epsilon", "scales", type=options.FiniteRange(0, min_open=True), multiple=True,
    help="Largest displacement of the path, m; repeatable.  [default: 0.001, 0.01, 0.1]",
)  # fmt: skip
@click.option("--draws", type=click.IntRange(1), default=10, show_default=True, help="Perturbed paths per --epsilon.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@options.as_json
def robustness(
    path_file: Path, safety_file: Path | None, as_json: bool, scales: tuple[float, ...], **given: Any
) -> None:
    """Perturb a path, plan and rehearse it again, and show how time, speed, yaw and deviation change.

    A perturbed path is smooth, at rest where the original is, and within --epsilon of it everywhere.
    """
    steps = Steps(as_json=as_json)
    limits = options.read_limits(safety_file, path_file, steps)
    with steps.waiting("loading planners and simulator"):
        from cfplan.geometry.path_file import load_path_file
        from cfplan.preparation.path_robustness import path_robustness

    with steps.step("robustness") as results:
        chosen: dict[str, Any] = {"scales": scales} if scales else {}
        result = path_robustness(load_path_file(path_file), limits, **chosen, **given)
        fit = sum(not plan.reason for plan in result.plans)
        results.append(f"{fit} of {len(result.plans)} plans are certified and pass the dry run")
    if as_json:
        print_json(result)
        return
    print_table(_title(result), COLUMNS, [_cells(scale) for scale in result.scales])
    for reason in dict.fromkeys(plan.reason for plan in result.plans if plan.reason):
        click.echo(f"refused: {reason}")


def _title(result: "PathRobustness") -> str:
    until_then = ", until interrupted" if result.interrupted else ""
    return f"{result.path}, {result.length:.1f} m, {result.flight:.2f} s: the path perturbed{until_then}"


def _cells(scale: "ScaleSummary") -> list[str]:
    return [
        f"{100 * scale.epsilon:g} cm",
        f"{scale.certified}/{scale.plans}",
        f"{scale.flown}/{scale.plans}",
        *(_cell(100 * value, "+.2f", "%") for value in (scale.longer, scale.longer_most)),
        _cell(scale.faster, ".2f", "m/s"),
        _cell(scale.turned, ".3f", "rad"),
        *(_cell(100 * value, ".1f", "cm") for value in (scale.deviation, scale.deviation_most)),
    ]


def _cell(value: float, spec: str, unit: str) -> str:
    return f"{shown(value, spec)} {unit}" if math.isfinite(value) else "–"
