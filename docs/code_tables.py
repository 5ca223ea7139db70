"""Renders the tables of docs/ that the code defines: errors, time-outs and preflight, where a page has a marker.

<!-- render: exit-codes --> is replaced by its table when the site is built. `TABLES` names all of them.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import NamedTuple

from cfplan.air.core import PILOT_ANSWER_TIMEOUT
from cfplan.air.process import PLANNER_ANSWER_TIMEOUT
from cfplan.errors import ExitCode
from cfplan.flight.firmware import TIMEOUTS, Timeouts, version_text
from cfplan.flight.fleet.dongle_process import DONGLE_SILENT
from cfplan.flight.fleet.shared_dongle import RADIO_DEAD_AFTER
from cfplan.flight.mocap.child import FRAME_ALARM
from cfplan.flight.mocap.datastream_client import FRAME_TIMEOUT
from cfplan.flight.mocap.feed import RESTART_BACKOFF
from cfplan.flight.mocap.pose_tracker import MAX_EXTRAPOLATION
from cfplan.flight.mocap.source import OPEN_TIMEOUT
from cfplan.flight.pilot.abort_monitor import LATEST_SETPOINT
from cfplan.flight.pilot.abort_reasons import AbortReason
from cfplan.flight.pilot.flight_loop import LINK_LOST_AFTER, MOTOR_TEST_PERIOD
from cfplan.flight.pilot.health import LOG_GONE, UPLINK_GONE
from cfplan.flight.pilot.landing import MAX_BLIND_LANDING, MOTORS_STOP_TIMEOUT, POSES_TRUSTED_AFTER
from cfplan.flight.pilot.manoeuvres import READY_TIMEOUT
from cfplan.flight.pilot.on_board_manoeuvres import ANSWER_TIMEOUT
from cfplan.flight.pilot.pilot import CUT_TIMEOUT
from cfplan.flight.pilot.prearm import LISTEN_WHILE_ARMED
from cfplan.flight.pilot.process import LANDING_TIMEOUT
from cfplan.flight.pilot.proposals import LOOKS_UNTIL
from cfplan.flight.pilot.vehicle_rules import COMMANDER_SIGNS, PARAMETER_RULES, UNKNOWABLE
from cfplan.flight.radio.connection import FIRST_ANSWER_TIMEOUT
from cfplan.flight.radio.perishable import MAX_AGE
from cfplan.flight.radio.session import TABLES_TIMEOUT
from cfplan.flight.setpoints.stops import DURATION as STOP_DURATION
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.virtual_crazyflie.supervisor import Settings

MARKER = re.compile(r"<!-- render: (\S+) -->")
LIMITS = load_limits(Path(__file__).parent.parent / "safety.yaml")
FIRMWARE, SUPERVISOR = Timeouts(), Settings()


def rendered(page: str) -> str:
    """Return a page with each marker replaced by what it names. Raises KeyError where it names nothing."""
    return MARKER.sub(lambda marker: TABLES[marker[1]](), page)


def grid(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as Markdown."""
    lines = [titles, ["---"] * len(titles), *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


# Errors ---------------------------------------------------------------------------------------------------------------


def exit_codes() -> str:
    return grid(["exit code", "meaning"], [[str(int(code)), code.meaning] for code in ExitCode])


def abort_reasons() -> str:
    rows = []
    for reason in AbortReason:
        text = re.sub(r"\{(\w+)[^}]*\}", r"<\1>", reason.text)
        rows.append([f"`{text}`", reason.meaning, reason.cure or "–", str(int(reason.exit_code))])
    return grid(["message", "meaning", "what to do", "exit code"], rows)


# Time-outs ------------------------------------------------------------------------------------------------------------


class TimeOut(NamedTuple):
    """One thing that is waited for, and what happens if it does not come."""

    missing: str  # what stops or is late
    after: float  # s
    then: str
    who: str
    key: str = ""  # of safety.yaml, or a parameter of the firmware; empty where it cannot be set


POSE, FLIGHT, BATTERY = LIMITS.pose, LIMITS.flight, LIMITS.battery
# fmt: off
TIME_OUTS: Mapping[str, Sequence[TimeOut]] = {
    "alone": (
        TimeOut("setpoints: the pilot or the radio is dead", FIRMWARE.level_out,
                "it levels out, leaning a little away from walls, and no longer holds its place; checked every "
                f"{1e3 * FIRMWARE.period:g} ms", "the vehicle's supervisor"),
        TimeOut("every packet from the ground", FIRMWARE.keep_alive,
                "motors off: it falls, and is locked until it is restarted", "the vehicle's watchdog",
                "firmware.watchdog: true"),
        TimeOut("setpoints, with the watchdog off", FIRMWARE.motors_off, "motors off, locked",
                "the vehicle's supervisor", "firmware.watchdog: false"),
        TimeOut("everything, between arming and take-off", SUPERVISOR.preflight_timeout / 1e3, "it disarms",
                "the vehicle's supervisor", "supervisor.prefltTimeout"),
        TimeOut("everything, after the motors stopped on the floor",
                FIRMWARE.still_flying + SUPERVISOR.landed_timeout / 1e3, "it disarms", "the vehicle's supervisor",
                "supervisor.landedTimeout"),
    ),
    "link": (
        TimeOut("the acknowledgement of a setpoint or pose that the radio repeats", MAX_AGE,
                "the packet is dropped: a newer one waits", "the pilot's radio link"),
        TimeOut("a log of the vehicle, estimate or status, while the vehicle acknowledges", LOG_GONE,
                "the vehicle brakes along its path and lands by poses; the log is created again meanwhile",
                "the pilot"),
        TimeOut("packets of any kind, at the vehicle", FIRMWARE.connection,
                "it deletes its log blocks; once it acknowledges again, the pilot creates them again",
                "the vehicle's firmware"),
        TimeOut("acknowledgements, if they return before the motors stop", UPLINK_GONE,
                "it hovers where it is, then lands there; no old setpoint is sent", "the pilot"),
        TimeOut("acknowledgements, for good", LINK_LOST_AFTER,
                "the link counts as lost: exit code 8, the record is closed", "the pilot"),
        TimeOut("messages from the process of a shared dongle", DONGLE_SILENT,
                "its links count as lost; at once if the process dies", "each pilot"),
        TimeOut("USB reports of a shared dongle", RADIO_DEAD_AFTER, "its links count as lost", "the dongle's process"),
    ),
    "poses": (
        TimeOut("a pose, before take-off", POSE.age_warning, "preflight refuses", "the pilot", "pose.age_warning"),
        TimeOut("a pose, in the air", MAX_EXTRAPOLATION,
                "until then it is predicted from what the vehicle's sensors measured since", "the pilot"),
        TimeOut("poses", POSE.age_brake,
                "the vehicle brakes along its path; a pose of that age is no longer sent to it", "the pilot",
                "pose.age_brake"),
        TimeOut("poses, or they arrive too late to be sent", POSE.age_land,
                "it lands quickly, on its own estimate and away from near walls", "the pilot", "pose.age_land"),
        TimeOut("poses during a landing, until they have been good again for", POSES_TRUSTED_AFTER,
                "the landing goes on gently from where they show the vehicle", "the pilot"),
        TimeOut("poses, during a landing", MAX_BLIND_LANDING, "motors off, wherever it is", "the pilot"),
        TimeOut("frames of vicon://", FRAME_TIMEOUT, "the stream counts as lost and is opened again", "the pose feed"),
        TimeOut("a vendor's client that hangs", FRAME_ALARM, "its process is killed", "the system"),
        TimeOut("a client that has ended", RESTART_BACKOFF, "another one is started", "the pose feed"),
    ),
    "computer": (
        TimeOut("one deadline in a hundred, in the second before take-off", LIMITS.lateness, "preflight refuses",
                "the pilot", "lateness"),
        TimeOut("a setpoint, because this computer stalled", LATEST_SETPOINT,
                "the vehicle brakes from where its path is by then, and lands", "the pilot"),
        TimeOut("the command: its terminal was closed, or it was killed", 0.0,
                "the vehicle brakes along its path and lands", "the pilot"),
        TimeOut("the command, and the landing after it", LANDING_TIMEOUT,
                "the pilot's process ends; the vehicle is then alone", "the pilot"),
    ),
    "vehicle": (
        TimeOut("speed, acceleration or angular velocity stays beyond `flight`", FLIGHT.patience,
                "it brakes, lands or is cut, by threshold", "the pilot", "flight.patience"),
        TimeOut("deviation, fence, tumbling or a lock", 0.0, "it brakes, lands or is cut, by threshold", "the pilot",
                "flight"),
        TimeOut("a motor test that another client starts, asked for every", MOTOR_TEST_PERIOD,
                "it is switched off, and the vehicle lands", "the pilot"),
        TimeOut("battery voltage under load, averaged over", BATTERY.under_load_seconds, "it lands", "the pilot",
                "battery.under_load_seconds"),
    ),
    "planner": (
        TimeOut("a plan: less than this is left until its first setpoint that differs", LOOKS_UNTIL,
                "it is refused as late and planned again, further ahead; the vehicle flies what was committed before",
                "the pilot"),
        TimeOut("the planner: dead, hanging or wrong", 0.0,
                "the vehicle flies what is committed to its end, a hover inside the space", "the pilot"),
        TimeOut("the pilot's answer to a plan", PILOT_ANSWER_TIMEOUT,
                "the planner goes on; a later answer still counts", "the planner"),
        TimeOut("the planner's answer to your program", PLANNER_ANSWER_TIMEOUT, "`RequestRefusedError`",
                "`cfplan.connect()`"),
    ),
    "beginning": (
        TimeOut("the first packet back", FIRST_ANSWER_TIMEOUT, "`nothing answers`", "the pilot"),
        TimeOut("the vehicle's tables", TABLES_TIMEOUT, "`its tables do not come through`", "the pilot"),
        TimeOut("the first good poses", OPEN_TIMEOUT, "the flight is refused", "the pose feed"),
        TimeOut("other commanders, listened for once the vehicle is armed", LISTEN_WHILE_ARMED,
                "if one is heard, the vehicle is disarmed", "the pilot"),
        TimeOut("the supervisor's report that it may fly", READY_TIMEOUT, "no take-off: it is disarmed", "the pilot"),
    ),
    "end": (
        TimeOut("the report that motors have stopped, asked for several times", MOTORS_STOP_TIMEOUT,
                "the motors are cut", "the pilot"),
        TimeOut("the report that a cut has arrived, sent at each tick", CUT_TIMEOUT,
                "an error is reported and the link is closed: by then the vehicle stops by itself", "the pilot"),
        TimeOut("the on-board commander's answer, asked for several times", ANSWER_TIMEOUT,
                "before take-off the vehicle stays down, in the air it lands", "the pilot"),
    ),
}
# fmt: on


def time_outs(name: str) -> str:
    rows = [
        [row.missing, _seconds(row.after), row.then, row.who, f"`{row.key}`" if row.key else "–"]
        for row in TIME_OUTS[name]
    ]
    return grid(["what stops, or is late", "after", "what happens", "who acts", "set by"], rows)


def _seconds(time: float) -> str:
    return "at once" if not time else f"{1e3 * time:g} ms" if time < 0.1 else f"{time:g} s"


COLOURS = {  # of what the vehicle does; light enough for black letters, and distinct in grey
    "flies on": "#d9f0d3", "brakes": "#a6d0e8", "lands": "#7fb3d5", "levels out": "#fee391", "falls": "#f4a582",
}  # fmt: skip
REACTIONS: Mapping[str, Sequence[tuple[float, str]]] = {  # what breaks at 0 s, and what the vehicle does from when on
    "setpoints stop:\npilot, radio or computer dead": (
        (0.0, "flies on"), (FIRMWARE.level_out, "levels out"), (FIRMWARE.keep_alive, "falls")),
    "the same,\nwatchdog switched off": (
        (0.0, "flies on"), (FIRMWARE.level_out, "levels out"), (FIRMWARE.motors_off, "falls")),
    "poses stop": (
        (0.0, "flies on"), (POSE.age_brake, "brakes"), (POSE.age_land, "lands"), (MAX_BLIND_LANDING, "falls")),
    "the vehicle receives,\nbut its logs are silent": (
        (0.0, "flies on"), (LOG_GONE, "brakes"), (LOG_GONE + STOP_DURATION, "lands")),
    "the command is killed": ((0.0, "brakes"), (STOP_DURATION, "lands")),
    "the planner dies": ((0.0, "flies on"),),
}  # fmt: skip


def reactions() -> str:
    """Return the figure of what the vehicle does after something broke, as SVG within the page."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    shown, content = 3.4, StringIO()  # s on the axis
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "cfplan", "font.family": "sans-serif"}):
        figure = Figure(figsize=(9.0, 0.62 * len(REACTIONS) + 0.7), layout="constrained")
        axes = figure.subplots()
        for number, steps in enumerate(REACTIONS.values()):
            for (begin, does), end in zip(steps, [*(time for time, _ in steps[1:]), shown], strict=True):
                axes.barh(-number, end - begin, left=begin, height=0.5, color=COLOURS[does], edgecolor="white")
                if end - begin > 0.3:
                    axes.text((begin + end) / 2, -number, does, ha="center", va="center", fontsize=9)
                if begin:
                    axes.text(begin, 0.28 - number, f"{begin:g}", ha="center", va="bottom", fontsize=8)
        axes.set(xlim=(0.0, shown), ylim=(0.6 - len(REACTIONS), 0.75), xlabel="time since it broke, s")
        axes.set_yticks([-number for number in range(len(REACTIONS))], list(REACTIONS))
        axes.tick_params(axis="y", length=0)
        axes.spines[["top", "right", "left"]].set_visible(False)
        figure.savefig(content, format="svg", metadata={"Date": None, "Creator": None})
    svg = content.getvalue().partition("<svg")[2].replace("*{", "figure *{")  # its style is for itself alone
    return f'<figure role="img" aria-label="What the vehicle does after something broke">\n<svg{svg}</figure>'


# Preflight ------------------------------------------------------------------------------------------------------------


def parameters() -> str:
    titles = ["parameter", "must be", "what cfplan does", "why", "since firmware"]
    return grid(titles, [
        [
            f"`{rule.name}`", rule.allowed_text, str(rule.action), rule.reason,
            (version_text(rule.since) or "any") + (f"; without it: {rule.missing}" if rule.missing else ""),
        ]
        for rule in PARAMETER_RULES
    ])  # fmt: skip


def signs() -> str:
    return grid(["sign", "how it is known"], [[sign.name, sign.reason] for sign in COMMANDER_SIGNS])


def unknowable() -> str:
    return grid(["what no vehicle reports", "why"], [list(row) for row in UNKNOWABLE])


def firmware_time_outs() -> str:
    titles = ["since firmware", "levels out after", "motors off after", "watchdog", "checked every"]
    return grid(titles, [
        [version_text(since), *(f"{time:g} s" for time in (each.level_out, each.motors_off, each.keep_alive,
                                                            each.period))]
        for since, each in TIMEOUTS
    ])  # fmt: skip


TABLES: Mapping[str, Callable[[], str]] = {
    "exit-codes": exit_codes,
    "abort-reasons": abort_reasons,
    **{f"time-outs/{name}": lambda name=name: time_outs(name) for name in TIME_OUTS},
    "time-outs/figure": reactions,
    "preflight/parameters": parameters,
    "preflight/signs": signs,
    "preflight/unknowable": unknowable,
    "preflight/time-outs": firmware_time_outs,
}
