"""Wrong input of every kind, by hypothesis: it is read, or refused in one line with place and hint, and does no harm.

`make fuzz` draws many more: `python -m tests.bad_input --inputs 100000`.
"""

import os
import resource
import shutil
import signal
import warnings
from contextlib import contextmanager, suppress
from pathlib import Path
from random import Random

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from cfplan.errors import CfplanError, ExitCode, InputError, printable
from tests.bad_input.files import FILES, MADE, REPOSITORY, taken
from tests.bad_input.packets import PACKETS

INPUTS = FILES | PACKETS
EXAMPLES = int(os.environ.get("BAD_INPUTS", "600")) / sum(kind.fraction for kind in INPUTS.values())
PLANNED = ("paths", "points", "curve", "polynomials", "samples", "safety", "airframes")  # valid input may be infeasible
_PROCESSOR_TIME = 10.0  # s for one input, not counting other processes
_MOST_MEMORY = 1_000_000  # kB for one input
_ADDRESSES = 6 << 30  # bytes of address space for one input, so that it cannot exhaust the machine
_LONGEST_MESSAGE = 2000  # characters


@pytest.mark.parametrize("name", INPUTS)
def test_wrong_input_is_read_or_refused_with_place_and_hint(tmp_path, name):
    kind, folder = INPUTS[name], tmp_path / "input"  # a failing input is left there
    sound = kind.sound(tmp_path)
    for number in range(3):  # loading and compiling do not count for any input
        with suppress(Exception):
            kind.spoil(sound, Random(number), emptied(folder))
            kind.use(folder)

    @settings(
        max_examples=max(3, round(EXAMPLES * kind.fraction)), deadline=None, suppress_health_check=list(HealthCheck),
        phases=(Phase.reuse, Phase.generate),  # shrinking an input would take minutes
    )  # fmt: skip
    @given(chance=st.randoms(use_true_random=False))
    def check(chance: Random) -> None:
        kind.spoil(sound, chance, emptied(folder))
        given_files = taken(folder)
        (folder / MADE).mkdir()
        try:
            with bounded():
                kind.use(folder)
        except CfplanError as error:
            check_refusal(error, name, folder)
            if name in FILES:
                assert taken(folder) == given_files, "a refused input has left files behind"

    check()


def emptied(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def check_refusal(error: CfplanError, name: str, folder: Path) -> None:
    """Check that a person can act on an error."""
    text = str(error)
    assert error.hint, f"no hint: {text}"
    assert error.where, f"no place: {text}"
    assert printable(text) == text
    assert len(text) <= _LONGEST_MESSAGE
    if name in FILES and isinstance(error, InputError):
        assert str(folder) in error.where or str(REPOSITORY) in error.where, f"no file: {text}"
    if name in FILES and name not in PLANNED:
        assert error.exit_code is ExitCode.USAGE, text


@contextmanager
def bounded():
    """Limit processor time and memory, and turn warnings that would reach the user's terminal into errors."""

    def too_long(*_):
        raise AssertionError(f"more than {_PROCESSOR_TIME:g} s")

    before, limits = _status("VmRSS"), resource.getrlimit(resource.RLIMIT_AS)
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak memory
    resource.setrlimit(resource.RLIMIT_AS, (1024 * _status("VmSize") + _ADDRESSES, limits[1]))
    handler = signal.signal(signal.SIGVTALRM, too_long)
    signal.setitimer(signal.ITIMER_VIRTUAL, _PROCESSOR_TIME)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert _status("VmHWM") - before < _MOST_MEMORY, "too much memory"


def _status(key: str) -> int:
    """Return a figure of this process, kB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(key))
