"""`cfplan bench`: the planners compared on the same paths, in one run."""

import click

from studies.commands.measured import BOXES, NODES, SETS, YAW, Study, count, measured, seed


@measured(
    "planning",
    "cfplan bench --paths 20 --planner expert --planner toppquad",
    count(100, "Random paths in each box with each set."),
    click.option("--planner", "planners", multiple=True, help="May be given several times.  [default: all]"),
    NODES,
    seed(0),
    BOXES,
    SETS,
    YAW,
    short_help="Compare the planners on the same paths.",
)
def bench() -> Study:
    """Compare the planners on the same paths, in one run, on one thread."""
    from studies.bench import bench as run

    return run
