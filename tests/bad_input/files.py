"""The files that cfplan reads: how to make a valid one, how to spoil it, and how a command uses it."""

import contextlib
import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from safetensors.numpy import save

from cfplan.errors import CfplanError
from cfplan.geometry.path_file import load_path_file
from cfplan.learning.dataset import describe, make_dataset
from cfplan.learning.learned import plan_learned
from cfplan.learning.model_files import CARD, WEIGHTS, find_model, load_model, save_model
from cfplan.learning.training_set import draw, read_training_set, split
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan_file import load_plan, save_plan
from cfplan.preparation.plan_flight import FlightOptions, plan_flight
from cfplan.recording.header import header_of_plan
from cfplan.recording.importers.formats import read_log
from cfplan.recording.importers.vicon_header import Rotations
from cfplan.recording.overlay import Reference, align, reference_of, trial_of_record, trial_of_subject
from cfplan.recording.reader import read_record
from cfplan.recording.record import FLIGHT_FILE, SUMMARY_FILE
from cfplan.recording.report.page import write_page
from cfplan.recording.report.report import flight_to_dict, read_flight
from cfplan.recording.rerun.overlay_view import write_overlay
from cfplan.recording.rerun.record_view import write_rrd
from cfplan.recording.summary import summary_text
from cfplan.recording.writer import RecordWriter
from cfplan.safety.limits_file import load_limits
from tests.bad_input.faults import json_of, spoil_bytes, spoil_columns, spoil_text, spoil_tree, spoil_yaml
from tests.learning.conftest import TINY, card, weights
from tests.recording.conftest import flight_messages, header
from tests.recording.importers import test_import_logs as logs
from tests.recording.importers import test_import_vicon as vicon

REPOSITORY = Path(__file__).parents[2]
SAFETY, LINE = REPOSITORY / "safety.yaml", REPOSITORY / "flights" / "line.yaml"
MADE = "made"  # the folder for the output of a command
_LONGEST_PLANNED = 30.0  # m: planning longer ones takes too long
Sound = dict[str, bytes]  # the files of one valid input, by name


@dataclass(frozen=True)
class Input:
    """One kind of input: `sound` makes valid ones, `spoil` writes a wrong one to a folder, `use` acts as a command."""

    sound: Callable[[Path], Any]
    spoil: Callable[[Any, Random, Path], None]
    use: Callable[[Path], object]
    fraction: float = 1.0  # of the usual number of examples


def put(files: Sound, folder: Path) -> None:
    """Write files into a folder and its subfolders."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def taken(folder: Path) -> Sound:
    """Return the files in a folder and its subfolders."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def spoil_one_file(sound: list[Sound], chance: Random, folder: Path) -> None:
    """Write the files of an input, one of them with mistakes that fit its format."""
    files = chance.choice(sound)
    wrong = chance.choice(sorted(files))
    put(files | {wrong: _spoiled(wrong, files[wrong], chance)}, folder)


def _spoiled(name: str, content: bytes, chance: Random) -> bytes:
    if name.endswith(".yaml"):
        return spoil_yaml(content, chance)
    if name.endswith(".csv"):
        return (spoil_text if chance.randrange(3) else spoil_bytes)(content, chance)
    if name.endswith(".json") and chance.randrange(3):
        return json_of(spoil_tree(json.loads(content), chance), chance)
    if name.endswith(".parquet") and chance.randrange(3):
        return _parquet(spoil_columns(pq.read_table(pa.BufferReader(content)), chance))
    return spoil_bytes(content, chance)


def _parquet(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return sink.getvalue().to_pybytes()


def _is_planned(folder: Path) -> bool:
    """Return whether to plan with an input that can be read, which is slow: one in four, by its content."""
    return zlib.crc32(b"".join(taken(folder).values())) % 4 == 0


# Paths, points, samples, polynomials


def _flights(kind: str, _: Path) -> list[Sound]:
    found = []
    for file in sorted((REPOSITORY / "flights").glob("*.yaml")):
        content = yaml.safe_load(file.read_bytes())
        if kind in content:
            table = {} if kind == "waypoints" else {content[kind]: (file.parent / content[kind]).read_bytes()}
            found.append({"path.yaml": file.read_bytes()} | table)
    return found


def _waypoints(folder: Path) -> list[Sound]:
    own = b"waypoints: [[0, 0, 1], [1, 0, 1]]\nyaw: {mode: fixed, angle_deg: 3}\nplace: {x: 1}\nspeed: 0.5\n"
    regions = (
        b"waypoints:\n  - [0, 0, 1]\n  - {at: [1, 0.5, 1], within: 0.1}\n"
        b"  - {gate: [0, 1, 1], yaw_deg: 180, width: 0.8, height: 0.6}\n  - [0, 0, 1]\nlaps: 2\ncorridor: 0.4\n"
    )
    timed = b"waypoints: [[0, 0, 1], [1, 0, 1], [0, 0, 1]]\nshape: min-snap\ntimes: length\n"
    return [*_flights("waypoints", folder), *({"path.yaml": content} for content in (own, regions, timed))]


def _points(_: Path) -> list[Sound]:
    return [{"path.yaml": b"points: rows.csv\nlaps: 2\n", "rows.csv": b"x,y,z\n0,0,1\n1,0,1\n1,1,1.2\n0,0,1\n"}]


def _samples(_: Path) -> list[Sound]:
    rows = [f"{n / 10},{np.cos(n / 10):.4f},{np.sin(n / 10):.4f},1.0" for n in range(40)]
    return [{"path.yaml": b"samples: log.csv\n", "log.csv": "\n".join(["t,x,y,z", *rows]).encode()}]


def _use_path(folder: Path) -> None:
    read = load_path_file(folder / "path.yaml")
    s = np.linspace(0.0, read.path.end, 500)
    assert all(np.isfinite(read.path(s, order)).all() for order in range(5))
    if read.path.length < _LONGEST_PLANNED and len(read.path.breaks) < 100 and _is_planned(folder):
        plan_flight(folder / "path.yaml", load_limits(SAFETY), FlightOptions("convex"))


# safety.yaml and airframes


def _safety(_: Path) -> list[Sound]:
    furnished = yaml.safe_load(SAFETY.read_bytes())
    furnished["space"]["obstacles"] = [
        {"name": "table", "box": {"low": [0.5, 1.0, 0.0], "high": [1.5, 2.0, 0.8], "yaw_deg": 30}},
        {"cylinder": {"x": -1.0, "y": 2.0, "radius": 0.1, "height": 2.0}},
    ]
    return [{"safety.yaml": SAFETY.read_bytes()}, {"safety.yaml": yaml.safe_dump(furnished).encode()}]


def _airframe(_: Path) -> list[Sound]:
    airframe = json.loads(json.dumps(asdict(load_limits(SAFETY).airframe) | {"name": "own"}))
    safety = yaml.safe_load(SAFETY.read_bytes()) | {"vehicle": "own.yaml"}
    return [{"own.yaml": yaml.safe_dump(airframe).encode(), "safety.yaml": yaml.safe_dump(safety).encode()}]


def _use_safety(folder: Path) -> None:
    limits = load_limits(folder / "safety.yaml")
    plan, flight = limits.plan, limits.flight
    assert plan.motor_thrust_min < limits.airframe.hover_thrust < plan.motor_thrust_max
    assert 0 < plan.speed < flight.speed.brake < flight.speed.land < flight.speed.cut
    for planner in ("convex", "expert") if _is_planned(folder) else ():
        plan_flight(LINE, limits, FlightOptions(planner, nodes=30))


# Plans


def _plan(folder: Path) -> pa.Table:
    save_plan(plan_flight(LINE, load_limits(SAFETY), FlightOptions(nodes=30)).plan, folder / "plan.parquet")
    return pq.read_table(folder / "plan.parquet")


def _spoil_plan(sound: pa.Table, chance: Random, folder: Path) -> None:
    kind, table = chance.randrange(10), sound
    if kind < 6:
        tree = json.loads(sound.schema.metadata[b"cfplan"])
        part = chance.choice((None, "path", "profile", "airframe", "limits", "certificate"))
        spoiled = spoil_tree(tree, chance) if part is None else tree | {part: spoil_tree(tree[part], chance)}
        key = b"cfplan" if chance.randrange(20) else chance.choice((b"", b"other", b"\xff"))
        table = sound.replace_schema_metadata({key: json_of(spoiled, chance)})
    elif kind < 8:
        table = spoil_columns(sound, chance)
    content = _parquet(table)
    put({"plan.parquet": spoil_bytes(content, chance) if kind >= 8 else content}, folder)


def _use_plan(folder: Path) -> None:
    plan = load_plan(folder / "plan.parquet")
    header_of_plan(plan, name="plan", uri="", source=folder, wall_time_at_zero=0.0)
    reference_of(plan.trajectory, "plan")


# Records


def _record(folder: Path) -> Path:
    with RecordWriter(folder / "record", header()) as record:
        for message in flight_messages()[::40]:
            record.write(message)
    return folder / "record" / FLIGHT_FILE


def _spoil_record(sound: Path, chance: Random, folder: Path) -> None:
    """Write a record with wrong messages or a wrong header, or with damaged bytes."""
    file = folder / FLIGHT_FILE
    if chance.randrange(3) == 0:
        file.write_bytes(spoil_bytes(sound.read_bytes(), chance))
    else:
        _copy_with_mistakes(sound, file, chance)
    if chance.randrange(2):
        summary = {"finished": True, "outcome": "landed", "seconds": 3.0, "shares": {"speed": 0.5}}
        (folder / SUMMARY_FILE).write_bytes(json_of(spoil_tree(summary, chance), chance))


def _copy_with_mistakes(sound: Path, file: Path, chance: Random) -> None:
    with sound.open("rb") as source, file.open("wb") as target:
        reader, writer = make_reader(source), Writer(target)
        writer.start(profile=reader.get_header().profile)
        for metadata in reader.iter_metadata():
            content = dict(metadata.metadata)
            if chance.randrange(3) == 0:
                spoiled = json_of(spoil_tree(json.loads(content["header"]), chance), chance)
                content["header"] = spoiled.decode("utf-8", "replace")
            writer.add_metadata(metadata.name, content)
        found = list(reader.iter_messages(log_time_order=False))
        wrong = set(chance.sample(range(len(found)), chance.choice((0, 1, 1, 2, 5))))
        channels: dict[int, int] = {}
        for number, (schema, channel, message) in enumerate(found):
            if channel.id not in channels:
                own = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, own)
            data = message.data
            if number in wrong:
                is_json = channel.message_encoding == "json"
                data = json_of(spoil_tree(json.loads(data), chance), chance) if is_json else spoil_bytes(data, chance)
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time)
        writer.finish()


def _use_record(folder: Path) -> None:
    """Read a record, and make everything that report and replay make of it."""
    record = read_record(folder)
    summary_text(record)
    found = read_flight(folder)
    flight_to_dict(found)
    trial = trial_of_record(record, "trial")
    write_page([found], folder / MADE / "page.html")
    write_overlay([trial], folder / MADE / "overlay.rrd")
    write_rrd(record, folder / MADE / "record.rrd")


# Models


def _model(folder: Path) -> None:
    save_model(folder, card(), weights())
    put({f"model/{name}": content for name, content in taken(folder).items()}, folder)
    _use_model(folder)  # loads the parts of planning that need torch


def _spoil_model(_: None, chance: Random, folder: Path) -> None:
    """Spoil card or weights; the card mostly has the hash of the weights, as in an attack."""
    arrays, text = weights(), json.loads(json.dumps(asdict(card())))
    wrong_weights = chance.randrange(2)
    content = _wrong_weights(arrays, chance) if wrong_weights else save(arrays)
    text["weights_sha256"] = sha256(content).hexdigest()
    own = json.dumps(text).encode() if wrong_weights else _spoiled(CARD, json.dumps(text).encode(), chance)
    put({f"model/{WEIGHTS}": content, f"model/{CARD}": own}, folder)


def _wrong_weights(arrays: dict[str, Any], chance: Random) -> bytes:
    kind, name = chance.randrange(4), chance.choice(sorted(arrays))
    values = arrays[name]
    if kind == 0:
        return spoil_bytes(save(arrays), chance)
    if kind == 1:  # the header with types, shapes and offsets
        content = save(arrays)
        (size,) = struct.unpack_from("<Q", content)
        head = json_of(spoil_tree(json.loads(content[8 : 8 + size]), chance), chance)
        return struct.pack("<Q", chance.choice((len(head), len(head), 0, 2**40, 2**63))) + head + content[8 + size :]
    if kind == 2:
        values.flat[chance.randrange(values.size)] = chance.choice((np.nan, np.inf, 3e38, -3e38, 1e-38, 0))
    else:
        others = (values * np.float32(1e30), values.astype(float), values[:0], values.T, -values * 1000)
        arrays[name] = np.ascontiguousarray(chance.choice(others))
    return save(arrays)


def _use_model(folder: Path) -> None:
    """Find a model, load it, and plan with it."""
    limits = load_limits(SAFETY)
    find_model(limits.airframe, limits.plan, (folder,))
    model = load_model(folder / "model")
    model.outside(limits.airframe, limits.plan)
    plan_learned(PlanningTask(load_path_file(LINE).path, limits.airframe, limits.plan), model=model)


# Datasets


def _dataset(folder: Path) -> list[Sound]:
    make_dataset(folder / "tiny", TINY)
    files = taken(folder / "tiny")
    return [{name: content for name, content in files.items() if name.endswith((".json", ".parquet"))}]


def _use_dataset(folder: Path) -> None:
    """Describe a dataset, and draw windows from it as training does."""
    describe(folder)
    found = read_training_set(folder)
    known, _ = split(found, 0)
    draw(known.labels, np.arange(min(8, len(known.rows))), 24, np.random.default_rng(0))


# Logs, which replay reads

REFERENCE = Reference("line", np.linspace(0, 0.2, 21), np.linspace([0, 0, 1], [0.2, 0.1, 1], 21))


def _vicon(folder: Path) -> list[Sound]:
    subjects = {kind: (kind, vicon.poses(seed=seed)) for seed, kind in enumerate(["quaternion", "euler", "helical"])}
    file, found = folder / "log.csv", []
    for delimiter, point, length in ((",", ".", "mm"), (";", ",", "m"), ("\t", ".", "cm")):
        found.append(vicon.write(file, subjects, delimiter=delimiter, point=point, length=length).read_bytes())
    found += [found[0] + b"\n\n" + found[0].replace(b"Objects", b"Trajectories"), found[0].replace(b"EulerXYZ", b"")]
    return [{"log.csv": content} for content in found]


def _spoil_sd(sound: bytes, chance: Random, folder: Path) -> None:
    """Spoil a log of the microSD card, mostly with a correct checksum."""
    content = spoil_bytes(sound, chance)
    put({"log": content + (struct.pack("<I", zlib.crc32(content)) if chance.randrange(4) else b"")}, folder)


def _tlog(_: Path) -> list[Sound]:
    return [
        {"log": logs.tlog(lambda i: [logs.odometry(i), *logs.local(i)])},
        {"log": logs.tlog(logs.local, v1=True)},
    ]


def _bags(folder: Path) -> list[Sound]:
    found = []
    for number, (kind, (topic, message_at)) in enumerate(logs.MESSAGES.items()):
        for storage in logs.StoragePlugin:
            place = folder / f"{number}-{storage.name}"
            found.append({
                f"bag/{name}": content
                for name, content in taken(logs.bag(place, topic, kind, message_at, storage)).items()
            })  # fmt: skip
    return found


def _first_bag(folder: Path) -> list[Sound]:
    """Return a ROS 1 bag."""
    types, kind = logs.store(), "geometry_msgs/msg/PoseStamped"
    with Ros1Writer(folder / "first.bag") as writer:
        topic = writer.add_connection("/cf1/pose", kind, typestore=types)
        for i in range(logs.COUNT):
            *header, pose = logs.MESSAGES[kind][1](i)
            raw = struct.pack("<2II5s", *header[:2], 5, b"world") + np.asarray(pose, "<f8").tobytes()
            writer.write(topic, round((logs.START + logs.TIMES[i]) * 1e9), raw)
    return [{"bag": (folder / "first.bag").read_bytes()}]


def _use_log(name: str, folder: Path) -> None:
    """Read a log, align each subject with a plan, and draw them all, as replay does."""
    log = read_log(folder / name)
    log.select([subject.name for subject in log.subjects])
    for subject in log.subjects[:5]:
        with contextlib.suppress(CfplanError):
            str(align(subject, REFERENCE))
    write_overlay(
        [trial_of_subject(subject, REFERENCE) for subject in log.subjects[:20]], folder / MADE / "overlay.rrd"
    )


def _use_vicon(folder: Path) -> None:
    _use_log("log.csv", folder)
    read_log(folder / "log.csv", rotations=Rotations.EULER)


FILES = {
    "paths": Input(_waypoints, spoil_one_file, _use_path),
    "points": Input(_points, spoil_one_file, _use_path),
    "curve": Input(partial(_flights, "curve"), spoil_one_file, _use_path),
    "polynomials": Input(partial(_flights, "polynomials"), spoil_one_file, _use_path),
    "samples": Input(_samples, spoil_one_file, _use_path),
    "safety": Input(_safety, spoil_one_file, _use_safety, 2.0),
    "airframes": Input(_airframe, spoil_one_file, _use_safety),
    "plans": Input(_plan, _spoil_plan, _use_plan),
    "records": Input(_record, _spoil_record, _use_record),
    "models": Input(_model, _spoil_model, _use_model),
    "datasets": Input(_dataset, spoil_one_file, _use_dataset),
    "Vicon logs": Input(_vicon, spoil_one_file, _use_vicon),
    "crazyswarm logs": Input(
        lambda _: [{"cf1.csv": logs.swarm().encode()}], spoil_one_file, partial(_use_log, "cf1.csv")
    ),
    "microSD logs": Input(
        lambda _: logs.usd(logs.ESTIMATE, logs.estimate_rows()[0], crc=False), _spoil_sd, partial(_use_log, "log")
    ),
    "MAVLink logs": Input(_tlog, spoil_one_file, partial(_use_log, "log")),
    "ROS bags": Input(lambda folder: [*_bags(folder), *_first_bag(folder)], spoil_one_file, partial(_use_log, "bag")),
}
