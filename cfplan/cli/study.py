"""`cfplan study`: measurements, each one command and one JSON file, and the tables of docs/ made from those."""

from pathlib import Path

import click

from cfplan.cli import flying_studies, paper_studies, planning_studies


@click.group(short_help="Measurements for docs/results.")
def study() -> None:
    """Measure one thing, with tables for docs/results."""


@study.command(short_help="Write the tables of docs/ from results/.")
@click.argument("folder", metavar="[REPOSITORY]", type=click.Path(path_type=Path), default=Path())
def docs(folder: Path) -> None:
    """Write the tables of the pages in docs/ anew from the JSON in results/."""
    from cfplan.studies.docs_tables import write_tables

    for page in write_tables(folder):
        click.echo(page)


for command in (*planning_studies.COMMANDS, *flying_studies.COMMANDS, *paper_studies.COMMANDS):
    study.add_command(command)
