"""Time-outs: what happens when something breaks, after how long, and which part of cfplan or the vehicle sees to it.

docs/what-breaks.md is made of them. Each time is read where it is in force: in safety.yaml, in the figures of the
firmware, or as a constant of the module that waits.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

from cfplan.errors import InputError
from cfplan.flight.firmware import Timeouts
from cfplan.flight.pilot.health import LOG_GONE, UPLINK_GONE
from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.virtual_crazyflie.supervisor import Settings
from cfplan.studies.error_texts import PACKAGE, module_constant

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TITLES = ("what stops, or is late", "after", "what happens", "who does that", "where the time stands")
FIGURE = Path("docs/images/time-outs.svg")
_SHOWN = 3.4  # s of each row of the figure
_COLOURS = {  # of what the vehicle does; light enough for black letters, and apart in grey
    "flies on": "#d9f0d3",
    "brakes": "#a6d0e8",
    "lands": "#7fb3d5",
    "levels out": "#fee391",
    "falls": "#f4a582",
}


@dataclass(frozen=True, slots=True)
class TimeOut:
    """One thing that waits, and what it does then."""

    what: str  # that stops or is late
    after: float  # s
    then: str
    who: str
    where: str  # a key of safety.yaml, a parameter of the firmware, or a module

    def cells(self) -> list[str]:
        """Return the row as Markdown."""
        return [self.what, seconds(self.after), self.then, self.who, f"`{self.where}`"]


def seconds(time: float) -> str:
    """Return a time as it is written on the page."""
    if not time:
        return "at once"
    return f"{1e3 * time:g} ms" if time < 0.1 else f"{time:g} s"


def _read(module: str, name: str) -> float:
    """Return a constant of a module, s. Raises InputError where there is none."""
    found = module_constant(PACKAGE / module, name)
    if not isinstance(found, int | float):
        raise InputError(f"no number {name} in {module}", where="time-outs", hint="name the constant that is waited by")
    return float(found)


def time_outs(folder: Path) -> Mapping[str, Sequence[TimeOut]]:
    """Return the rows of each table, with the limits of `folder`'s safety.yaml. Raises InputError."""
    limits = load_limits(folder / "safety.yaml")
    return {
        "alone": _alone(),
        "link": _link(),
        "poses": _poses(limits),
        "computer": _computer(limits),
        "vehicle": _vehicle(limits),
        "planner": _planner(),
        "beginning": _beginning(),
        "end": _end(),
    }


def time_out_table(name: str, folder: Path) -> tuple[list[str], list[list[str]]]:
    """Return titles and cells of a table. Raises InputError where there is none of that name."""
    tables = time_outs(folder)
    if name not in tables:
        raise InputError(f"no such table: time-outs: {name}", hint=f"one of {', '.join(tables)}")
    return [*TITLES], [row.cells() for row in tables[name]]


def _alone() -> list[TimeOut]:
    known, settings = Timeouts(), Settings()
    setpoint, firmware = "setpoints: the pilot is dead, or the radio is", "the vehicle's supervisor"
    latest = f"; looked at every {seconds(known.period)}"
    return [
        TimeOut(
            setpoint, known.level_out,
            f"it gives up its place and levels out, leaning a little away from walls{latest}", firmware, "firmware",
        ),
        TimeOut(
            "any sign of life from the ground", known.keep_alive,
            "motors off: it falls, and is locked until it is restarted", "the vehicle's watchdog",
            "firmware.watchdog: true",
        ),
        TimeOut(
            "setpoints, where the watchdog is off", known.motors_off, "motors off, locked", firmware,
            "firmware.watchdog: false",
        ),
        TimeOut(
            "everything, between arming and take-off", settings.preflight_timeout / 1e3, "it disarms", firmware,
            "supervisor.prefltTimeout",
        ),
        TimeOut(
            "everything, after the motors have stopped on the floor",
            known.still_flying + settings.landed_timeout / 1e3, "it disarms", firmware, "supervisor.landedTimeout",
        ),
    ]  # fmt: skip


def _link() -> list[TimeOut]:
    health, perishable, loop = "flight/pilot/health.py", "flight/radio/perishable.py", "flight/pilot/flight_loop.py"
    return [
        TimeOut(
            "a setpoint or pose on its way, in a radio that repeats it", _read(perishable, "KEEPS_FOR"),
            "it is dropped, as a newer one is there", "the pilot's radio link", perishable,
        ),
        TimeOut(
            "a log of the vehicle, estimate or status, while the vehicle acknowledges", LOG_GONE,
            "the vehicle brakes along its path and lands by poses; the log is created anew meanwhile",
            "the pilot", health,
        ),
        TimeOut(
            "packets of any kind, at the vehicle", Timeouts().connection,
            "it deletes its log blocks; once it acknowledges again, the pilot creates them anew",
            "the vehicle's firmware", "firmware",
        ),
        TimeOut(
            "acknowledgements, if they come again before the motors stop", UPLINK_GONE,
            "it hovers where it is, then lands there; nothing old is sent", "the pilot", health,
        ),
        TimeOut(
            "acknowledgements, for good", _read(loop, "LINK_LOST_AFTER"),
            "the link counts as lost: exit code 8, the record is closed", "the pilot", loop,
        ),
    ]  # fmt: skip


def _poses(limits: Limits) -> list[TimeOut]:
    landing, child, client = "flight/pilot/landing.py", "flight/mocap/child.py", "flight/mocap/datastream_client.py"
    predictor = "flight/mocap/pose_predictor.py"
    return [
        TimeOut(
            "a pose, before take-off", limits.pose.age_warning, "preflight refuses", "the pilot", "pose.age_warning",
        ),
        TimeOut(
            "a pose, in the air", _read(predictor, "FARTHEST"),
            "it is carried on by what the vehicle's sensors have measured since", "the pilot", predictor,
        ),
        TimeOut(
            "poses", limits.pose.age_brake,
            "the vehicle brakes along its path; a pose that old is not sent to it any more", "the pilot",
            "pose.age_brake",
        ),
        TimeOut(
            "poses, or they come too late to be sent", limits.pose.age_land,
            "it lands quickly, on its own estimate and off walls nearby", "the pilot", "pose.age_land",
        ),
        TimeOut(
            "poses in a landing, which then are good again", _read(landing, "_SEEN_FOR"),
            "the landing goes on gently from where they show the vehicle", "the pilot", landing,
        ),
        TimeOut("poses in a landing", _read(landing, "_BLIND_FOR"), "motors off, wherever it is", "the pilot", landing),
        TimeOut(
            "frames of vicon://", _read(client, "FRAME_TIMEOUT"), "the stream counts as lost, and is opened again",
            "the pose feed", client,
        ),
        TimeOut(
            "a vendor's client that hangs", _read(child, "FRAME_ALARM"), "its process is killed", "the system", child,
        ),
        TimeOut(
            "a client that has ended", _read("flight/mocap/feed.py", "_BACKOFF"), "another one is started",
            "the pose feed", "flight/mocap/feed.py",
        ),
    ]  # fmt: skip


def _computer(limits: Limits) -> list[TimeOut]:
    monitor, process = "flight/pilot/abort_monitor.py", "flight/pilot/process.py"
    return [
        TimeOut(
            "one deadline in a hundred, in the second before take-off", limits.lateness, "preflight refuses",
            "the pilot", "lateness",
        ),
        TimeOut(
            "a setpoint, as this computer stood still", _read(monitor, "LATEST_SETPOINT"),
            "the vehicle brakes from where its path is by then, and lands", "the pilot", monitor,
        ),
        TimeOut(
            "the command: its terminal was closed, or it was killed", 0.0,
            "the vehicle brakes along its path and lands", "the pilot", monitor,
        ),
        TimeOut(
            "the command, and the landing after it", _read(process, "_LANDING_TIME"),
            "the pilot's process ends; the vehicle is then alone", "the pilot", process,
        ),
    ]  # fmt: skip


def _vehicle(limits: Limits) -> list[TimeOut]:
    return [
        TimeOut(
            "speed, acceleration or angular velocity beyond `flight`, lasting", limits.flight.patience,
            "it brakes, lands or is cut, as the threshold says", "the pilot", "flight.patience",
        ),
        TimeOut(
            "deviation, fence, tumbling or a lock", 0.0, "it brakes, lands or is cut, as the threshold says",
            "the pilot", "flight",
        ),
        TimeOut(
            "battery voltage under load, averaged over", limits.battery.under_load_seconds, "it lands", "the pilot",
            "battery.under_load_seconds",
        ),
    ]  # fmt: skip


def _planner() -> list[TimeOut]:
    commitment, proposals, planner, steered = (
        "flight/setpoints/commitment.py", "flight/pilot/proposals.py", "preparation/proposal_chain.py",
        "steering/steered_vehicle.py",
    )  # fmt: skip
    return [
        TimeOut(
            "a plan, so late that less than this is left until its first setpoint that is another",
            _read(proposals, "LOOKS_UNTIL"),
            "it is refused as late and planned again, farther ahead; the vehicle flies what was committed before",
            "the pilot", proposals,
        ),
        TimeOut(
            "the planner: dead, hanging or wrong", 0.0,
            "the vehicle flies what is committed to its end, a hover inside the space", "the pilot", commitment,
        ),
        TimeOut(
            "the pilot's answer to a plan", _read(planner, "_ANSWER_WITHIN"),
            "the planner goes on; an answer that comes later still counts", "the planner", planner,
        ),
        TimeOut(
            "the planner's answer to your program", _read(steered, "_ANSWER_WITHIN"), "`RequestRefusedError`",
            "`cfplan.connect()`", steered,
        ),
    ]  # fmt: skip


def _beginning() -> list[TimeOut]:
    connection, manoeuvres = "flight/radio/connection.py", "flight/pilot/manoeuvres.py"
    return [
        TimeOut(
            "the first packet back", _read(connection, "FIRST_ANSWER"), "`nothing answers`", "the pilot", connection,
        ),
        TimeOut(
            "the vehicle's tables", _read(connection, "WHOLE_CONNECTION"), "its tables do not come through",
            "the pilot", connection,
        ),
        TimeOut(
            "the first good poses", _read("flight/mocap/source.py", "OPEN_WITHIN"), "the flight is refused",
            "the pose feed", "flight/mocap/source.py",
        ),
        TimeOut(
            "another commander, listened for once the vehicle is armed",
            _read("flight/pilot/prearm.py", "_LISTENS_ARMED_FOR"), "where one is heard, it is disarmed", "the pilot",
            "flight/pilot/prearm.py",
        ),
        TimeOut(
            "the supervisor's word that it may fly", _read(manoeuvres, "_READY_WITHIN"),
            "no take-off: it is disarmed", "the pilot", manoeuvres,
        ),
    ]  # fmt: skip


def _end() -> list[TimeOut]:
    landing, pilot, on_board = "flight/pilot/landing.py", "flight/pilot/pilot.py", "flight/pilot/on_board_manoeuvres.py"
    return [
        TimeOut(
            "the report that motors have stopped, asked for several times", _read(landing, "MOTORS_STOP_WITHIN"),
            "the motors are cut", "the pilot", landing,
        ),
        TimeOut(
            "the report that a cut has arrived, sent at each tick", _read(pilot, "_LOCKED_WITHIN"),
            "it is said so, and the link is closed: the vehicle stops by itself by then", "the pilot", pilot,
        ),
        TimeOut(
            "the on-board commander's answer, asked for several times", _read(on_board, "_ANSWERS_WITHIN"),
            "before take-off it stays down, in the air it lands", "the pilot", on_board,
        ),
    ]  # fmt: skip


# The figure ---------------------------------------------------------------------------------------------------------

_Row = tuple[str, list[tuple[float, str]]]  # what breaks at 0 s, and from when on the vehicle does what


def _rows(limits: Limits) -> list[_Row]:
    known, stop = Timeouts(), _read("flight/setpoints/stops.py", "DURATION")
    blind = _read("flight/pilot/landing.py", "_BLIND_FOR")
    pose = limits.pose
    return [
        ("setpoints stop:\npilot, radio or computer dead", [
            (0.0, "flies on"), (known.level_out, "levels out"), (known.keep_alive, "falls")]),
        ("the same,\nwatchdog switched off", [
            (0.0, "flies on"), (known.level_out, "levels out"), (known.motors_off, "falls")]),
        ("poses stop", [(0.0, "flies on"), (pose.age_brake, "brakes"), (pose.age_land, "lands"), (blind, "falls")]),
        ("the vehicle is not heard,\nbut hears", [(0.0, "flies on"), (LOG_GONE, "brakes"), (LOG_GONE + stop, "lands")]),
        ("the command is killed", [(0.0, "brakes"), (stop, "lands")]),
        ("the planner dies", [(0.0, "flies on")]),
    ]  # fmt: skip


def draw_time_outs(folder: Path) -> str:
    """Return the figure of what the vehicle does after something broke, as SVG whose letters are text."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    rows = _rows(load_limits(folder / "safety.yaml"))
    content = StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "cfplan", "font.family": "sans-serif"}):
        figure = Figure(figsize=(9.0, 0.62 * len(rows) + 0.7), layout="constrained")
        axes = figure.subplots()
        for number, (_, steps) in enumerate(rows):
            _draw_row(axes, -number, steps)
        axes.set(xlim=(0.0, _SHOWN), ylim=(0.6 - len(rows), 0.75), xlabel="time since it broke, s")
        axes.set_yticks([-number for number in range(len(rows))], [what for what, _ in rows])
        axes.tick_params(axis="y", length=0)
        axes.spines[["top", "right", "left"]].set_visible(False)
        figure.savefig(content, format="svg", metadata={"Date": None, "Creator": None})
    return content.getvalue()


def _draw_row(axes: "Axes", at: float, steps: Sequence[tuple[float, str]]) -> None:
    ends = [begin for begin, _ in steps[1:]] + [_SHOWN]
    for (begin, does), end in zip(steps, ends, strict=True):
        axes.barh(at, end - begin, left=begin, height=0.5, color=_COLOURS[does], edgecolor="white", linewidth=0.8)
        if end - begin > 0.3:
            axes.text((begin + end) / 2, at, does, ha="center", va="center", fontsize=9)
        if begin:
            axes.text(begin, at + 0.28, f"{begin:g}", ha="center", va="bottom", fontsize=8)


def letters_of(svg: str) -> list[str]:
    """Return the texts in an SVG, in order."""
    return re.findall(r">([^<>]*)</(?:text|tspan)>", svg)


def write_figure(folder: Path) -> Path | None:
    """Draw the figure anew where what it says is no longer so; return its file where it was drawn.

    Another version of matplotlib draws the same with other bytes, which is no reason.
    """
    file, drawn = folder / FIGURE, draw_time_outs(folder)
    if file.is_file() and letters_of(file.read_text(encoding="utf-8")) == letters_of(drawn):
        return None
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(drawn, encoding="utf-8")
    return file
