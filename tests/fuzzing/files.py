"""The files that people write and that cfplan writes: how an absurd one is made, and what reads it.

A reader here is what a command does with a file: it reads it and goes on with what it has read, so that what is absurd
and not refused must also do no harm behind the reading.
"""

import json
import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Any
from zlib import crc32

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from cfplan.geometry.path_file import load_path_file
from cfplan.planning.plan_file import load_plan, save_plan
from cfplan.preparation.plan_flight import FlightOptions, plan_flight
from cfplan.recording import writer
from cfplan.recording.header import header_of_plan
from cfplan.recording.overlay import reference_of, trial_of_record
from cfplan.recording.reader import read_record
from cfplan.recording.report.page import write_page
from cfplan.recording.report.report import flight_to_dict, read_flight
from cfplan.recording.rerun.overlay_view import write_overlay
from cfplan.recording.rerun.record_view import write_rrd
from cfplan.recording.summary import summary_text
from cfplan.safety.limits_file import load_limits
from tests.fuzzing.mutations import json_of, spoil_bytes, spoil_text, spoil_tree, yaml_of
from tests.recording import conftest as flight

REPOSITORY = Path(__file__).parents[2]
SAFETY, LINE = REPOSITORY / "safety.yaml", REPOSITORY / "flights" / "line.yaml"
_LONGEST_PLANNED = 30.0  # m: planning takes its time on longer ones


@dataclass(frozen=True)
class Reader:
    """One kind of input: `sound` is made once, `spoil` puts an absurd one into an empty folder, `use` reads it."""

    sound: Callable[[Path], Any]
    spoil: Callable[[Any, Random, Path], None]
    use: Callable[[Path], object]
    weight: float = 1.0  # of all inputs, how many are for this reader


def spoiled_yaml(content: bytes, chance: Random) -> bytes:
    """Return a YAML file with mistakes in its tree, its text or its bytes."""
    kind = chance.randrange(4)
    if kind < 2:
        return yaml_of(spoil_tree(yaml.safe_load(content), chance), chance)
    return (spoil_bytes if kind == 2 else spoil_text)(content, chance)


def _plan_once() -> None:
    """Plan by the planners that inputs are given to, so that what they need is compiled."""
    for planner in ("convex", "expert"):
        plan_flight(LINE, load_limits(SAFETY), FlightOptions(planner, nodes=30))


def _is_planned(folder: Path) -> bool:
    """Return whether an input that is read is planned with too, which takes longer: one in four, by its content."""
    return crc32(b"".join(file.read_bytes() for file in sorted(folder.iterdir()))) % 4 == 0


# Paths, points, polynomials


def _flights(kind: str, _: Path) -> list[dict[str, bytes]]:
    """Return path files that give waypoints, points or polynomials, each with the table that it names."""
    _plan_once()
    found = []
    for file in sorted((REPOSITORY / "flights").glob("*.yaml")):
        content = yaml.safe_load(file.read_bytes())
        if kind in content:
            files = {"path.yaml": file.read_bytes()}
            if kind != "waypoints":
                name = content[kind]
                files[name] = (file.parent / name).read_bytes()
            found.append(files)
    return found


def _timed(folder: Path) -> list[dict[str, bytes]]:
    """Return path files that give samples with times, each with its table: the points of others, 0.1 s apart."""
    found = []
    for files in _flights("points", folder):
        (table,) = (content for name, content in files.items() if name.endswith(".csv"))
        rows = np.loadtxt(table.decode().splitlines(), delimiter=",", comments=["#", "x"])
        lines = [",".join(map(str, (n / 10, *row))) for n, row in enumerate(rows.tolist())]
        found.append({"path.yaml": b"samples: log.csv\n", "log.csv": "\n".join(["t,x,y,z", *lines]).encode()})
    return found


def _spoil_path(sound: list[dict[str, bytes]], chance: Random, folder: Path) -> None:
    files = chance.choice(sound)
    wrong = chance.choice(sorted(files) + [name for name in files if name.endswith(".csv")] * 3)
    for name, content in files.items():
        if name == wrong:
            content = spoiled_yaml(content, chance) if name == "path.yaml" else _spoiled_table(content, chance)
        (folder / name).write_bytes(content)


def _spoiled_table(content: bytes, chance: Random) -> bytes:
    return (spoil_text if chance.random() < 0.6 else spoil_bytes)(content, chance)


def _use_path(folder: Path) -> None:
    """Read a path file and plan along it."""
    read = load_path_file(folder / "path.yaml")
    read.path(np.linspace(0.0, read.path.end, 500), 4)
    if read.path.length < _LONGEST_PLANNED and len(read.path.breaks) < 100 and _is_planned(folder):
        plan_flight(folder / "path.yaml", load_limits(SAFETY), FlightOptions("convex"))


# safety.yaml and airframes


def _safety(_: Path) -> bytes:
    _plan_once()
    return SAFETY.read_bytes()


def _spoil_safety(sound: bytes, chance: Random, folder: Path) -> None:
    (folder / "safety.yaml").write_bytes(spoiled_yaml(sound, chance))


def _use_safety(folder: Path) -> None:
    limits = load_limits(folder / "safety.yaml")
    for planner in ("convex", "expert") if _is_planned(folder) else ():
        plan_flight(LINE, limits, FlightOptions(planner, nodes=30))


def _airframe(_: Path) -> tuple[bytes, bytes]:
    from dataclasses import asdict

    _plan_once()
    airframe = asdict(load_limits(SAFETY).airframe) | {"name": "own"}
    return SAFETY.read_bytes(), yaml.safe_dump(json.loads(json.dumps(airframe)), sort_keys=False).encode()


def _spoil_airframe(sound: tuple[bytes, bytes], chance: Random, folder: Path) -> None:
    safety = yaml.safe_load(sound[0]) | {"vehicle": "own.yaml"}
    (folder / "safety.yaml").write_text(yaml.safe_dump(safety, sort_keys=False))
    (folder / "own.yaml").write_bytes(spoiled_yaml(sound[1], chance))


# Plans


def _plan(folder: Path) -> pa.Table:
    limits = load_limits(SAFETY)
    save_plan(plan_flight(LINE, limits, FlightOptions(nodes=30)).plan, folder / "plan.parquet")
    return pq.read_table(folder / "plan.parquet")


def _spoil_plan(sound: pa.Table, chance: Random, folder: Path) -> None:
    file, kind, table = folder / "plan.parquet", chance.randrange(10), sound
    if kind < 6:
        tree = json.loads(sound.schema.metadata[b"cfplan"])
        part = chance.choice((None, "path", "profile", "airframe", "limits", "limits", "certificate"))
        spoiled = spoil_tree(tree, chance) if part is None else tree | {part: spoil_tree(tree[part], chance)}
        metadata = {b"cfplan": json_of(spoiled, chance)}
        if chance.random() < 0.02:
            metadata = {chance.choice((b"", b"other", b"\xff")): b"{}"}
        table = sound.replace_schema_metadata(metadata)
    elif kind < 8:
        table = spoiled_columns(sound, chance)
    pq.write_table(table, file)
    if kind >= 8:
        file.write_bytes(spoil_bytes(file.read_bytes(), chance))


def spoiled_columns(table: pa.Table, chance: Random) -> pa.Table:
    """Return a table with one column absurd, of another type or length, gone, twice, or renamed; or other rows."""
    number, kind = chance.randrange(table.num_columns), chance.randrange(8)
    name, values = table.column_names[number], table.column(number)
    if kind == 0:
        return table.remove_column(number)
    if kind == 1:
        return table.append_column(name, values)
    if kind == 2:
        return table.slice(0, chance.choice((0, 1, 2)))
    if kind == 3:
        return pa.concat_tables([table] * chance.choice((2, 50)))
    if kind == 4:
        return table.rename_columns(["\ufffd" if other == name else other for other in table.column_names])
    absurd = chance.choice((None, float("nan"), float("inf"), 1e308, -1.0, 0.0, 2**40))
    if kind == 5:
        text = pa.array(["x"] * len(values)) if chance.random() < 0.5 else pa.nulls(len(values))
        return table.set_column(number, name, text)
    changed = values.to_pylist()
    for row in (
        range(len(changed)) if chance.random() < 0.5 else chance.sample(range(len(changed)), 1) if changed else ()
    ):
        old = changed[row]
        if isinstance(old, list) and chance.random() < 0.7 and old:
            place = chance.randrange(len(old))
            old = chance.choice((old[:place], old * 2, [*old[:place], absurd, *old[place + 1 :]], []))
            changed[row] = old if old != [None] else []
        elif not isinstance(old, str):
            changed[row] = absurd
        else:
            changed[row] = chance.choice((None, "", "x" * 5000, "\x1b[2J"))
    try:
        return table.set_column(number, name, pa.array(changed, type=values.type))
    except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError):
        return table.set_column(number, name, pa.nulls(len(values), values.type))


def _use_plan(folder: Path) -> None:
    plan = load_plan(folder / "plan.parquet")
    header_of_plan(plan, name="plan", uri="", source=folder, wall_time_at_zero=0.0)
    reference_of(plan.trajectory, "plan")


# Records


def _record(_: Path) -> list[Any]:
    return flight.flight_messages()[::40]


def _spoil_record(messages: list[Any], chance: Random, folder: Path) -> None:
    """Write a record some of whose messages, or whose header, are absurd, or spoil the bytes of a sound one."""
    wrong = set(chance.sample(range(len(messages)), chance.choice((0, 1, 1, 2, 5))))
    numbers = iter(range(len(messages)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            writer, "message_to_json", partial(_spoiled_message, writer.message_to_json, wrong, numbers, chance)
        )
        if chance.random() < 0.3:
            patch.setattr(writer, "header_to_json", partial(_spoiled_header, writer.header_to_json, chance))
        with writer.RecordWriter(folder, flight.header()) as record:
            for message in messages:
                record.write(message)
    if chance.random() < 0.5:
        summary = {"finished": True, "outcome": "landed", "seconds": 3.0, "shares": {"speed": 0.5}}
        (folder / "summary.json").write_bytes(json_of(spoil_tree(summary, chance), chance))
    if chance.random() < 0.3:
        file = folder / "flight.mcap"
        file.write_bytes(spoil_bytes(file.read_bytes(), chance))


def _spoiled_message(to_json: Any, wrong: set[int], numbers: Any, chance: Random, message: Any) -> bytes:
    content = to_json(message)
    return json_of(spoil_tree(json.loads(content), chance), chance) if next(numbers) in wrong else content


def _spoiled_header(to_json: Any, chance: Random, header: Any) -> str:
    return json_of(spoil_tree(json.loads(to_json(header)), chance), chance).decode("utf-8", "replace")


def _use_record(folder: Path) -> None:
    """Read a record, and make of it all that report and replay make."""
    record = read_record(folder)
    summary_text(record)
    found = read_flight(folder)
    flight_to_dict(found)
    trial = trial_of_record(record, "trial")
    write_page([found], folder / "page.html")
    write_overlay([trial], folder / "overlay.rrd")
    write_rrd(record, folder / "record.rrd")


# Models


def _model(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    from cfplan.learning.model_files import save_model
    from tests.learning.conftest import card, weights

    save_model(folder / "model", card(), weights())
    _use_model(folder)
    return json.loads((folder / "model" / "card.json").read_bytes()), weights()


def _spoil_model(sound: tuple[dict[str, Any], dict[str, Any]], chance: Random, folder: Path) -> None:
    """Spoil card or weights; the card mostly knows the hash of the weights, as a hostile one would."""
    from hashlib import sha256

    card, arrays = sound
    kind = chance.randrange(4)
    content = _weights(arrays, chance) if kind < 2 else _weights(arrays, None)
    card = card | {"weights_sha256": sha256(content).hexdigest()}
    if kind >= 2:
        card = spoil_tree(card, chance)
    model = folder / "model"
    model.mkdir()
    (model / "weights.safetensors").write_bytes(content)
    text = json_of(card, chance) if kind >= 2 else json.dumps(card).encode()
    (model / "card.json").write_bytes(spoil_bytes(text, chance) if kind == 3 else text)


def _weights(arrays: dict[str, Any], chance: Random | None) -> bytes:
    from safetensors.numpy import save

    if chance is None:
        return save(arrays)
    kind = chance.randrange(4)
    if kind == 0:
        return spoil_bytes(save(arrays), chance)
    if kind == 1:  # the header, which names types, shapes and places
        content = save(arrays)
        (size,) = struct.unpack_from("<Q", content)
        head = json_of(spoil_tree(json.loads(content[8 : 8 + size]), chance), chance)
        size = chance.choice((len(head), len(head), len(head), 0, 2**40, 2**63))
        return struct.pack("<Q", size) + head + content[8 + size :]
    changed = {name: values.copy() for name, values in arrays.items()}
    name = chance.choice(sorted(changed))
    if kind == 2:
        changed[name].flat[chance.randrange(changed[name].size)] = chance.choice(
            (np.nan, np.inf, 3e38, -3e38, 1e-38, 0)
        )
    else:
        changed[name] = chance.choice(
            (
                changed[name] * np.float32(1e30),
                changed[name].astype(float),
                changed[name][:0],
                changed[name].T,
                -changed[name] * 1000,
            )
        )
        changed = {
            (other if chance.random() < 0.98 else other + "\x1b"): np.ascontiguousarray(v)
            for other, v in changed.items()
        }
    return save(changed)


def _use_model(folder: Path) -> None:
    """Load a model, find it among others, and plan by it."""
    from cfplan.learning.learned import plan_learned
    from cfplan.learning.model_files import _find, load_model
    from cfplan.planners.task import PlanningTask

    limits = load_limits(SAFETY)
    _find.cache_clear()
    _find(limits.airframe, limits.plan, (folder,))
    model = load_model(folder / "model")
    model.outside(limits.airframe, limits.plan)
    plan_learned(PlanningTask(load_path_file(LINE).path, limits.airframe, limits.plan), model=model)


# Datasets


def _dataset(folder: Path) -> dict[str, Any]:
    from cfplan.learning import labels
    from cfplan.learning.dataset import make_dataset
    from cfplan.planners.baselines.min_snap import plan_min_snap
    from tests.learning.conftest import TINY

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(labels, "plan_expert", plan_min_snap)
        make_dataset(folder / "tiny", TINY)
    _use_dataset(folder / "tiny")
    found = {str(file.relative_to(folder / "tiny")): file for file in (folder / "tiny").rglob("*.parquet")}
    tables: dict[str, Any] = {name: pq.read_table(file) for name, file in found.items()}
    return tables | {"dataset.json": json.loads((folder / "tiny" / "dataset.json").read_bytes())}


def _spoil_dataset(sound: dict[str, Any], chance: Random, folder: Path) -> None:
    wrong = chance.choice([*sound, *(name for name in sound if name.startswith("shards"))])
    for name, content in sound.items():
        file = folder / name
        file.parent.mkdir(exist_ok=True)
        if name == "dataset.json":
            file.write_bytes(
                json_of(spoil_tree(content, chance), chance) if name == wrong else json.dumps(content).encode()
            )
            continue
        damaged = name == wrong and chance.random() < 0.3
        pq.write_table(spoiled_columns(content, chance) if name == wrong and not damaged else content, file)
        if damaged:
            file.write_bytes(spoil_bytes(file.read_bytes(), chance))


def _use_dataset(folder: Path) -> None:
    """Describe a dataset, and draw windows from it as training does."""
    from cfplan.learning.dataset import describe
    from cfplan.learning.training_set import draw, read_training_set, split

    describe(folder)
    found = read_training_set(folder)
    known, _ = split(found, 0)
    draw(known.labels, np.arange(min(8, len(known.rows))), 24, np.random.default_rng(0))


FILES = {
    "paths": Reader(partial(_flights, "waypoints"), _spoil_path, _use_path, 1.5),
    "points": Reader(partial(_flights, "points"), _spoil_path, _use_path),
    "polynomials": Reader(partial(_flights, "polynomials"), _spoil_path, _use_path),
    "samples": Reader(_timed, _spoil_path, _use_path),
    "safety": Reader(_safety, _spoil_safety, _use_safety, 1.5),
    "airframes": Reader(_airframe, _spoil_airframe, _use_safety, 1.5),
    "plans": Reader(_plan, _spoil_plan, _use_plan, 1.5),
    "records": Reader(_record, _spoil_record, _use_record),
    "models": Reader(_model, _spoil_model, _use_model),
    "datasets": Reader(_dataset, _spoil_dataset, _use_dataset),
}


def emptied(folder: Path) -> Path:
    """Return the folder, empty."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder
