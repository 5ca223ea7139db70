"""The logs that replay reads: how an absurd one is made, and what reads it."""

import contextlib
import math
import struct
import zlib
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer

from cfplan.errors import CfplanError
from cfplan.recording.importers.formats import read_log
from cfplan.recording.importers.vicon_header import Rotations
from cfplan.recording.overlay import Reference, align, trial_of_subject
from cfplan.recording.rerun.overlay_view import write_overlay
from tests.fuzzing.files import Reader
from tests.fuzzing.mutations import NUMBERS, TEXTS, WORDS, spoil_bytes, spoil_text
from tests.recording.importers import test_import_logs as logs
from tests.recording.importers import test_import_vicon as vicon

REFERENCE = Reference("line", np.linspace(0, 0.2, 21), np.linspace([0, 0, 1], [0.2, 0.1, 1], 21))
_FLOATS = [float(number) for number in NUMBERS]


def _use_log(name: str, folder: Path) -> None:
    """Read a log, lay each subject over a plan, and draw them all, as replay does."""
    log = read_log(folder / name)
    log.select([subject.name for subject in log.subjects])
    for subject in log.subjects[:5]:
        with contextlib.suppress(CfplanError):
            str(align(subject, REFERENCE))
    write_overlay([trial_of_subject(subject, REFERENCE) for subject in log.subjects[:20]], folder / "overlay.rrd")


# Tables as text


def _vicon(folder: Path) -> list[bytes]:
    found = []
    for number, (delimiter, point, length) in enumerate([(",", ".", "mm"), (";", ",", "m"), ("\t", ".", "cm")]):
        file = folder / f"{number}.csv"
        subjects = {
            kind: (kind, vicon.poses(seed=seed)) for seed, kind in enumerate(["quaternion", "euler", "helical"])
        }
        vicon.write(file, subjects, delimiter=delimiter, point=point, length=length)
        found.append(file.read_bytes())
    return [
        *found,
        found[0] + b"\n\n" + found[0].replace(b"Objects", b"Trajectories"),
        found[0].replace(b"EulerXYZ", b""),
    ]


def _swarm(_: Path) -> list[bytes]:
    return [logs.swarm().encode()]


def _spoil_table(name: str, sound: list[bytes], chance: Random, folder: Path) -> None:
    content = chance.choice(sound)
    spoil = chance.choice((spoil_text, spoil_text, spoil_bytes, _times))
    (folder / name).write_bytes(spoil(content, chance))


def _times(content: bytes, chance: Random) -> bytes:
    """Return a table with absurd first cells: times or frame numbers."""
    lines = content.split(b"\n")
    for _ in range(chance.choice((1, 2, 10))):
        row = chance.randrange(len(lines))
        first, comma, rest = lines[row].partition(b",")
        scaled = [
            b"-" + first,
            first + b"000000000",
            first + b"e9",
            first + b"e300",
            b"0." + first,
            chance.choice(WORDS),
        ]
        lines[row] = chance.choice(scaled) + comma + rest
    return b"\n".join(lines)


# microSD


def _sd(_: Path) -> None:
    return None


def _spoil_sd(_: None, chance: Random, folder: Path) -> None:
    """Write a log with absurd values, times and names, or spoiled bytes, mostly with a checksum that fits."""
    rows, *_rest = logs.estimate_rows()
    names = list(logs.ESTIMATE)
    rows = rows.copy()
    for _ in range(chance.choice((0, 1, 3))):
        with np.errstate(over="ignore"):
            rows[chance.randrange(len(rows)) if chance.random() < 0.7 else slice(None), chance.randrange(7)] = (
                np.clip(chance.choice(_FLOATS), -3e38, 3e38)
                if chance.random() < 0.7
                else chance.choice((math.nan, math.inf))
            )
    if chance.random() < 0.2:
        names[chance.randrange(7)] = chance.choice(
            (f"{chance.choice(TEXTS[:10])!a}(f)", "stateEstimate.x(f)", "(f)", "x.y(f)")
        )
    start = chance.choice((5.0, 0.0, 1e9, 1.8e13))
    name = chance.choice(("fixedFrequency", "", "estTDOA", "x" * 300, "\x1b[2J"))
    content = bytearray(logs.usd(names, rows, crc=False, start=start, name=name))
    for _ in range(chance.choice((0, 1, 3))):  # times of records
        place = len(content) - 38 * chance.randint(1, logs.COUNT) + 2
        content[place : place + 8] = struct.pack("<Q", chance.choice((0, 1, 2**63, 2**64 - 1, 10**13, 4 * 10**10)))
    if chance.random() < 0.4:
        content = bytearray(spoil_bytes(bytes(content), chance))
    if chance.random() < 0.8:
        content += struct.pack("<I", zlib.crc32(content))
    (folder / "log").write_bytes(content or b"\xbc")


# .tlog


def _tlog(_: Path) -> bytes:
    return logs.SOUND["tlog"]


def _spoil_tlog(sound: bytes, chance: Random, folder: Path) -> None:
    content = sound
    if chance.random() < 0.7:
        v1 = chance.random() < 0.2
        content = logs.tlog(partial(_absurd_packets, chance, v1), v1=v1)
    if chance.random() < 0.5:
        content = spoil_bytes(content, chance)
    (folder / "log").write_bytes(content or b"\0")


def _absurd_packets(chance: Random, v1: bool, i: int) -> list[Any]:
    """Return the messages of one moment, a few of them with numbers that no vehicle sends."""
    frame = chance.choice((1, 20, 255)) if chance.random() < 0.02 else 1
    found = logs.local(i) if v1 else [logs.odometry(i, frame=frame), *logs.local(i)]
    for message in found:
        for name in ("x", "y", "z", "yaw", "roll"):
            if hasattr(message, name) and chance.random() < 0.01:
                setattr(message, name, chance.choice((math.nan, math.inf, 3e38, -3e38, 1e18, 1e-40)))
        if hasattr(message, "q") and chance.random() < 0.03:
            message.q = [chance.choice((math.nan, 0.0, 3e38, 1e-40, -1.0)) for _ in range(4)]
    return found


# ROS bags


def _bag(_: Path) -> list[tuple[str, list[bytes]]]:
    """Return each kind of message as a bag holds it."""
    return [
        (kind, [logs.cdr(*message_at(i)) for i in range(logs.COUNT)]) for kind, (_, message_at) in logs.MESSAGES.items()
    ]


def _spoil_bag(sound: list[tuple[str, list[bytes]]], chance: Random, folder: Path) -> None:
    """Write a bag with absurd messages, times or names, and spoil its files."""
    kind, raws = chance.choice(sound)
    types = logs.store()
    wrong = set(chance.sample(range(len(raws)), chance.choice((0, 1, 3, 10))))
    topic = chance.choice(("/cf1/pose", "/cf1/pose", "", "\x1b[2J", "x" * 3000, "é"))
    place = folder / "bag"
    storage = chance.choice((StoragePlugin.SQLITE3, StoragePlugin.MCAP, None))
    if storage is None:
        place = folder / "bag.bag"
        writer: Any = Writer1(place)
    else:
        writer = Writer(place, version=9, storage_plugin=storage)
    with writer:
        connection = writer.add_connection(topic, kind, typestore=types)
        for i, raw in enumerate(raws):
            if storage is None:
                raw = bytes(types.cdr_to_ros1(raw, kind))
            time = round((logs.START + logs.TIMES[i]) * 1e9)
            if i in wrong:
                raw = _absurd_doubles(raw, chance) if chance.random() < 0.7 else spoil_bytes(raw, chance)
                time = chance.choice((time, time, 0, 1, 2**61))
            writer.write(connection, time, raw)
    if storage is not None and not place.exists():
        return
    if chance.random() < 0.4:
        files = sorted(place.iterdir()) if place.is_dir() else [place]
        file = chance.choice(files)
        file.write_bytes((spoil_text if file.suffix == ".yaml" else spoil_bytes)(file.read_bytes(), chance))


def _absurd_doubles(raw: bytes, chance: Random) -> bytes:
    """Return a message whose last numbers, the pose in most kinds, are absurd."""
    changed = bytearray(raw)
    for _ in range(chance.choice((1, 2, 7))):
        place = max(4, len(raw) - 8 * chance.randint(1, 50))
        changed[place : place + 8] = struct.pack("<d", chance.choice(_FLOATS))
    if chance.random() < 0.3:
        changed[4:12] = struct.pack("<iI", chance.choice((0, -(2**31), 2**31 - 1)), chance.choice((0, 2**32 - 1)))
    return bytes(changed)


def _use_bag(folder: Path) -> None:
    _use_log("bag" if (folder / "bag").exists() else "bag.bag", folder)


def _use_vicon(folder: Path) -> None:
    _use_log("log.csv", folder)
    read_log(folder / "log.csv", rotations=Rotations.EULER)


LOGS = {
    "Vicon": Reader(_vicon, partial(_spoil_table, "log.csv"), _use_vicon),
    "crazyswarm": Reader(_swarm, partial(_spoil_table, "cf1.csv"), partial(_use_log, "cf1.csv"), 1.5),
    "microSD": Reader(_sd, _spoil_sd, partial(_use_log, "log")),
    "tlog": Reader(_tlog, _spoil_tlog, partial(_use_log, "log")),
    "ROS": Reader(_bag, _spoil_bag, _use_bag),
}
