"""Plans as Parquet files: samples for any reader, and metadata for certifying the plan again.

Path and profile are stored exactly (JSON floats read back identically), so a loaded plan equals the saved one. The
certificate in the file is for other readers; loading certifies again.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from cfplan.errors import CfplanError, InputError
from cfplan.files.atomic import atomic_output
from cfplan.geometry.path import Path
from cfplan.geometry.polynomials import derivatives_on
from cfplan.planning.plan_result import LocalSlowing, Plan
from cfplan.safety.certificate import certify
from cfplan.safety.limits import Limits
from cfplan.safety.speed_caps import SpeedCaps
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import FullState, Trajectory
from cfplan.version import __version__

FORMAT = 2  # its keys "slowed" and "speed_share" are a Plan's repair_speed_factor and speed_factor
RATE = 100  # Hz, of the samples
_KEY = b"cfplan"
_AXES = ("x", "y", "z", "w")
_HINT = "make it again with `cfplan plan`"
_JUMP_TOLERANCE = 1e-6  # largest allowed jump / (1 + |value|), of the position and each derivative


def save_plan(plan: Plan, file: FilePath | str, provenance: Mapping[str, str] | None = None) -> None:
    """Write the plan atomically.

    Raises:
        InputError: the file cannot be written.
    """
    import pyarrow
    import pyarrow.parquet

    metadata = {
        "format": FORMAT,
        "version": __version__,
        "planner": plan.planner,
        "nodes": plan.nodes,
        "slowed": plan.repair_speed_factor,
        "speed_share": plan.speed_factor,
        "seconds": plan.seconds,
        "notes": list(plan.notes),
        "joints": list(plan.joints),
        "slowing": None if plan.slowing is None else asdict(plan.slowing),
        "provenance": dict(provenance or {}),
        "certificate": plan.certificate.to_dict(),
        "airframe": asdict(plan.airframe),
        "limits": asdict(plan.limits),
        "path": {"breaks": plan.path.breaks.tolist(), "coefficients": plan.path.coefficients.tolist()},
        "profile": {f.name: getattr(plan.profile, f.name).tolist() for f in fields(SpeedProfile)},
    }
    # From their memory: pyarrow's own way from numpy imports pandas where that is installed, for a fifth of a second.
    columns = {
        name: pyarrow.Array.from_buffers(pyarrow.float64(), len(values), [None, pyarrow.py_buffer(values)])
        for name, values in _columns(plan.trajectory).items()
    }
    table = pyarrow.table(columns)
    table = table.replace_schema_metadata({_KEY: json.dumps(metadata).encode()})
    with atomic_output(FilePath(file)) as unfinished:
        pyarrow.parquet.write_table(table, unfinished, compression="zstd")


def load_plan(file: FilePath | str) -> Plan:
    """Load a plan and certify it again.

    Raises:
        InputError: missing, truncated, not a plan, of another format, or inconsistent.
    """
    import pyarrow
    import pyarrow.parquet

    where = str(file)
    try:
        if FilePath(file).is_fifo():
            raise InputError("a pipe, not a file", where=where, hint="name a plan that cfplan has written")
        table = pyarrow.parquet.read_table(file)
    except FileNotFoundError:
        raise InputError("no such file", where=where, hint="make it with `cfplan plan PATH -o FILE`") from None
    except (OSError, pyarrow.ArrowException) as error:
        raise InputError(f"not a plan, or cut off: {_one_line(error)}", where=where, hint=_HINT) from None
    try:
        metadata = json.loads((table.schema.metadata or {})[_KEY])
        if metadata["format"] != FORMAT:
            raise InputError(f"a plan of format {metadata['format']}, not {FORMAT}", where=where, hint=_HINT)
        plan = _rebuilt(metadata)
        _check_samples(plan, table, where)
    except KeyError as error:
        raise InputError(f"not a plan of cfplan: {error} is missing", where=where, hint=_HINT) from None
    except CfplanError as error:
        raise InputError(error.what, where=where, hint=error.hint or _HINT) from None
    except (ValidationError, ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise InputError(f"not a sound plan: {_one_line(error)}", where=where, hint=_HINT) from None
    return plan


def _rebuilt(metadata: dict[str, Any]) -> Plan:
    airframe = TypeAdapter(Airframe).validate_python(metadata["airframe"])
    limits = TypeAdapter(Limits).validate_python(metadata["limits"])
    path = Path(np.array(metadata["path"]["breaks"]), np.array(metadata["path"]["coefficients"]))
    profile = SpeedProfile(**{f.name: np.array(metadata["profile"][f.name], dtype=float) for f in fields(SpeedProfile)})
    if not (jump := _jump(path)) <= _JUMP_TOLERANCE:
        raise ValueError(f"its path jumps by {jump:.3g} between two pieces")
    trajectory = Trajectory(path, profile, airframe)
    joints = tuple(map(float, metadata.get("joints", ())))  # older files have none
    if not all(0.0 < joint < path.end for joint in joints):
        raise ValueError("a joint lies outside the path")
    slowing = _rebuilt_slowing(metadata.get("slowing"), path)
    return Plan(
        path=path,
        airframe=airframe,
        limits=limits,
        trajectory=trajectory,
        certificate=certify(trajectory, limits.plan, limits.space, slowing.caps if slowing else None),
        planner=str(metadata["planner"]),
        nodes=int(metadata["nodes"]),
        repair_speed_factor=float(metadata["slowed"]),
        speed_factor=float(metadata["speed_share"]),
        seconds=float(metadata["seconds"]),
        notes=tuple(map(str, metadata["notes"])),
        joints=joints,
        slowing=slowing,
    )


def _jump(path: Path) -> float:
    """Return the largest jump / (1 + |value|) between two pieces, of the path and its first three derivatives."""
    at, left = path.breaks[1:-1], np.arange(len(path.breaks) - 2)
    before, behind = (derivatives_on(path.origins, path.coefficients, at, piece)[:4] for piece in (left, left + 1))
    return float(np.max(np.abs(before - behind) / (1.0 + np.abs(before)), initial=0.0))


def _rebuilt_slowing(slowing: dict[str, Any] | None, path: Path) -> LocalSlowing | None:
    """Return the slowing of a file; None if it has none, like older files."""
    if slowing is None:
        return None
    caps = SpeedCaps.of(slowing["caps"]["s"], slowing["caps"]["speed"])
    if not caps.lie_within(path.end):
        raise ValueError("a speed cap lies outside the path")
    return LocalSlowing(caps, float(slowing["before"]), tuple(map(str, slowing["reasons"])))


def _times(trajectory: Trajectory) -> np.ndarray:
    return np.append(np.arange(np.ceil(trajectory.duration * RATE)) / RATE, trajectory.duration)


def _columns(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Return the samples as columns, vectors by their components."""
    state = trajectory.at(_times(trajectory))
    columns = {}
    for field in fields(FullState):
        values = np.ascontiguousarray(getattr(state, field.name).T)
        if values.ndim == 1:
            columns[field.name] = values
        else:
            labels = _AXES if field.name != "motor_thrust" else ("1", "2", "3", "4")
            columns |= {f"{field.name}_{label}": row for label, row in zip(labels, values, strict=False)}
    return columns


def _check_samples(plan: Plan, table: Any, where: str) -> None:
    """Check that the samples agree with the plan."""
    if table.num_rows != len(_times(plan.trajectory)):
        raise InputError("its samples are not those of its plan", where=where, hint=_HINT)
    columns = _columns(plan.trajectory)
    if set(table.column_names) != set(columns):
        raise InputError("its columns are not those of a plan", where=where, hint=_HINT)
    for name, expected in columns.items():
        found = table[name].to_numpy()
        scale = 1.0 + float(np.max(np.abs(expected)))
        if found.dtype.kind != "f" or not np.all(np.abs(found - expected) <= 1e-6 * scale):
            raise InputError(f"its samples of {name} are not those of its plan", where=where, hint=_HINT)


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 160 else f"{text[:157]}..."
