"""Fuzz readers in processes that are watched: what hangs or dies is killed, noted, and gone on behind."""

import json
import mmap
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from tests.fuzzing.files import REPOSITORY, emptied
from tests.fuzzing.readers import READERS
from tests.fuzzing.worker import PROGRESS

LONGEST = 10.0  # s for one input: of the processor, as others may have it meanwhile
_SLEEPY = 60.0  # s for one that needs no processor
_START = 180.0  # s for the first, before which sound inputs are made and code is compiled
_FRAME = re.compile(r'File "[^"]*/(cfplan/[^"]+)", line (\d+)')


@dataclass
class Outcome:
    """What became of the inputs of one reader."""

    reader: str
    inputs: int = 0
    refused: int = 0
    seconds: float = 0.0
    longest: float = 0.0  # s
    memory: int = 0  # kB
    findings: list[tuple[int, str]] = field(default_factory=list)  # number of the input, what

    def kinds(self) -> dict[str, list[int]]:
        """Return the numbers of the inputs by the place in the code, the first line of what is alike."""
        found: dict[str, list[int]] = {}
        for number, what in self.findings:
            frames = _FRAME.findall(what)
            last = what.strip().splitlines()[-1]
            kind = (
                f"{frames[-1][0]}:{frames[-1][1]} {last.split(':')[0]}" if frames else re.sub(r"\d+", "N", what)[:120]
            )
            found.setdefault(kind, []).append(number)
        return found


def shares(inputs: int, names: list[str]) -> dict[str, int]:
    """Return how many of so many inputs each reader gets."""
    whole = sum(READERS[name].weight for name in names)
    return {name: max(1, round(inputs * READERS[name].weight / whole)) for name in names}


def fuzz(counts: dict[str, int], seed: int, folder: Path, *, workers: int = 1) -> list[Outcome]:
    """Fuzz each reader with so many inputs."""
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(lambda name: _reader(name, counts[name], seed, emptied(folder / name)), counts))


def _reader(name: str, count: int, seed: int, folder: Path) -> Outcome:
    outcome, begin = Outcome(name), 0
    while begin < count:
        begin = _stretch(outcome, seed, begin, count, folder)
    findings = folder / "findings.jsonl"
    if findings.exists():
        lines = findings.read_text().splitlines()
        outcome.findings += [(line["number"], line["what"]) for line in map(json.loads, lines)]
    return outcome


def _stretch(outcome: Outcome, seed: int, begin: int, end: int, folder: Path) -> int:
    """Let a process use inputs; return the number of the first that it did not use."""
    (folder / "progress").write_bytes(PROGRESS.pack(-1, time.monotonic(), 0.0, 0, 0, 0.0, 0.0, 0))
    command = [
        sys.executable,
        "-m",
        "tests.fuzzing.worker",
        outcome.reader,
        str(seed),
        str(begin),
        str(end),
        str(folder),
    ]
    with (folder / "progress").open("r+b") as file, (folder / "output").open("ab") as output:
        shared = mmap.mmap(file.fileno(), PROGRESS.size)
        process = subprocess.Popen(command, cwd=REPOSITORY, stdout=output, stderr=output)
        hung = False
        while process.poll() is None and not hung:
            number, since, used, *_ = PROGRESS.unpack_from(shared)
            waited = time.monotonic() - since
            hung = waited > (_SLEEPY if number >= 0 else _START)
            hung = hung or (number >= 0 and waited > LONGEST and _processor_time(process.pid) - used > LONGEST)
            time.sleep(0.05)
        if hung:
            process.send_signal(signal.SIGKILL)
        process.wait()
        number, _, _, inputs, refused, seconds, longest, memory = PROGRESS.unpack_from(shared)
    outcome.inputs, outcome.refused = outcome.inputs + inputs, outcome.refused + refused
    outcome.seconds, outcome.longest = outcome.seconds + seconds, max(outcome.longest, longest)
    outcome.memory = max(outcome.memory, memory)
    if process.returncode == 0:
        return -1 - number
    last = (folder / "output").read_text(errors="replace")[-2000:]
    if number < 0:
        outcome.findings.append((begin, f"the fuzzing itself failed: {last}"))
        return end
    outcome.findings.append(
        (number, f"took more than {LONGEST:g} s" if hung else f"died by {-process.returncode}: {last}")
    )
    outcome.inputs += 1
    return number + 1


def _processor_time(process: int) -> float:
    """Return the time, s, that a process has had of the processor; 0 where it has ended."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
