"""`cfplan study`: measurements, each one command and one JSON file, and the tables of docs/ made from those."""

from difflib import get_close_matches
from pathlib import Path

import click

from cfplan.errors import InputError
from studies.commands import flying_studies, planning_studies


class _Studies(click.Group):
    """Says of each study what it measures, and names all where an unknown one is asked for."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the studies, each with its whole first sentence."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, each.get_short_help_str(200)) for name, each in sorted(self.commands.items())])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        if not name.startswith("-") and self.get_command(ctx, name) is None:
            near = get_close_matches(name, self.commands, n=1)
            meant = f"did you mean {near[0]}? " if near else ""
            raise InputError(
                f"there is no study {name!r}",
                where="cfplan study",
                hint=f"{meant}known: {', '.join(sorted(self.commands))}",
            )
        return super().resolve_command(ctx, args)


@click.group(short_help="Measurements for docs/results.", cls=_Studies)
def study() -> None:
    """Measure one thing, with tables for docs/results. Users who only fly need none of these."""


@study.command(short_help="Write the tables of docs/ from results/.")
@click.argument("folder", metavar="[REPOSITORY]", type=click.Path(path_type=Path), default=Path())
def docs(folder: Path) -> None:
    """Write the tables of the pages in docs/ anew from the JSON in results/."""
    from studies.runner.docs_tables import write_tables

    for page in write_tables(folder):
        click.echo(page)


for command in (*planning_studies.COMMANDS, *flying_studies.COMMANDS):
    study.add_command(command)
