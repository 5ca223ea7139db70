"""Identify drawn vehicles from one flight each in the stepped lab, and fly on with what was found.

Mass, motor lag, drag, thrust and the poses' latency are drawn by seeds. Each vehicle flies flights/identify.yaml as if
it were the one of safety.yaml; its record, read back from its file, is all that identification sees. Then every
vehicle flies another path three times: as unknown as before, as identified, and as if all were known.
"""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
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
from cfplan.preparation.plan_flight import FlightOptions
from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.recording.header import header_under
from cfplan.recording.reader import read_record
from cfplan.recording.record import Record
from cfplan.recording.writer import RecordWriter
from cfplan.safety.limits import Limits, within_reserve
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from studies.fault_scenarios import Scenario
from studies.faults import SteppedFlight, fly_stepped
from studies.runner.result import Column, StudyResult, Table, detail_table
from cfplan.vehicle.airframe import Airframe

MASS, THRUST = 0.10, 0.08  # by which they are off at most, relative
LAGS, DRAGS, LATENCIES = (0.06, 0.14), (0.5, 2.0), (0.005, 0.040)  # s, factor, s
SCALE_STEP = 1e-4  # kg, of the scale that weighs the vehicle
_FIRST_SEED = 1000

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
    Column("flights", "flights"),
    Column("landed", "landed", of="flights", meaning="at the end of the plan"),
    Column("median", "deviation, median", "cm", ".1f", meaning="of each flight's largest true distance from the plan"),
    Column("worst", "worst", "cm", ".1f"),
    Column("over_median", "over known, median", "cm", ".1f", meaning="against the same vehicle, known"),
    Column("over_worst", "over known, worst", "cm", ".1f"),
)
_ASKED = {"thrust": "1 %", "thrust over mass": "–", "mass": "1 %", "motor lag": "8 ms", "drag": "15 %",
          "axial drag": "–", "pose latency": "3 ms"}  # fmt: skip


@dataclass(frozen=True, slots=True)
class DrawnVehicle:
    """A vehicle that differs from what its lab believes."""

    seed: int
    airframe: Airframe
    latency: float  # s, of the poses


@dataclass(frozen=True, slots=True)
class StudiedVehicle:
    """What was found of it, and how it flew; NaN where it did not."""

    seed: int
    errors: dict[str, float]  # by the keys of _ASKED, in the units of the table
    uncertainties: dict[str, float]
    deviations: dict[str, float]  # m, of the next flight, by how the vehicle was known
    first_flight: str  # how it ended
    reason: str = ""  # why there is nothing


def draw_vehicle(seed: int, nominal: Airframe) -> DrawnVehicle:
    """Draw the vehicle of a seed around `nominal`."""
    chance = np.random.default_rng(_FIRST_SEED + seed)
    drag = float(np.exp(chance.uniform(*np.log(DRAGS))))
    airframe = replace(
        nominal,
        mass=nominal.mass * (1 + chance.uniform(-MASS, MASS)),
        motor_time_constant=float(chance.uniform(*LAGS)),
        drag=(nominal.drag[0] * drag, nominal.drag[1] * drag),
        motor_thrust_max=nominal.motor_thrust_max * (1 + chance.uniform(-THRUST, THRUST)),
    )
    return DrawnVehicle(seed, airframe, float(chance.uniform(*LATENCIES)))


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


def identification(
    path_file: Path,
    next_file: Path,
    find_safety_file: Callable[[Path], Path],
    *,
    vehicles: int = 30,
    first_seed: int = 0,
    speed_factor: float | None = None,
    jobs: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Identify `vehicles` drawn ones along `path_file`, and fly `next_file` with what was found.

    Raises what planning raises.
    """
    from joblib import Parallel, delayed

    limits = load_limits(find_safety_file(path_file))
    options = FlightOptions(speed_factor=speed_factor)
    missions = prepare_mission(path_file, limits, options), prepare_mission(next_file, limits)
    study = partial(_study, missions=missions, next_file=next_file)
    seeds = range(first_seed, first_seed + vehicles)
    studied: list[StudiedVehicle] = []
    work = Parallel(n_jobs=jobs, return_as="generator")(delayed(study)(seed) for seed in seeds)
    for done, vehicle in enumerate(work):
        progress(done + 1, vehicles)
        studied.append(vehicle)
    settings = {
        "path": path_file.stem, "next": next_file.stem, "vehicles": vehicles, "first_seed": first_seed,
        "speed_factor": speed_factor, "mass": MASS, "thrust": THRUST, "lags": LAGS, "drags": DRAGS,
        "latencies": LATENCIES,
    }  # fmt: skip
    rows = [
        {"seed": v.seed, "first_flight": v.first_flight, "reason": v.reason, **v.errors}
        | {f"next flight, {name}": value for name, value in v.deviations.items()}
        for v in studied
    ]
    return StudyResult("identification", settings, _tables(studied), (detail_table("vehicles", rows),))


def _study(seed: int, missions: tuple[Mission, Mission], next_file: Path) -> StudiedVehicle:
    mission, unknown = missions
    drawn = draw_vehicle(seed, mission.limits.airframe)
    weighed = round(drawn.airframe.mass / SCALE_STEP) * SCALE_STEP
    with tempfile.TemporaryDirectory() as folder:
        record, flown = fly_drawn(drawn, mission, Path(folder) / "first", 3 * seed)
        try:
            found, unweighed = identify([record], mass=weighed), identify([record])
        except CfplanError as error:
            return StudiedVehicle(seed, {}, {}, {}, flown.reason, str(error))
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
    return StudiedVehicle(seed, errors, uncertainties, deviations, flown.reason)


def _limits_of(limits: Limits, found: Identification) -> Limits:
    return _limits(limits, found.airframe, found.pose_latency)


def _limits(limits: Limits, airframe: Airframe, latency: float) -> Limits:
    """Return the limits as the same safety.yaml gives them for another vehicle and latency."""
    old = limits.airframe
    reserve = (limits.plan.motor_thrust_min - old.motor_thrust_min) / (old.motor_thrust_max - old.motor_thrust_min)
    plan = replace(limits.plan, **within_reserve(airframe, reserve))
    return replace(limits, airframe=airframe, plan=plan, pose=replace(limits.pose, latency=latency))


def _errors(found: Identification, drawn: DrawnVehicle, nominal: Airframe) -> tuple[dict[str, float], dict[str, float]]:
    """Return errors and stated uncertainties in %, ms."""
    true, quantities = drawn.airframe, found.quantities
    ratio = (true.motor_thrust_max / true.mass) / (nominal.motor_thrust_max / nominal.mass)
    thrust = true.motor_thrust_max / nominal.motor_thrust_max
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
    """Return the largest true distance, m, from the setpoint of the moment along the plan; NaN if it did not land."""
    outcome, truth = flown.outcome, flown.truth
    if outcome is None or outcome.exit_code is not ExitCode.OK:
        return float("nan")
    elapsed = truth.time - outcome.first_setpoint
    moving = (elapsed >= 0.0) & (elapsed <= mission.motion_ends)
    planned = decode(mission.payloads).position
    due = np.arange(len(planned)) / mission.rate
    wanted = np.column_stack([np.interp(elapsed[moving], due, axis) for axis in planned.T])
    return float(np.linalg.norm(truth.position[moving] - wanted, axis=1).max())


def _tables(studied: Sequence[StudiedVehicle]) -> tuple[Table, ...]:
    done = [vehicle for vehicle in studied if not vehicle.reason]
    return (
        Table(
            "errors", f"Identified from one flight each, {len(done)} vehicles", ERROR_COLUMNS, tuple(_accuracy(done))
        ),
        Table("next-flight", "The next flight", NEXT_COLUMNS, tuple(_next_flights(done))),
    )


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


def _next_flights(done: Sequence[StudiedVehicle]) -> Iterator[dict[str, Any]]:
    for name in done[0].deviations if done else ():
        deviations = np.array([vehicle.deviations[name] for vehicle in done])
        over = deviations - np.array([vehicle.deviations["known"] for vehicle in done])
        yield {
            "vehicle": name,
            "flights": len(deviations),
            "landed": int(np.isfinite(deviations).sum()),
            "median": np.nanmedian(deviations),
            "worst": np.nanmax(deviations),
            "over_median": np.nanmedian(over),
            "over_worst": np.nanmax(over),
        }
