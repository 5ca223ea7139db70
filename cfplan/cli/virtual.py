"""`cfplan virtual`: serve the virtual Crazyflie to other clients."""

import os
import select
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cfplan.cli.options import SAFETY_FILE, FiniteRange
from cfplan.cli.output import Steps
from cfplan.errors import InputError, LinkError
from cfplan.files.nearest import nearest
from cfplan.files.shipped import example_limits
from cfplan.numbers import coordinates

if TYPE_CHECKING:
    from cfplan.recording.rerun.live import LiveView
    from cfplan.safety.limits import Limits
    from cfplan.simulation.lab.lab import Lab, Truth

_POLL_PERIOD = 0.05  # s
_MAX_VEHICLES = 5  # vehicles, which also stand apart in a small space
_VEHICLE_SPACING = 1.0  # m between vehicles that stand side by side
_LAST_PORT = 65535
FLOW_DECK = "deck.bcFlow2"  # firmware parameter, 1 if the deck was detected at start
LOCKED = (
    "the supervisor has locked: the last flight ended without a stop notice, so motors stay off "
    "until the vehicle is restarted (key r; without a keyboard, end this command and start it again)"
)


@click.command(
    short_help="Serve a virtual Crazyflie to cfclient and other scripts.",
    epilog="""\b
Examples:
  cfplan virtual                                  then connect to udp://127.0.0.1:19850
  cfplan virtual --live                           the same, shown in rerun
  cfplan virtual --vicon 8010                     with poses by a virtual Vicon, as in a lab; in a second terminal:
  cfplan fly first.yaml --uri udp://127.0.0.1:19850 --mocap vicon://127.0.0.1:8010/cf1
  cfplan virtual --count 3 --vicon 8010           three in one room: cf1, cf2 and cf3
  cfplan virtual --flow-deck                      for scripts that fly only with a flow deck
  CFLIB_URI=udp://127.0.0.1:19850 python examples/logging/basiclog.py""",
)
@click.option(
    "--port", type=click.IntRange(1024, 65535), default=19850, show_default=True,
    help="UDP port; cfclient scans 19850 to 19859. Each further vehicle takes the next one.",
)  # fmt: skip
@click.option(
    "--count", type=click.IntRange(1, _MAX_VEHICLES), default=1, show_default=True,
    help="Vehicles in the room, a metre apart along y. They do not collide.",
)  # fmt: skip
@click.option(
    "--vicon", "vicon_port", type=click.IntRange(1024, 65535),
    help="TCP port of a virtual Vicon with subjects cf1, cf2, …; the vehicles then have no poses on board.",
)  # fmt: skip
@click.option(
    "--flow-deck", is_flag=True,
    help="Report a flow deck, for scripts that require one; poses on board do not change.",
)  # fmt: skip
@click.option("--seconds", type=FiniteRange(0.1), help="Time to serve, s.  [default: until Ctrl-C]")
@click.option("--live", is_flag=True, help="Show the first vehicle in rerun.")
@click.option(
    "--safety", "safety_file", type=click.Path(path_type=Path),
    help="File that names the vehicle.  [default: the nearest safety.yaml, else that of the examples]",
)  # fmt: skip
def virtual(
    port: int,
    count: int,
    vicon_port: int | None,
    flow_deck: bool,
    seconds: float | None,
    live: bool,
    safety_file: Path | None,
) -> None:
    """Serve virtual Crazyflies over UDP, with poses on board as from a positioning deck, or by a virtual Vicon.

    As on a real vehicle, the supervisor locks after a flight whose setpoints end without notice; the vehicle then has
    to be restarted, with the key r.
    """
    from cfplan.safety.limits_file import load_limits

    limits = load_limits(safety_file or nearest(SAFETY_FILE, Path.cwd()) or example_limits())
    room = VirtualRoom(limits, port, count, vicon_port, flow_deck)
    room.require_ports()
    end = time.monotonic() + seconds if seconds is not None else float("inf")
    view = _open_view(limits) if live else None
    try:
        with _typed() as typed:
            while _serve(room, end, view, typed):
                click.echo("\nrestarted: connect again", err=True)
    except KeyboardInterrupt:
        pass
    finally:
        if view is not None:
            view.__exit__(None, None, None)
        if sys.stderr.isatty():
            click.echo(err=True)


@dataclass(frozen=True, slots=True)
class VirtualRoom:
    """The vehicles to serve, and their ports and poses."""

    limits: "Limits"
    port: int
    count: int
    vicon_port: int | None  # None: the vehicles have poses on board
    flow_deck: bool = False  # its parameter reports it

    @property
    def names(self) -> list[str]:
        """Return the names of the vehicles in motion capture."""
        return [f"cf{number}" for number in range(1, self.count + 1)]

    def places(self) -> list[tuple[float, float, float]]:
        """Return their positions, m: the first at the origin, the others beside it along y, inside the space."""
        space = self.limits.space
        reach = min(-space.low[1], space.high[1]) - space.margin
        apart = min(_VEHICLE_SPACING, max(reach, 0.0) / max(self.count // 2, 1))
        return [(0.0, apart * ((k + 1) // 2) * (1 if k % 2 else -1), 0.0) for k in range(self.count)]

    def require_ports(self) -> None:
        """Raise InputError if the vehicles need ports beyond the last one, or their options contradict each other."""
        if self.flow_deck and self.vicon_port:
            raise InputError(
                "with a virtual Vicon the vehicles have no poses on board, and so no flow deck",
                where="--flow-deck",
                hint="leave it out, or leave --vicon out",
            )
        last = self.port + self.count - 1
        if last > _LAST_PORT:
            raise InputError(f"{self.count} vehicles need ports to {last}", where="--port", hint="choose a lower one")

    def start(self) -> "Lab":
        """Start the lab. Raises LinkError, or InputError if a port is taken."""
        from cfplan.simulation.lab.lab import start_lab
        from cfplan.simulation.lab.room import RoomSettings
        from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
        from cfplan.simulation.virtual_vicon.cameras import ViconSettings

        vicon = ViconSettings(subject=self.names[0], port=self.vicon_port or 0)
        stored = {FLOW_DECK: 1.0} if self.flow_deck else {}
        vehicles = [
            VehicleSettings(position=place, seed=k, stored=stored) for k, place in enumerate(self.places(), start=1)
        ]
        return start_lab(
            self.limits.airframe,
            vehicle=vehicles[0],
            companions=dict(zip(self.names[1:], vehicles[1:], strict=True)),
            room=RoomSettings(vicon, on_board=self.vicon_port is None),
            port=self.port,
        )

    def describe(self, lab: "Lab") -> str:
        """Return a line with each vehicle's URI, and the keys."""
        mocap = f" --mocap vicon://127.0.0.1:{self.vicon_port}/" if self.vicon_port else ""
        found = [f"{self.limits.vehicle} {name}: --uri udp://127.0.0.1:{port}" + (mocap and mocap + name)
                 for name, port in zip(self.names, lab.ports, strict=True)]  # fmt: skip
        return "\n".join([*found, f"r restarts {'it' if self.count == 1 else 'them'}, Ctrl-C ends this"])


def _serve(room: VirtualRoom, end: float, view: "LiveView | None", typed: Callable[[], bytes]) -> bool:
    """Serve the vehicles until the time is up; return True if the key r is typed before."""
    from cfplan.simulation.virtual_crazyflie.supervisor import State

    shown = [StateLine(name if room.count > 1 else "") for name in room.names]
    with Steps(as_json=False).waiting("starting the virtual Crazyflie"):
        started = room.start()
    with started as lab:
        click.echo(room.describe(lab), err=True)
        while time.monotonic() < end:
            time.sleep(_POLL_PERIOD)
            if b"r" in typed():
                return True
            if not lab.alive:
                raise LinkError("the virtual lab has died", where=lab.uri, hint="start it again")
            for number, line in enumerate(shown):
                truth = lab.latest(number)
                if len(truth.time):
                    line.show(State(int(truth.supervisor[-1])), truth.position[-1].tolist())
                    _show(truth, view if number == 0 else None)
    return False


class StateLine:
    """Shows the supervisor's state: on a terminal in its last line, with the position, elsewhere in a line per change.

    With a name, for one of several vehicles, it always prints a line per change.
    """

    def __init__(self, name: str = "") -> None:
        self._state: IntEnum | None = None  # as shown last
        self._begin = f"{name}: " if name else ""
        self._on_terminal = sys.stderr.isatty() and not name

    def show(self, state: IntEnum, position: Sequence[float]) -> None:
        """Show the state and the position; a locked supervisor is explained on any output."""
        changed, self._state = state is not self._state, state
        locked = state.name == "LOCKED"
        name = state.name.lower().replace("_", " ")
        if self._on_terminal:
            click.echo(f"\r\033[K{coordinates(position, '.2f')} m, {name}", nl=False, err=True)
        elif changed:
            click.echo(self._begin + name, err=True)
        if changed and locked:
            click.echo(("\n" if self._on_terminal else self._begin) + LOCKED, err=True)


def _show(truth: "Truth", view: "LiveView | None") -> None:
    """Show the vehicle's latest pose in the view."""
    from cfplan.flight.telemetry import PoseReceived

    if view is not None:
        x, y, z = truth.position[-1].tolist()
        a, b, c, d = truth.quaternion[-1].tolist()
        moment = float(truth.time[-1])
        view.show(PoseReceived(moment, moment, (x, y, z), (a, b, c, d)))


@contextmanager
def _typed() -> Iterator[Callable[[], bytes]]:
    """Yield a function that returns the keys typed since its last call; nothing if standard input is not a terminal."""
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
