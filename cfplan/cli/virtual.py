"""`cfplan virtual`: the virtual Crazyflie for other clients."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cfplan.cli import options
from cfplan.errors import LinkError

if TYPE_CHECKING:
    from cfplan.recording.rerun.live import LiveView
    from cfplan.safety.limits import Limits
    from cfplan.simulation.lab.lab import Truth

_LOOK = 0.05  # s


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
    """Serve the virtual Crazyflie over UDP, with poses on board as from a positioning deck."""
    from cfplan.safety.limits_file import load_limits
    from cfplan.simulation.lab.lab import start_lab
    from cfplan.simulation.lab.room import RoomSettings

    limits = load_limits(options.find_safety_file(safety_file, Path.cwd() / "here"))
    end = time.monotonic() + seconds if seconds is not None else float("inf")
    with start_lab(limits.airframe, room=RoomSettings(on_board=True), port=port) as lab:
        click.echo(f"{limits.vehicle} at udp://127.0.0.1:{lab.port}; Ctrl-C ends it", err=True)
        view = _open_view(limits) if live else None
        try:
            while time.monotonic() < end:
                time.sleep(_LOOK)
                if not lab.alive:
                    raise LinkError("the virtual lab has died", where=lab.uri, hint="start it again")
                _show(lab.latest(), view)
        except KeyboardInterrupt:
            pass
        finally:
            if view is not None:
                view.__exit__(None, None, None)
            if sys.stderr.isatty():
                click.echo(err=True)


def _show(truth: "Truth", view: "LiveView | None") -> None:
    """Show where the vehicle is: on the terminal's last line, and in the view."""
    from cfplan.flight.telemetry import PoseReceived
    from cfplan.simulation.virtual_crazyflie.supervisor import State

    if not len(truth.time):
        return
    x, y, z = truth.position[-1].tolist()
    if sys.stderr.isatty():
        state = State(int(truth.supervisor[-1])).name.lower().replace("_", " ")
        click.echo(f"\r\033[K{x:.2f} {y:.2f} {z:.2f} m, {state}", nl=False, err=True)
    if view is not None:
        a, b, c, d = truth.quaternion[-1].tolist()
        moment = float(truth.time[-1])
        view.show(PoseReceived(moment, moment, (x, y, z), (a, b, c, d)))


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
