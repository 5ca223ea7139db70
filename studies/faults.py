"""Fly along PATH at full speed with one fault per flight, and judge the pilot's reaction by the simulated truth."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from math import pi
from pathlib import Path
from typing import Any

from cfplan.air.stepped import PlannerFault
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.telemetry import Phase
from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault
from studies.runner.limits import limits_for
from studies.runner.options import argument, option
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work
from studies.stepped_flight import FOR_GOOD, FaultFlight, Scenario, fly_scenario, prepare_timeline

ASKED_AFTER = 0.8  # s after the stream began
COLUMNS = (
    Column("name", "fault"),
    Column("expected", "must end in", meaning="the rung of the abort ladder that the fault must lead to"),
    Column("rung", "rung", meaning="the lowest rung that the pilot took; *none*: the flight went on to its end"),
    Column("reaction", "reacts after", "s", ".2f", meaning="from the fault to the rung"),
    Column(
        "off_plan", "off the path", "cm", ".0f",
        meaning="largest distance of the true position from the planned path, horizontally once landing has begun",
    ),
    Column(
        "off_setpoint", "from the setpoint", "cm", ".0f",
        meaning="largest distance of the true position from the setpoint of that moment, until landing begins",
    ),
    Column(
        "to_wall", "to the wall", "m", ".2f",
        meaning="least distance of the true position from walls and ceiling; negative beyond them",
    ),
    Column("end", "end", meaning="on the floor, disarmed, and how long all motors were off in the air"),
    Column("record", "record", meaning="whether it can be read",
           value=lambda rows: "readable" if rows[0].readable else "not readable"),
    Column("why", "why", value=lambda rows: rows[0].planner if rows[0].reason == "landed" else rows[0].reason),
)  # fmt: skip


def _poses(name: str, kind: FaultKind, rung: Rung, duration: float, size: float | None = None) -> Scenario:
    return Scenario(name, rung, (ViconFault(kind, 0.0, duration, size),))


def _radio(name: str, kind: RadioFaultKind, rung: Rung, duration: float, size: float | None = None) -> Scenario:
    return Scenario(name, rung, (RadioFault(kind, 0.0, duration, size),))


def _vehicle(name: str, kind: VehicleFaultKind, rung: Rung, duration: float, **changes: Any) -> Scenario:
    return Scenario(name, rung, (VehicleFault(kind, 0.0, duration),), **changes)


def _odd(name: str, *, grounded: bool = False, **settings: Any) -> Scenario:
    """Return a scenario with unusual vehicle settings."""
    return Scenario(name, Rung.NONE, vehicle=VehicleSettings(auto_arming=False, **settings), grounded=grounded)


SCENARIOS: tuple[Scenario, ...] = (
    _poses("poses stop for 0.05 s", FaultKind.OCCLUDE, Rung.NONE, 0.05),
    _poses("poses stop for 0.1 s", FaultKind.OCCLUDE, Rung.NONE, 0.1),
    _poses("poses stop for 0.3 s", FaultKind.OCCLUDE, Rung.BRAKE, 0.3),
    _poses("poses stop for 1 s", FaultKind.OCCLUDE, Rung.LAND, 1.0),
    _poses("poses stop for 5 s", FaultKind.OCCLUDE, Rung.LAND, 5.0),
    _poses("poses stop for good", FaultKind.STALL, Rung.LAND, FOR_GOOD),
    _poses("frozen pose for good", FaultKind.FREEZE, Rung.LAND, FOR_GOOD),
    _poses("frozen pose for 0.3 s", FaultKind.FREEZE, Rung.BRAKE, 0.3),
    _poses("same frame again for 1 s", FaultKind.REPEAT, Rung.LAND, 1.0),
    _poses("pose 5 cm off for 1 s", FaultKind.JUMP, Rung.NONE, 1.0, 0.05),
    _poses("pose 35 cm off for 0.7 s", FaultKind.JUMP, Rung.LAND, 0.7, 0.35),
    _poses("pose 1 m off for 1 s", FaultKind.JUMP, Rung.LAND, 1.0, 1.0),
    _poses("pose 1 m off for good", FaultKind.JUMP, Rung.LAND, FOR_GOOD, 1.0),
    _poses("yaw turned by 180° for 1 s", FaultKind.FLIP, Rung.LAND, 1.0, pi),
    _poses("yaw turned by 180° for good", FaultKind.FLIP, Rung.LAND, FOR_GOOD, pi),
    _poses("NaN pose for 1 s", FaultKind.BREAK, Rung.LAND, 1.0),
    _poses("poses 200 ms late for 1 s", FaultKind.DELAY, Rung.LAND, 1.0, 0.2),
    _poses("poses 200 ms late for good", FaultKind.DELAY, Rung.LAND, FOR_GOOD, 0.2),
    _poses("Vicon's connection reset, back after 0.5 s", FaultKind.CLOSE, Rung.LAND, 0.5),
    _radio("radio loses 10 %", RadioFaultKind.LOSS, Rung.NONE, FOR_GOOD, 0.1),
    _radio("radio loses 30 %", RadioFaultKind.LOSS, Rung.NONE, FOR_GOOD, 0.3),
    _radio("radio loses 50 %", RadioFaultKind.LOSS, Rung.NONE, FOR_GOOD, 0.5),
    _radio("radio 30 ms slower", RadioFaultKind.DELAY, Rung.NONE, FOR_GOOD, 0.03),
    _radio("radio dead for 0.3 s", RadioFaultKind.DEAD, Rung.NONE, 0.3),
    _radio("radio dead for 0.8 s", RadioFaultKind.DEAD, Rung.LAND, 0.8),
    Scenario(
        "radio dead for 3 s", Rung.CUT, (RadioFault(RadioFaultKind.DEAD, 0.0, 3.0),), falls=True
    ),
    Scenario(
        "radio dead for 3 s while going to the start", Rung.CUT, (RadioFault(RadioFaultKind.DEAD, 0.0, 3.0),),
        phase=Phase.GO_TO_START, moment=0.5, falls=True,
    ),
    Scenario(
        "radio dead for 3 s while taking off", Rung.CUT, (RadioFault(RadioFaultKind.DEAD, 0.0, 3.0),),
        phase=Phase.TAKE_OFF, moment=0.5, falls=True,
    ),
    Scenario("stream stalled for 0.2 s", Rung.NONE, stall=0.2),
    Scenario("stream stalled for 0.6 s", Rung.BRAKE, stall=0.6),
    Scenario("stream stalled for 2.5 s", Rung.CUT, stall=2.5, falls=True),
    Scenario("main process killed", Rung.LAND, main_killed=True),
    Scenario("pilot killed", Rung.NONE, pilot_killed=True, falls=True),
    _vehicle("battery sags to 3.1 V", VehicleFaultKind.BATTERY, Rung.LAND, FOR_GOOD),
    _vehicle("one motor at 70 %", VehicleFaultKind.MOTOR, Rung.NONE, FOR_GOOD),
    _vehicle("mass +20 %", VehicleFaultKind.MASS, Rung.LAND, FOR_GOOD, from_start=True),
    _vehicle("gust of 1 m/s for 1 s", VehicleFaultKind.GUST, Rung.NONE, 1.0),
    _vehicle("supervisor locks", VehicleFaultKind.LOCK, Rung.CUT, FOR_GOOD, falls=True),
    _vehicle("vehicle tumbles", VehicleFaultKind.TUMBLE, Rung.CUT, 0.3, falls=True),
    _odd("parameter refused", grounded=True, stubborn=("stabilizer.controller",)),
    _odd("parameters answered 0.5 s late", parameter_delay=0.5),
    Scenario(
        "locked between arming and take-off", Rung.NONE, (VehicleFault(VehicleFaultKind.LOCK, 0.0, FOR_GOOD),),
        phase=Phase.ARM, moment=0.2, grounded=True,
    ),
    _odd("firmware of 2025.09", grounded=True, protocol=10, firmware="2025.09"),
    _odd("firmware of 2025.12", grounded=True, protocol=10, firmware="2025.12"),
    _odd("start place 0.5 m off", position=(0.35, -2.85, 0.0)),
    Scenario(
        "two bodies swapped", Rung.NONE, (ViconFault(FaultKind.SWAP, 0.0, FOR_GOOD),), from_start=True, grounded=True,
        falls=True, cameras=ViconSettings(others=(("cf2", (0.5, 0.5, 0.0)),)),
    ),
    Scenario(
        "two bodies swapped in the stream", Rung.LAND, (ViconFault(FaultKind.SWAP, 0.0, FOR_GOOD),),
        cameras=ViconSettings(others=(("cf2", (0.5, 0.5, 0.0)),)),
    ),
    Scenario(
        "space bar during preflight", Rung.NONE, order=Order.LAND, phase=Phase.PREFLIGHT, moment=0.2, grounded=True,
    ),
    Scenario("space bar during take-off", Rung.LAND, order=Order.LAND, phase=Phase.TAKE_OFF, moment=0.7),
    Scenario("space bar on the way to the start", Rung.LAND, order=Order.LAND, phase=Phase.GO_TO_START, moment=0.5),
    Scenario("space bar in the stream", Rung.LAND, order=Order.LAND),
    Scenario("space bar in the hover behind it", Rung.LAND, order=Order.LAND, phase=Phase.HOLD, moment=0.2),
    Scenario("space bar while landing", Rung.LAND, order=Order.LAND, phase=Phase.LAND, moment=0.5),
    Scenario("Esc in the stream", Rung.CUT, order=Order.CUT),
    Scenario("disk full", Rung.NONE, disk_full=True),
    Scenario("planner killed", Rung.NONE, planner=PlannerFault.KILLED, moment=ASKED_AFTER),
    Scenario("planner stopped for 1 s", Rung.NONE, planner=PlannerFault.STOPPED, moment=ASKED_AFTER),
    Scenario("planner answers late", Rung.NONE, planner=PlannerFault.LATE, moment=ASKED_AFTER),
    Scenario("planner answers garbage", Rung.NONE, planner=PlannerFault.GARBAGE, moment=ASKED_AFTER),
    Scenario(
        "planner answers with a plan for another joint", Rung.NONE, planner=PlannerFault.OTHER_JOINT, moment=ASKED_AFTER
    ),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Settings:
    """The faults to fly, and the path."""

    path_file: Path = argument()
    only: tuple[str, ...] = option((), "Faults whose name contains this text.")


def work(settings: Settings, run: Run) -> Work:
    """Return one case per fault; all fly the same mission. Raises what preparing raises."""
    limits = limits_for(settings.path_file)
    mission, timeline = prepare_mission(settings.path_file, limits), prepare_timeline(settings.path_file, limits)
    wanted = [row for row in SCENARIOS if not settings.only or any(text in row.name for text in settings.only)]
    measure = partial(fly_scenario, mission=mission, timeline=timeline)
    return Work({scenario.name: scenario for scenario in wanted}, measure, FaultFlight)


def tables(settings: Settings, rows: list[FaultFlight]) -> Iterator[Table]:
    """Yield a table with one row per fault."""
    yield table("faults", "Faults at full speed", COLUMNS, rows)


STUDY = Study(Settings, work, tables, "flights/line.yaml -o results/faults.json")
