"""`cfplan mocap`: show what motion capture sees."""

import math
from dataclasses import asdict
from typing import TYPE_CHECKING

import click

from cfplan.cli import options
from cfplan.cli.output import print_json, print_table
from cfplan.errors import printable
from cfplan.numbers import shown

if TYPE_CHECKING:
    from cfplan.flight.mocap.survey import Survey


@click.command(
    short_help="Show what motion capture sees.",
    epilog="""\b
Examples:
  cfplan mocap vicon://192.168.1.2            every body
  cfplan mocap vicon://192.168.1.2/cf1        and is cf1 among them?
  cfplan mocap vicon-sdk://192.168.1.2        through Vicon's own client
  cfplan mocap qualisys://192.168.1.3         optitrack:// and vrpn:// likewise""",
)
@click.argument("uri")
@click.option(
    "--seconds", type=options.FiniteRange(0.1, 86400), default=5.0, show_default=True, help="Time to look, s."
)
@options.as_json
def mocap(uri: str, seconds: float, as_json: bool) -> int:
    """Show the bodies that the motion capture system at URI sees, and how regularly its frames arrive."""
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    from cfplan.flight.mocap.survey import survey
    from cfplan.flight.mocap.uri import parse_uri

    where = parse_uri(uri, subject_needed=False)
    with Live(console=Console(quiet=as_json), transient=True) as screen:  # only drawn on a terminal
        found = survey(where, seconds, lambda so_far: screen.update(Text(_line(so_far))))
    if as_json:
        print_json({"uri": str(where), **asdict(found), "remarks": _remarks(found)})
    else:
        _print(str(where), found)
    return 0


def _line(found: "Survey") -> str:
    bodies = "  ".join(f"{printable(body.name)} {_place(body.position)}" for body in found.bodies)
    return f"{found.rate:.0f} Hz  {bodies}"


def _print(uri: str, found: "Survey") -> None:
    rows = [
        ["rate", f"{found.rate:.1f} Hz" + _announced(found)],
        ["jitter", f"{1e3 * found.jitter:.2f} ms"],
        ["longest gap", f"{1e3 * found.longest_gap:.1f} ms"],
        ["frames", f"{found.frames}, {found.dropouts} missing"],
        ["latency, by the system", _milliseconds(found.latency)],
        ["delay on the way, p99", _milliseconds(found.delay)],
    ]
    print_table(uri, ["", "value"], rows)
    columns = ["body", "seen", "good", "frozen", "jumped", "flipped", "broken", "position / m", "yaw", "tilt"]
    lines = []
    for body in found.bodies:
        counts = [str(body.counts.get(name, 0)) for name in ("good", "frozen", "jumped", "flipped", "not a pose")]
        angles = [f"{shown(math.degrees(angle), '.0f')}°" if body.position else "–" for angle in (body.yaw, body.tilt)]
        lines.append([body.name, f"{100 * body.seen:.1f} %", *counts, _place(body.position), *angles])
    print_table(f"{len(lines)} bodies", columns, lines)
    for remark in _remarks(found):
        click.echo(printable(remark))


def _remarks(found: "Survey") -> list[str]:
    remarks = [f"{body.name}: {body.remark}" for body in found.bodies if body.remark]
    if not found.bodies:
        remarks.append("no body is defined, enabled and seen there")
    return remarks


def _announced(found: "Survey") -> str:
    return f" of {found.announced_rate:.0f}" if math.isfinite(found.announced_rate) else ""


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.1f} ms" if math.isfinite(seconds) else "not reported"


def _place(position: tuple[float, float, float] | None) -> str:
    return " ".join(shown(each, ".3f") for each in position) if position else "not seen"
