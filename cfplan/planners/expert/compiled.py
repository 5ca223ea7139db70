"""C source as machine code, where there is a C compiler.

Source is generated and compiled once a machine, and kept in the user's cache folder under a name that hashes
everything it depends on; a second process that compiles at the same time ends with the same file.
"""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path as FilePath

import casadi

COMPILER_OPTIONS = ("-O2", "-march=native", "-fno-math-errno", "-fPIC", "-shared")
COMPILE_TIMEOUT = 120.0
# s


class Backend(StrEnum):
    """How generated functions are evaluated."""

    COMPILED = "compiled"
    VIRTUAL_MACHINE = "virtual machine"


def compiler() -> str | None:
    """Path of the C compiler, or None. CC chooses another."""
    return shutil.which(os.environ.get("CC") or "cc") or shutil.which("gcc") or shutil.which("clang")


def cache_folder() -> FilePath:
    """Where compiled code is kept: CFPLAN_CACHE, or the platform's cache folder."""
    if chosen := os.environ.get("CFPLAN_CACHE"):
        return FilePath(chosen)
    if sys.platform == "darwin":
        return FilePath.home() / "Library" / "Caches" / "cfplan"
    return FilePath(os.environ.get("XDG_CACHE_HOME") or FilePath.home() / ".cache") / "cfplan"


def shared_library(name: str, depends_on: Sequence[FilePath], source: Callable[[], str]) -> FilePath | None:
    """The compiled source, made now if need be; None where that is not possible.

    `source` is asked only then; it must depend on nothing but the files `depends_on`.
    """
    try:
        folder = cache_folder()
        target = folder / f"{name}-{_key(depends_on)}.so"
        if not target.exists():
            folder.mkdir(parents=True, exist_ok=True)
            _compile(target, source())
        return target
    except (OSError, RuntimeError, subprocess.SubprocessError):
        return None


def _key(depends_on: Sequence[FilePath]) -> str:
    sources = [file.read_bytes() for file in (FilePath(__file__), *depends_on)]
    machine = f"{casadi.CasadiMeta.version()} {platform.platform()} {_processor()} {compiler()} {COMPILER_OPTIONS}"
    return hashlib.sha256(b"".join([*sources, machine.encode()])).hexdigest()[:20]


def _processor() -> str:
    """What -march=native depends on: a cache folder may be shared by machines that differ."""
    try:
        lines = FilePath("/proc/cpuinfo").read_text().splitlines()
        return "".join(
            line for line in lines[: lines.index("")] if line.startswith(("flags", "Features", "model name"))
        )
    except OSError:
        return f"{platform.machine()} {platform.processor()}"


def _compile(target: FilePath, source: str) -> None:
    tool = compiler()
    if tool is None:
        raise FileNotFoundError("no C compiler")
    with tempfile.TemporaryDirectory(dir=target.parent, prefix="compile-") as name:
        file, made = FilePath(name) / "source.c", FilePath(name) / "made.so"
        file.write_text(source)
        subprocess.run(
            [tool, *COMPILER_OPTIONS, str(file), "-o", str(made), "-lm"],
            check=True, capture_output=True, timeout=COMPILE_TIMEOUT,
        )  # fmt: skip
        os.replace(made, target)  # at once, so that no other process sees half of it
