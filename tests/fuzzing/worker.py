"""The process that reads absurd inputs: each by its number and seed, and each watched for time, memory and exceptions.

It keeps the number of the input under way and its totals in shared memory, so that the process above knows which one
hangs or kills, and writes a line of JSON for each finding.
"""

import contextlib
import json
import mmap
import os
import resource
import struct
import sys
import time
import traceback
import warnings
from pathlib import Path
from random import Random
from typing import Any

from cfplan.errors import CfplanError, printable
from tests.fuzzing.files import emptied
from tests.fuzzing.readers import READERS

MOST_MEMORY = 1_000_000  # kB, more than before the input
# bytes of address space: an input that takes more than is allowed is found, and the machine is not filled
_HEADROOM = 6 << 30
_LONGEST_MESSAGE = 2000  # characters
# The input under way (-1 before the first, -1 - N at the end before N); when it began, s, by the clock and by the
# processor's time of this process; inputs read and refused, their time and the longest of it, s, and the most memory
# that one took, kB.
PROGRESS = struct.Struct("<qddqqddq")


class Watch:
    """Uses inputs, and keeps account of them."""

    def __init__(self, name: str, seed: int, folder: Path):
        self._name, self._seed, self._folder = name, seed, folder
        self._reader = READERS[name]
        self._sound = self._reader.sound(emptied(folder / "sound"))
        self._work = folder / "work"
        self._count, self._refused, self._seconds, self._longest, self._memory = 0, 0, 0.0, 0.0, 0
        with (folder / "progress").open("r+b") as file:
            self._shared = mmap.mmap(file.fileno(), PROGRESS.size)

    def prepare(self, number: int) -> None:
        """Put the input of this number into the folder."""
        work = emptied(self._work)
        self._reader.spoil(self._sound, Random(f"{self._seed} {self._name} {number}"), work)

    def warm_up(self) -> None:
        """Use some inputs that are not counted: what is loaded and made once is not theirs."""
        for number in range(-3, 0):
            self.prepare(number)
            with contextlib.suppress(BaseException):
                self._reader.use(self._work)

    def use(self, number: int) -> None:
        """Prepare and use an input; what is wrong with how it ends is a finding."""
        self.prepare(number)
        self._note(number)
        before = _reset_peak()
        finding = ""
        begun = time.monotonic()
        try:
            self._reader.use(self._work)
        except CfplanError as error:
            self._refused += 1
            finding = _flaw(error)
        except BaseException:  # numba and pyarrow have others than Exception
            finding = traceback.format_exc()
        took, memory = time.monotonic() - begun, max(0, _status("VmHWM") - before)
        if memory > MOST_MEMORY:
            finding = finding or f"{memory / 1e6:.1f} GB"
        self._count, self._seconds = self._count + 1, self._seconds + took
        self._longest, self._memory = max(self._longest, took), max(self._memory, memory)
        self._note(number)
        if finding:
            with (self._folder / "findings.jsonl").open("a") as findings:
                findings.write(json.dumps({"number": number, "what": finding}) + "\n")

    def end(self, number: int) -> None:
        """Say that all inputs before this number have been used."""
        self._note(-1 - number)

    def _note(self, number: int) -> None:
        totals: tuple[Any, ...] = (self._count, self._refused, self._seconds, self._longest, self._memory)
        # as a whole: pack_into() would write zeros first, and the process above would read a time of long ago
        self._shared[:] = PROGRESS.pack(number, time.monotonic(), time.process_time(), *totals)


def _flaw(error: CfplanError) -> str:
    """Return what a user would miss in an error; empty where nothing."""
    text = str(error)
    flaws = [
        (not error.hint, "no hint"),
        (not error.where, "no place"),
        (printable(text) != text, "more than a line of text"),
        (len(text) > _LONGEST_MESSAGE, f"{len(text)} characters"),
    ]
    found = ", ".join(flaw for is_flaw, flaw in flaws if is_flaw)
    raised = traceback.extract_tb(error.__traceback__)[-1]
    return f"{found} [{raised.filename}:{raised.lineno}]: {text[:300]}" if found else ""


def _status(key: str) -> int:
    """Return a figure of /proc/self/status, kB."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith(key))


def _reset_peak() -> int:
    """Let the peak of memory begin anew; return the memory in use, kB."""
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
    return _status("VmRSS")


def main() -> None:
    """Run `python -m tests.fuzzing.worker READER SEED BEGIN END FOLDER`."""
    name, seed, begin, end, folder = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), sys.argv[5]
    warnings.simplefilter("error", RuntimeWarning)  # NumPy's would reach the user's terminal
    watch = Watch(name, seed, Path(folder))
    watch.warm_up()
    begun_with = 1024 * _status("VmSize")
    resource.setrlimit(resource.RLIMIT_AS, (begun_with + _HEADROOM,) * 2)
    for number in range(begin, end):
        watch.use(number)
        if 1024 * _status("VmSize") > begun_with + _HEADROOM // 2:  # rerun keeps threads of every recording
            break
    watch.end(number + 1)
    sys.stdout.flush()
    os._exit(0)  # threads of a link may not end


if __name__ == "__main__":
    main()
