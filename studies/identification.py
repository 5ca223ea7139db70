"""Identify random vehicles from one flight along PATH each in the stepped lab, and fly NEXT with the results.

Mass, motor lag, drag, thrust, moment and pose latency are drawn by seed. Each vehicle flies PATH as if it were the one
of safety.yaml; identification sees only its record, read back from the file. Then every vehicle flies NEXT four times:
with the parameters of safety.yaml, as identified, as identified without having been weighed, and with its true ones.
"""

import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cfplan.errors import CfplanError, ExitCode
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.setpoints.packets import decode
from cfplan.identification.identify import identify
from cfplan.identification.quantities import Identification
from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.recording.header import header_under
from cfplan.recording.reader import read_record
from cfplan.recording.record import Record
from cfplan.recording.writer import RecordWriter
from cfplan.safety.limits import Limits, within_reserve
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.vehicle.airframe import Airframe
from studies.runner.limits import limits_for
from studies.runner.options import argument, option
from studies.runner.reductions import count, largest, median
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work
from studies.stepped_flight import Scenario, SteppedFlight, fly_stepped

MASS, THRUST, MOMENT = 0.10, 0.08, 0.30  # largest relative deviation from the nominal values
LAGS, DRAGS, LATENCIES = (0.06, 0.14), (0.5, 2.0), (0.005, 0.040)  # s, factor, s
SCALE_STEP = 1e-4  # kg, resolution of the scale that weighs the vehicle
_FIRST_SEED = 1000


@dataclass(frozen=True, slots=True)
class Settings:
    """The paths to fly, and the number of vehicles."""

    path_file: Path = argument()
    next_file: Path = argument()
    vehicles: int = option(30, "Number of vehicles.", least=1)
    seed: int = option(0, "Seed of the first vehicle.", least=0)


@dataclass(frozen=True, slots=True)
class DrawnVehicle:
    """A vehicle whose true parameters differ from the nominal ones."""

    seed: int
    airframe: Airframe
    latency: float  # s, of the poses


@dataclass(frozen=True, slots=True)
class StudiedVehicle:
    """Identification errors of one vehicle, and the deviations of its flights; NaN for flights that failed."""

    seed: int
    first_flight: str  # how that flight ended
    reason: str = ""  # why there is no identification; empty if there is
    errors: dict[str, float] = field(default_factory=dict)  # by the keys of _ASKED, in the units of the table
    uncertainties: dict[str, float] = field(default_factory=dict)  # likewise
    deviations: dict[str, float] = field(default_factory=dict)  # m, of the next flights, by their parameters


ERROR_COLUMNS = (
    Column("quantity", "quantity"),
    Column("asked", "aim", meaning="for the median error"),
    Column("median", "error, median"),
    Column("worst", "worst"),
    Column("bias", "mean", meaning="with its sign"),
    Column("uncertainty", "stated", meaning="median of the standard uncertainties that `cfplan identify` states"),
)
NEXT_COLUMNS = (
    Column("vehicle", "vehicle"),
    Column("flights", "flights", value=count()),
    Column("landed", "landed", of="flights", meaning="at the end of the plan",
           value=count(lambda flight: math.isfinite(flight.deviation))),
    Column("median", "deviation, median", "cm", ".1f", meaning="of each flight's largest true distance from the plan",
           value=median("deviation")),
    Column("worst", "worst", "cm", ".1f", value=largest("deviation")),
    Column("over_median", "over known, median", "cm", ".1f", meaning="against the same vehicle, known",
           value=median("over_known")),
    Column("over_worst", "over known, worst", "cm", ".1f", value=largest("over_known")),
)  # fmt: skip
_ASKED = {"thrust": "1 %", "thrust over mass": "–", "mass": "1 %", "motor lag": "8 ms", "drag": "15 %",
          "axial drag": "–", "pose latency": "3 ms"}  # fmt: skip


def draw_vehicle(seed: int, nominal: Airframe) -> DrawnVehicle:
    """Draw the vehicle of a seed around `nominal`."""
    chance = np.random.default_rng(_FIRST_SEED + seed)
    drag = float(np.exp(chance.uniform(*np.log(DRAGS))))
    airframe = replace(
        nominal,
        mass=nominal.mass * (1 + chance.uniform(-MASS, MASS)),
        motor_time_constant=float(chance.uniform(*LAGS)),
        drag=(nominal.drag[0] * drag, nominal.drag[1] * drag),
        thrust_scale=nominal.thrust_scale * (1 + chance.uniform(-THRUST, THRUST)),
    )
    latency = float(chance.uniform(*LATENCIES))
    roll, pitch = (moment * (1 + chance.uniform(-MOMENT, MOMENT)) for moment in nominal.velocity_moment)
    return DrawnVehicle(seed, replace(airframe, velocity_moment=(roll, pitch)), latency)


def unknown_vehicle(limits: Limits) -> Limits:
    """Return limits whose airframe states how widely vehicles are drawn, so that the hover check lets them fly."""
    spread = replace(limits.airframe.spread, mass=MASS + 0.02, thrust_scale=THRUST + 0.02, velocity_moment=MOMENT)
    return replace(limits, airframe=replace(limits.airframe, spread=spread))


def fly_drawn(drawn: DrawnVehicle, mission: Mission, folder: Path, seed: int) -> tuple[Record, SteppedFlight]:
    """Fly a mission on a drawn vehicle in the stepped lab; return its record as read back, and the truth."""
    lab = SteppedLab(
        drawn.airframe,
        vehicle=VehicleSettings(seed=seed, auto_arming=False),
        cameras=ViconSettings(latency=drawn.latency, announced_latency=0.0, seed=seed),
        seed=seed,
    )
    header = header_under(
        mission.limits,
        name="identify",
        uri="stepped://0",
        path=decode(mission.payloads).position[::5],
        travel_time=mission.motion_ends,
    )
    with RecordWriter(folder, header, clock=lab.clock) as writer:
        flown = fly_stepped(Scenario("identification", Rung.NONE), mission, listen=writer.write, lab=lab)
    return read_record(folder), flown


def work(settings: Settings, run: Run) -> Work:
    """Return one case per vehicle: its seed. Raises what planning raises."""
    limits = unknown_vehicle(limits_for(settings.path_file))
    missions = prepare_mission(settings.path_file, limits), prepare_mission(settings.next_file, limits)
    cases = {str(seed): seed for seed in range(settings.seed, settings.seed + settings.vehicles)}
    return Work(cases, partial(measure, missions=missions, next_file=settings.next_file), StudiedVehicle)


def measure(seed: int, missions: tuple[Mission, Mission], next_file: Path) -> StudiedVehicle:
    """Identify the vehicle of a seed, and fly the next path with the result. Raises what planning raises."""
    mission, unknown = missions
    drawn = draw_vehicle(seed, mission.limits.airframe)
    weighed = round(drawn.airframe.mass / SCALE_STEP) * SCALE_STEP
    with tempfile.TemporaryDirectory() as folder:
        record, flown = fly_drawn(drawn, mission, Path(folder) / "first", 3 * seed)
        try:
            found, unweighed = identify([record], mass=weighed), identify([record])
        except CfplanError as error:
            return StudiedVehicle(seed, flown.reason, str(error))
        errors, uncertainties = _errors(found, drawn, mission.limits.airframe)
        believed = {
            "unknown": mission.limits,
            "identified": _limits_of(mission.limits, found),
            "identified, not weighed": _limits_of(mission.limits, unweighed),
            "known": _limits(mission.limits, drawn.airframe, drawn.latency),
        }
        deviations = {}
        for name, limits in believed.items():
            next_mission = unknown if limits is mission.limits else prepare_mission(next_file, limits)
            place = Path(folder) / name.replace(" ", "-")
            deviations[name] = _deviation(fly_drawn(drawn, next_mission, place, 3 * seed + 1)[1], next_mission)
    return StudiedVehicle(seed, flown.reason, "", errors, uncertainties, deviations)


def _limits_of(limits: Limits, found: Identification) -> Limits:
    return _limits(limits, found.airframe, found.pose_latency)


def _limits(limits: Limits, airframe: Airframe, latency: float) -> Limits:
    """Return the limits that the same safety.yaml gives for another vehicle and latency."""
    least, most = limits.airframe.thrust_range
    reserve = (limits.plan.motor_thrust_min - least) / (most - least)
    plan = replace(limits.plan, **within_reserve(airframe, reserve))
    return replace(limits, airframe=airframe, plan=plan, pose=replace(limits.pose, latency=latency))


def _errors(found: Identification, drawn: DrawnVehicle, nominal: Airframe) -> tuple[dict[str, float], dict[str, float]]:
    """Return errors and stated uncertainties, in % or ms, by quantity."""
    true, quantities = drawn.airframe, found.quantities
    ratio, thrust = (true.thrust_scale / true.mass) / (nominal.thrust_scale / nominal.mass), true.thrust_scale
    truths = {
        "thrust": (quantities["thrust scale"], thrust, 100 / thrust),
        "thrust over mass": (quantities["thrust over mass"], ratio, 100 / ratio),
        "mass": (quantities["mass"], true.mass, 100 / true.mass),
        "motor lag": (quantities["motor lag"], true.motor_time_constant, 1e3),
        "drag": (quantities["drag"], true.drag[0], 100 / true.drag[0]),
        "axial drag": (quantities["axial drag"], true.drag[1], 100 / true.drag[1]),
        "pose latency": (quantities["pose latency"], drawn.latency, 1e3),
    }
    errors = {name: scale * (quantity.value - truth) for name, (quantity, truth, scale) in truths.items()}
    return errors, {name: scale * quantity.deviation for name, (quantity, _, scale) in truths.items()}


def _deviation(flown: SteppedFlight, mission: Mission) -> float:
    """Return the largest true distance, m, from the setpoint of the same time on the plan; NaN if it did not land."""
    outcome, truth = flown.outcome, flown.truth
    if outcome is None or outcome.exit_code is not ExitCode.OK:
        return float("nan")
    elapsed = truth.time - outcome.first_setpoint
    moving = (elapsed >= 0.0) & (elapsed <= mission.motion_ends)
    planned = decode(mission.payloads).position
    due = np.arange(len(planned)) / mission.rate
    wanted = np.column_stack([np.interp(elapsed[moving], due, axis) for axis in planned.T])
    return float(np.linalg.norm(truth.position[moving] - wanted, axis=1).max())


def tables(settings: Settings, rows: list[StudiedVehicle]) -> Iterator[Table]:
    """Yield the errors of identification, and the deviations of the next flights."""
    done = [vehicle for vehicle in rows if not vehicle.reason]
    title = f"Identified from one flight each, {len(done)} of {len(rows)} vehicles, moment ±{100 * MOMENT:.0f} %"
    yield table("errors", title, ERROR_COLUMNS, list(_accuracy(done)))
    yield table("next-flight", "The next flight", NEXT_COLUMNS, list(_next_flights(done)), by=("vehicle",))


def _accuracy(done: Sequence[StudiedVehicle]) -> Iterator[dict[str, Any]]:
    for name, asked in _ASKED.items() if done else ():
        errors = np.array([vehicle.errors[name] for vehicle in done])
        stated = [vehicle.uncertainties[name] for vehicle in done]
        unit = "ms" if name in ("motor lag", "pose latency") else "%"
        figures = {
            "median": np.median(np.abs(errors)),
            "worst": np.abs(errors).max(),
            "bias": errors.mean(),
            "uncertainty": np.median(stated),
        }
        shown = {key: f"{value:.2f} {unit}" if np.isfinite(value) else "" for key, value in figures.items()}
        yield {"quantity": name, "asked": asked, **shown}


@dataclass(frozen=True, slots=True)
class _NextFlight:
    vehicle: str  # the parameters that the flight was planned with
    deviation: float  # m; NaN where it did not land
    over_known: float  # m, in excess of the same vehicle's flight with known parameters


def _next_flights(done: Sequence[StudiedVehicle]) -> Iterator[_NextFlight]:
    for vehicle in done:
        for name, deviation in vehicle.deviations.items():
            yield _NextFlight(name, deviation, deviation - vehicle.deviations["known"])


STUDY = Study(
    Settings, work, tables, "flights/identify.yaml flights/figure8.yaml --vehicles 5 -o results/identification.json"
)
