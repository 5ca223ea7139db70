"""`cfplan virtual`: the virtual Crazyflie for other clients."""

import os
import select
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cfplan.cli import options
from cfplan.cli.output import Steps
from cfplan.errors import LinkError

if TYPE_CHECKING:
    from cfplan.recording.rerun.live import LiveView
    from cfplan.safety.limits import Limits
    from cfplan.simulation.lab.lab import Truth

_LOOK = 0.05  # s
LOCKED = (
    "the supervisor has locked: its last flight ended without the word that no setpoints follow, and motors stay off "
    "until the vehicle is restarted (key r; without a keyboard, end this command and start it again)"
)


@click.command(
    short_help="A virtual Crazyflie for cfclient and other scripts.",
    epilog="""\b
Examples:
  cfplan virtual                                  then connect to udp://127.0.0.1:19850
  cfplan virtual --live                           the same, seen in rerun
  CFLIB_URI=udp://127.0.0.1:19850 python examples/logging/basiclog.py""",
)
@click.option(
    "--port", type=click.IntRange(1024, 65534), default=19850, show_default=True,
    help="UDP; cfclient scans 19850 to 19859. The next port gives poses.",
)  # fmt: skip
@click.option("--seconds", type=click.FloatRange(0.1), help="End after this time; else with Ctrl-C.")
@click.option("--live", is_flag=True, help="Show it in rerun.")
@click.option("--safety", "safety_file", type=click.Path(path_type=Path), help="File that names the vehicle to serve.")
def virtual(port: int, seconds: float | None, live: bool, safety_file: Path | None) -> None:
    """Serve the virtual Crazyflie over UDP, with poses on board as from a positioning deck.

    As on the real one, the supervisor locks after a flight that ended without a word: then nothing flies until the
    vehicle is restarted, with the key r.
    """
    from cfplan.safety.limits_file import load_limits

    limits = load_limits(options.find_safety_file(safety_file, Path.cwd() / "here"))
    end = time.monotonic() + seconds if seconds is not None else float("inf")
    view = _open_view(limits) if live else None
    try:
        with _typed() as typed:
            while _serve(limits, port, end, view, typed):
                click.echo("\nrestarted: connect again", err=True)
    except KeyboardInterrupt:
        pass
    finally:
        if view is not None:
            view.__exit__(None, None, None)
        if sys.stderr.isatty():
            click.echo(err=True)


def _serve(limits: "Limits", port: int, end: float, view: "LiveView | None", typed: Callable[[], bytes]) -> bool:
    """Serve one vehicle until time is up, or until the key r is typed: then return True."""
    from cfplan.simulation.lab.lab import start_lab
    from cfplan.simulation.lab.room import RoomSettings
    from cfplan.simulation.virtual_crazyflie.supervisor import State

    shown = StateLine()
    with Steps(as_json=False).waiting("starting the virtual Crazyflie"):
        started = start_lab(limits.airframe, room=RoomSettings(on_board=True), port=port)
    with started as lab:
        click.echo(f"{limits.vehicle} at udp://127.0.0.1:{lab.port}; r restarts it, Ctrl-C ends it", err=True)
        while time.monotonic() < end:
            time.sleep(_LOOK)
            if b"r" in typed():
                return True
            if not lab.alive:
                raise LinkError("the virtual lab has died", where=lab.uri, hint="start it again")
            truth = lab.latest()
            if len(truth.time):
                shown.show(State(int(truth.supervisor[-1])), truth.position[-1].tolist())
                _show(truth, view)
    return False


class StateLine:
    """Says what the supervisor does: on a terminal in its last line with the position, elsewhere a line a change."""

    def __init__(self) -> None:
        self._state: IntEnum | None = None  # as shown last
        self._on_terminal = sys.stderr.isatty()

    def show(self, state: IntEnum, position: Sequence[float]) -> None:
        """Show the state and where the vehicle is; that it is locked, in words wherever the output goes."""
        changed, self._state = state is not self._state, state
        locked = state.name == "LOCKED"
        name = state.name.lower().replace("_", " ")
        if self._on_terminal:
            x, y, z = position
            click.echo(f"\r\033[K{x:.2f} {y:.2f} {z:.2f} m, {name}", nl=False, err=True)
        elif changed:
            click.echo(name, err=True)
        if changed and locked:
            click.echo(("\n" if self._on_terminal else "") + LOCKED, err=True)


def _show(truth: "Truth", view: "LiveView | None") -> None:
    """Show where the vehicle is in the view."""
    from cfplan.flight.telemetry import PoseReceived

    if view is not None:
        x, y, z = truth.position[-1].tolist()
        a, b, c, d = truth.quaternion[-1].tolist()
        moment = float(truth.time[-1])
        view.show(PoseReceived(moment, moment, (x, y, z), (a, b, c, d)))


@contextmanager
def _typed() -> Iterator[Callable[[], bytes]]:
    """Return what was typed since the last call, key by key; nothing where standard input is no terminal."""
    if not sys.stdin.isatty():
        yield bytes
        return
    import termios
    import tty

    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        yield lambda: os.read(descriptor, 1024) if select.select([descriptor], [], [], 0.0)[0] else b""
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _open_view(limits: "Limits") -> "LiveView":
    import numpy as np

    from cfplan.recording.header import header_under
    from cfplan.recording.rerun.live import open_live
    from cfplan.recording.writer import wall_time_at_zero

    header = header_under(
        limits,
        name="virtual Crazyflie",
        uri="udp://",
        path=np.zeros((0, 3)),
        travel_time=0.0,
        wall_time_at_zero=wall_time_at_zero(),
    )
    return open_live(header, Path()).__enter__()
