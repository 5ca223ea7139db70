"""Predict the public flights in FOLDER by the dry run's physics, and compare with the measured motion.

Each flight starts from its log's first record and is flown closed loop with the gains that flew. Nothing is fitted to
the deviation. Held out: parameters are those of other flights of the family; only the thrust scale is the flight's own,
of its first second. The logs are not kept here.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from cfplan.identification.measured import Measured, measure, pooled, thrust_scale
from cfplan.identification.replay import Recomputed, recompute, refine_start
from cfplan.identification.validate import Comparison, compare, poses_of, predict, without_pieces
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.airframes import AIRFRAMES
from studies.real_flights_data import ARM, THRUST_TO_TORQUE, PublicFlight, flights_of, read_flight
from studies.runner.options import argument
from studies.runner.reductions import count, largest, median, smallest
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

OWN, HELD_OUT = "its own", "held out"
LADDER = (
    "as without real flights", "+ thrust scale", "+ drag, lag, inertia, lift", "+ estimator", "+ moment",
)  # fmt: skip
_TRAINED = 3  # every third flight of a family is one that others are predicted by
_AIRFRAMES = {
    "brushless, Lee": "crazyflie-2.1-brushless", "brushed upgrade, Lee": "crazyflie-thrust-upgrade",
    "brushed, Lee": "crazyflie-2.1+", "brushed, Mellinger": "crazyflie-2.1+",
}  # fmt: skip
# 1/V: public flights without battery compensation lose 3.9 % of thrust per 0.1 V.
_WITHOUT_COMPENSATION, _SAG = ("brushless, Lee",), 0.39


@dataclass(frozen=True, slots=True)
class Settings:
    """The folder of the flights."""

    folder: Path = argument()


@dataclass(frozen=True, slots=True)
class PredictedFlight:
    """One flight predicted by one model."""

    flight: str
    family: str
    model: str  # OWN, HELD_OUT, a rung of LADDER, or "without" a piece of physics
    ratio: float = math.nan  # predicted over measured rms distance from the reference
    largest_ratio: float = math.nan
    correlation: float = math.nan
    explained: float = math.nan  # fraction of the deviation's variance
    measured_rms: float = math.nan  # m
    commands: float = math.nan  # fraction of the logged commands' variance that the stated gains explain
    scale: float = math.nan
    drag: float = math.nan  # 1/s, over the mass
    roll_moment: float = math.nan  # N m per m/s
    pitch_moment: float = math.nan
    lag: float = math.nan  # s
    inertia: float = math.nan  # kg m², about x
    lift: float = math.nan  # 1/(m/s)²
    velocity_error: float = math.nan  # m/s rms of the estimate against motion capture
    tilt_error: float = math.nan  # rad

    @property
    def near(self) -> bool:
        """Return whether the rms is within 20 %."""
        return abs(self.ratio - 1.0) <= 0.2

    @property
    def largest_near(self) -> bool:
        """Return whether the largest distance is within 20 %."""
        return abs(self.largest_ratio - 1.0) <= 0.2

    @property
    def correlates(self) -> bool:
        """Return whether predicted and measured deviations correlate by 0.95."""
        return self.correlation >= 0.95


def airframe_of(flight: PublicFlight) -> Airframe:
    """Return the prior knowledge of a flight's vehicle: its kind, and its mass as weighed."""
    kind = AIRFRAMES[_AIRFRAMES[flight.family]]
    return replace(
        kind,
        mass=flight.mass,
        drag=(kind.drag[0] / kind.mass * flight.mass, kind.drag[1] / kind.mass * flight.mass),
        arm=ARM,
        thrust_to_torque=THRUST_TO_TORQUE,
        voltage_sag=_SAG if flight.family in _WITHOUT_COMPENSATION else 0.0,
    )


def work(settings: Settings, run: Run) -> Work:
    """Return one case per flight; flights of the other families' training are measured here. Raises InputError."""
    files = flights_of(settings.folder)
    families: dict[str, list[str]] = {}
    for name, file in files.items():
        families.setdefault(read_flight(file).family, []).append(name)
    training = {name for names in families.values() if len(names) > 1 for name in names[::_TRAINED]}
    known: dict[str, list[Measured]] = {}
    for number, name in enumerate(sorted(training)):
        flight = begun(read_flight(files[name]))
        known.setdefault(flight.family, []).append(measure(flight.log, airframe_of(flight)))
        run.progress(number + 1, len(training))
    return Work(files, partial(predict_flight, known=known, training=training), PredictedFlight)


def begun(flight: PublicFlight) -> PublicFlight:
    """Return the flight with its reference begun where it explains the commands best, within 20 ms of the stated."""
    return replace(flight, reference=refine_start(flight.log, flight.reference, flight.controller, airframe_of(flight)))


def predict_flight(file: Path, known: Mapping[str, list[Measured]], training: set[str]) -> list[PredictedFlight]:
    """Predict a flight by every model."""
    flight = begun(read_flight(file))
    kind = airframe_of(flight)
    recomputed = recompute(flight.log, flight.reference, flight.controller, kind)
    measured = measure(flight.log, kind)
    rows = [_row(flight, OWN, _compared(flight, recomputed, measured.airframe), recomputed, measured)]
    if flight.name not in training and flight.family in known:
        theirs = pooled(known[flight.family], kind)
        own_scale = replace(theirs, thrust_scale=thrust_scale(flight.log, theirs))
        rows.append(_row(flight, HELD_OUT, _compared(flight, recomputed, own_scale)))
    for name, (airframe, estimator) in rungs(kind, measured.airframe).items():
        rows.append(_row(flight, name, _compared(flight, recomputed, airframe, estimator)))
    for piece, (airframe, estimator) in without_pieces(measured.airframe).items():
        rows.append(_row(flight, f"without {piece}", _compared(flight, recomputed, airframe, estimator)))
    return rows


def rungs(kind: Airframe, found: Airframe) -> dict[str, tuple[Airframe, bool]]:
    """Return the models between the kind's airframe on the true state and the measured one, and whether they estimate.

    Each adds a piece of physics.
    """
    plain = replace(kind.simplified(), voltage_sag=kind.voltage_sag)
    scaled = replace(plain, thrust_scale=found.thrust_scale, thrust_curvature=found.thrust_curvature)
    still = replace(found, velocity_moment=(0.0, 0.0))
    models = ((plain, False), (scaled, False), (still, False), (still, True), (found, True))
    return dict(zip(LADDER, models, strict=True))


def _compared(flight: PublicFlight, recomputed: Recomputed, airframe: Airframe, estimator: bool = True) -> Comparison:
    poses = poses_of(flight.log)
    predicted = predict(
        flight.log, flight.reference, flight.controller, airframe, recomputed, poses, estimator=estimator
    )  # fmt: skip
    return compare(flight.log, flight.reference, predicted)


def _row(
    flight: PublicFlight, model: str, comparison: Comparison, recomputed: Recomputed | None = None,
    measured: Measured | None = None,
) -> PredictedFlight:  # fmt: skip
    row = PredictedFlight(
        flight.name, flight.family, model, comparison.ratio, comparison.largest_ratio, comparison.correlation,
        comparison.explained, comparison.measured_rms,
    )  # fmt: skip
    if measured is None or recomputed is None:
        return row
    found, airframe = measured.found, measured.airframe

    def if_found(key: str, value: float) -> float:
        return value if key in found else math.nan

    return replace(
        row,
        commands=recomputed.explained,
        scale=airframe.thrust_scale,
        drag=if_found("drag", airframe.drag[0] / airframe.mass),
        roll_moment=if_found("roll moment", airframe.velocity_moment[0]),
        pitch_moment=if_found("pitch moment", airframe.velocity_moment[1]),
        lag=if_found("motor lag", airframe.motor_time_constant),
        inertia=if_found("roll inertia", airframe.inertia[0]),
        lift=if_found("lift with speed", airframe.lift_with_speed),
        velocity_error=measured.estimate.get("velocity", math.nan),
        tilt_error=measured.estimate.get("tilt", math.nan),
    )


_AGREEMENT = (
    Column("flights", "flights", value=count()),
    Column("ratio", "ratio", "", ".2f", meaning="of the predicted to the measured rms distance, median",
           value=median("ratio")),
    Column("near", "rms within 20 %", of="flights", value=count("near")),
    Column("largest_near", "largest within 20 %", of="flights", value=count("largest_near")),
    Column("correlation", "correlation", "", ".3f", meaning="of all three axes' deviations, median",
           value=median("correlation")),
    Column("correlates", "above 0.95", of="flights", value=count("correlates")),
    Column("explained", "explained", "%", ".0f", meaning="of the deviation's variance, median",
           value=median("explained")),
)  # fmt: skip
_FAMILY = Column("family", "vehicle, controller")
PARAMETERS = (
    _FAMILY,
    Column("flights", "flights", value=count()),
    Column("commands", "commands explained", "%", ".1f", meaning="least, by the gains as flown",
           value=smallest("commands")),
    Column("scale", "thrust scale", "", ".2f", meaning="given over asked for in hover, median", value=median("scale")),
    Column("scale_low", "least", "", ".2f", value=smallest("scale")),
    Column("scale_high", "most", "", ".2f", value=largest("scale")),
    Column("drag", "drag / mass", "1/s", ".2f", value=median("drag")),
    Column("roll", "roll moment", "10⁻⁴ N m per m/s", ".1f", value=lambda rows: 1e4 * median("roll_moment")(rows)),
    Column("pitch", "pitch moment", "10⁻⁴ N m per m/s", ".1f",
           value=lambda rows: 1e4 * median("pitch_moment")(rows)),
    Column("lag", "lag", "ms", ".0f", value=median("lag")),
    Column("inertia", "inertia x", "10⁻⁵ kg m²", ".1f", value=lambda rows: 1e5 * median("inertia")(rows)),
    Column("lift", "lift", "% per (m/s)²", ".1f", value=lambda rows: 1e2 * median("lift")(rows)),
    Column("velocity_error", "velocity error", "m/s", ".2f",
           meaning="rms of the estimate against motion capture", value=median("velocity_error")),
    Column("tilt_error", "tilt error", "°", ".1f", meaning="likewise, less its mean",
           value=lambda rows: float(np.degrees(median("tilt_error")(rows)))),
)  # fmt: skip
FLIGHTS = (
    Column("flight", "flight"),
    _FAMILY,
    Column("measured_rms", "measured", "cm", ".1f", meaning="rms distance from the reference"),
    Column("ratio", "ratio", "", ".2f"),
    Column("largest_ratio", "of largest", "", ".2f"),
    Column("correlation", "correlation", "", ".3f"),
    Column("held_out", "held out: ratio", "", ".2f"),
)


def tables(settings: Settings, rows: list[PredictedFlight]) -> Iterator[Table]:
    """Yield agreement held out and of each flight's own parameters, the ladder, the ablation, parameters, flights."""
    of = {model: [row for row in rows if row.model == model] for model in dict.fromkeys(row.model for row in rows)}
    for name, title, model in (
        ("held-out", "Held out: parameters of every third flight of a family, judged on the others", HELD_OUT),
        ("own", "Parameters measured in each flight itself", OWN),
    ):
        yield table(name, title, [_FAMILY, *_AGREEMENT], of.get(model, []), by=("family",), last="all")
    for name, title, models in (
        ("ladder", "Physics, cumulative", list(LADDER)),
        ("ablation", "The full model without one piece", [model for model in of if model.startswith("without")]),
    ):
        each = [row for model in models for row in of.get(model, [])]
        each += [replace(row, family="all") for row in each]
        columns = [Column("model", "model"), _FAMILY, *_AGREEMENT]
        yield table(name, title, columns, sorted(each, key=lambda row: models.index(row.model)), by=("model", "family"))
    yield table("parameters", "What the flights show of the vehicles", PARAMETERS, of.get(OWN, []), by=("family",))
    held = {row.flight: row.ratio for row in of.get(HELD_OUT, [])}
    listed = [
        {each.key: held.get(row.flight, math.nan) if each.key == "held_out" else getattr(row, each.key)
         for each in FLIGHTS} for row in of.get(OWN, [])
    ]  # fmt: skip
    yield table("flights", "Each flight", FLIGHTS, listed)


STUDY = Study(Settings, work, tables, "public-flights -o results/real-flights.json")
