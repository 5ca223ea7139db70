"""Malformed and absurd files, by seeds: each is read, or refused in one line; none hangs or fills the memory.

pytest -m slow tests/integration/test_fuzz.py                            1,000 inputs a reader
FUZZ_INPUTS=10000 pytest -m slow tests/integration/test_fuzz.py          as many as are asked for
FUZZ_SEED=7 pytest -m slow tests/integration/test_fuzz.py                other inputs
"""

import contextlib
import os
import random
import re
import resource
import shutil
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cfplan.errors import CfplanError
from cfplan.flight.mocap.datastream import Decoder, MalformedError
from cfplan.geometry.path_file import load_path_file
from cfplan.planning.plan_file import load_plan, save_plan
from cfplan.preparation.plan_flight import plan_flight
from cfplan.recording import writer
from cfplan.recording.importers.formats import read_log
from cfplan.recording.overlay import Reference, align, extent, trial_of_record, trial_of_subject
from cfplan.recording.reader import read_record
from cfplan.recording.report.report import flight_to_dict, read_flight
from cfplan.recording.rerun.overlay_view import dashes, stretches
from cfplan.recording.rerun.record_view import floor_lines
from cfplan.recording.summary import summary_text
from cfplan.safety.limits_file import load_limits
from tests.flight.mocap import test_datastream as datastream
from tests.recording import conftest as flight
from tests.recording.importers import test_import_logs as logs
from tests.recording.importers import test_import_vicon as vicon

pytestmark = pytest.mark.slow
INPUTS, SEED = int(os.environ.get("FUZZ_INPUTS", "1000")), int(os.environ.get("FUZZ_SEED", "0"))
REPOSITORY = Path(__file__).parents[2]
LONGEST, MOST_MEMORY = 10.0, 1_000_000  # s for one input; kB more than before
ABSURD = (
    b"1e300", b"-1e300", b"1e-300", b"1e9", b"-1e9", b"0", b"-0.0", b"1e308", b"5e-324", b"999999999999999999999",
    b"nan", b"inf", b"null", b"true", b"[]", b"{}", b'""', b"1_000", b"0x1F", b"\xff", b"\xed\xa0\x80", b"\\ud800",
    b"\x1b[2J",
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+(\.\d*)?([eE][-+]?\d+)?")
MESSAGES = flight.flight_messages()[::20]
REFERENCE = Reference("line", np.linspace(0, 0.2, 21), np.linspace([0, 0, 1], [0.2, 0.1, 1], 21))


def spoiled(content: bytes, chance: random.Random) -> bytes:
    """The content with one to four mistakes in it."""
    for _ in range(chance.randint(1, 4)):
        numbers = list(_NUMBER.finditer(content))
        begin = chance.randint(0, len(content))
        end = min(len(content), begin + chance.choice((0, 1, 8, 200)))
        kind = chance.randrange(7)
        if kind < 3 and numbers:
            number = chance.choice(numbers)
            content = content[: number.start()] + chance.choice(ABSURD) + content[number.end() :]
        elif kind == 3:
            content = content[:begin]
        elif kind == 4:
            content = content[:begin] + chance.randbytes(end - begin) + content[end:]
        elif kind == 5:
            content = content[:begin] + content[begin:end] * chance.choice((2, 50)) + content[end:]
        else:
            eight = struct.pack("<d", chance.choice((1e300, float("nan"), float("inf"), -1e18, 1e-300)))
            content = content[:begin] + eight + content[begin + 8 :]
    return content


def use_log(file: Path) -> None:
    log = read_log(file)
    trials = [trial_of_subject(subject, REFERENCE) for subject in log.subjects]
    floor_lines(*extent(trials))
    for subject, trial in zip(log.subjects, trials, strict=True):
        _ = trial.speed, trial.deviation, [dashes(trial.position[piece]) for piece in stretches(trial)]
        with contextlib.suppress(CfplanError):
            align(subject, REFERENCE)


def use_record(file: Path) -> None:
    record = read_record(file)
    summary_text(record)
    flight_to_dict(read_flight(file.parent))
    trial = trial_of_record(record, "trial")
    floor_lines(*extent([trial]))
    _ = trial.speed, trial.deviation


def use_frames(file: Path) -> None:
    with contextlib.suppress(MalformedError):
        Decoder().frame(memoryview(file.read_bytes()), 1.0)


@dataclass(frozen=True)
class Reader:
    """What a file is read with, and sound ones of its kind."""

    name: str  # of the file
    use: Callable[[Path], object]
    sound: Callable[[Path], list[bytes]]


def _files(pattern: str) -> Callable[[Path], list[bytes]]:
    return lambda _: [file.read_bytes() for file in sorted(REPOSITORY.glob(pattern))]


def _record(folder: Path) -> list[bytes]:
    """A sound record, and some with an absurd message or header: in the file they are compressed."""
    chance, found = random.Random(SEED), []
    for number in range(1 + max(20, INPUTS // 20)):
        with pytest.MonkeyPatch.context() as patch:
            if number:
                patch.setattr(writer, "message_to_json", partial(_absurd, writer.message_to_json, chance))
            if number % 2:
                patch.setattr(writer, "header_to_json", partial(_absurd_header, writer.header_to_json, chance))
            place = folder / str(number)
            place.mkdir()
            with writer.RecordWriter(place, flight.header()) as record:
                for message in MESSAGES:
                    record.write(message)
        found.append((place / "flight.mcap").read_bytes())
    return found


def _absurd(to_json: Callable[[Any], bytes], chance: random.Random, message: Any) -> bytes:
    content = to_json(message)
    if chance.random() > 0.5 / len(MESSAGES):
        return content
    number = chance.choice(list(_NUMBER.finditer(content)))
    return content[: number.start()] + chance.choice(ABSURD) + content[number.end() :]


def _absurd_header(to_json: Callable[[Any], str], chance: random.Random, header: Any) -> str:
    content = to_json(header).encode()
    number = chance.choice(list(_NUMBER.finditer(content)))
    absurd = chance.choice([absurd for absurd in ABSURD if absurd.isascii()])
    return (content[: number.start()] + absurd + content[number.end() :]).decode()


def _plan(folder: Path) -> list[bytes]:
    limits = load_limits(REPOSITORY / "safety.yaml")
    save_plan(plan_flight(REPOSITORY / "flights" / "line.yaml", limits).plan, folder / "plan.parquet")
    return [(folder / "plan.parquet").read_bytes()]


def _vicon(folder: Path) -> list[bytes]:
    vicon.write(folder / "log.csv", {"swift": ("quaternion", vicon.poses()), "gate": ("euler", vicon.poses(seed=1))})
    return [(folder / "log.csv").read_bytes()]


def _frames(_: Path) -> list[bytes]:
    latency = struct.pack("<I", 1) + datastream.text("A") + struct.pack("<d", 0.003)
    turned = datastream.TURN.as_matrix()
    return [
        b"".join([
            datastream.contents(), datastream.subject(4, "cf1", (1, 0, "cf1")), datastream.frame_info(77),
            datastream.segments(4, (1, (1000.0, -2000.0, 300.0), turned)), datastream.block(26, latency),
        ])
    ]  # fmt: skip


READERS = {
    "paths": Reader("path.yaml", load_path_file, _files("flights/*.yaml")),
    "limits": Reader("safety.yaml", load_limits, _files("safety.yaml")),
    "plans": Reader("plan.parquet", load_plan, _plan),
    "records": Reader("flight.mcap", use_record, _record),
    "microSD": Reader("log", use_log, lambda folder: [logs.sound(folder, "microsd")]),
    "crazyswarm": Reader("log", use_log, lambda folder: [logs.sound(folder, "crazyswarm")]),
    "tlog": Reader("log", use_log, lambda folder: [logs.sound(folder, "tlog")]),
    "Vicon": Reader("log.csv", use_log, _vicon),
    "DataStream": Reader("frame", use_frames, _frames),
}


@pytest.mark.timeout(0)
@pytest.mark.parametrize("name", READERS)
def test_whatever_a_file_holds_it_is_read_or_refused(name, tmp_path):
    reader, chance = READERS[name], random.Random(f"{SEED} {name}")
    (tmp_path / "sound").mkdir()
    sound = reader.sound(tmp_path / "sound")
    for file in (REPOSITORY / "flights").glob("*.csv"):  # that path files name
        shutil.copy(file, tmp_path)
    file, memory = tmp_path / reader.name, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in range(INPUTS):
        content = chance.choice(sound)
        if name != "records" or chance.random() < 0.3:
            content = spoiled(content, chance)
        file.write_bytes(content)
        begun = time.monotonic()
        try:
            reader.use(file)
        except CfplanError as error:
            assert "\n" not in str(error)  # noqa: PT017  most are refused, some are read
        except Exception as error:
            kept = Path(os.environ.get("FUZZ_KEEP", tmp_path)) / f"{name}-{SEED}-{number}"
            kept.write_bytes(content)
            raise AssertionError(f"input {number} of {name}, seed {SEED}, kept as {kept}") from error
        assert time.monotonic() - begun < LONGEST, f"input {number} of {name}, seed {SEED}"
        more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory
        assert more < MOST_MEMORY, f"input {number} of {name}, seed {SEED}"
