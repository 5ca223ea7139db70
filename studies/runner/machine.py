"""Describe the measuring machine, and limit libraries to one thread. Imports nothing heavy: call one_thread first."""

import math
import os
import platform
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from cfplan.errors import InputError
from cfplan.version import __version__

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
PACKAGES = ("casadi", "copp-py", "numba", "numpy", "scikit-learn", "scipy", "torch")


@dataclass(frozen=True, slots=True)
class Machine:
    """The machine and libraries that a measured time depends on."""

    processor: str
    cores: int  # usable by this process
    system: str
    python: str
    cfplan: str
    packages: dict[str, str]
    threads: dict[str, str]  # the environment variables of THREADS, "" where unset


def one_thread() -> None:
    """Ask numerical libraries for one thread each.

    Raises:
        InputError: numpy is already loaded with another number of threads.
    """
    late = "numpy" in sys.modules and any(os.environ.get(name) != "1" for name in THREADS[:2])
    if late:
        raise InputError("numpy is loaded with several threads already", hint="set OMP_NUM_THREADS=1 before starting")
    for name in THREADS:
        os.environ[name] = "1"


def this_machine() -> Machine:
    """Return a description of this machine."""
    packages = {}
    for name in PACKAGES:
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            continue
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Machine(
        processor=_processor(),
        cores=cores,
        system=f"{platform.system()} {platform.release()}",
        python=platform.python_version(),
        cfplan=__version__,
        packages=packages,
        threads={name: os.environ.get(name, "") for name in THREADS},
    )


def _processor() -> str:
    file = Path("/proc/cpuinfo")
    if file.is_file():
        for line in file.read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def process_memory(name: str) -> float:
    """Return VmRSS, the present memory of this process, or VmHWM, its peak, in MB, on Linux; NaN elsewhere.

    Unlike that of getrusage, the peak does not include that of the process that started this one.
    """
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return math.nan
    return next((1.024e-3 * int(line.split()[1]) for line in status.splitlines() if line.startswith(name)), math.nan)
