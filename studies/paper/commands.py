"""The commands of `python -m studies` that make all of the paper's tables, and its figures."""

from pathlib import Path

import click

from studies.runner.cases import Effort
from studies.runner.commands import SCHEDULER, WORKERS, note, print_result, progress_bars


@click.command(epilog="Example: python -m studies paper results --workers 2")
@click.argument("folder", metavar="[DIR]", type=click.Path(path_type=Path), default=Path("results"))
@click.option("--quick", is_flag=True, help="Smoke test: a few paths and epochs, on data made for it.")
@WORKERS
@SCHEDULER
def paper(folder: Path, quick: bool, workers: int, scheduler: str | None) -> None:
    """Make the results of all of the paper's tables in DIR, one study after another.

    Results of the present sources and settings are kept, so that a run that was stopped resumes.
    """
    from studies.paper.all_tables import paper_results

    with progress_bars() as bar:
        effort = Effort(workers, scheduler, say=note, progress=bar)
        made = list(paper_results(folder, quick=quick, effort=effort))
    for each in made:
        print_result(each.result)
    for each in made:
        click.echo(f"{each.file}: {each.result.seconds:.0f} s of the processor{', kept' if each.kept else ''}")


@click.command(epilog="Example: python -m studies figures results docs/images")
@click.argument("results", metavar="[RESULTS]", type=click.Path(path_type=Path), default=Path("results"))
@click.argument("images", metavar="[IMAGES]", type=click.Path(path_type=Path), default=Path("docs/images"))
def figures(results: Path, images: Path) -> None:
    """Draw the paper's figures as .png in IMAGES from the rows of the cases in RESULTS."""
    from studies.paper.figures import write_figures

    for file, reason in write_figures(results, images):
        click.echo(f"{file}: left out: {reason}" if reason else file)
