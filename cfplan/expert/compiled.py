"""The point functions, as machine code where there is a C compiler, else through CasADi's virtual machine.

The C source is generated and compiled once a machine, and kept in the user's cache folder under a name that hashes
everything it depends on; a second process that compiles at the same time ends with the same file.
"""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from enum import StrEnum
from functools import lru_cache
from pathlib import Path as FilePath

import casadi

from cfplan.expert import stage
from cfplan.vehicle import airframe, flatness

COMPILER_OPTIONS = ("-O2", "-fno-math-errno", "-fPIC", "-shared")
COMPILE_TIMEOUT = 120.0
# s


class Backend(StrEnum):
    """How the point functions are evaluated."""

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


@lru_cache(maxsize=1)
def library() -> FilePath | None:
    """The compiled point functions, made now if need be; None where that is not possible."""
    try:
        folder = cache_folder()
        target = folder / f"stage-{_key()}.so"
        if not target.exists():
            folder.mkdir(parents=True, exist_ok=True)
            _compile(target)
        return target
    except (OSError, RuntimeError, subprocess.SubprocessError):
        return None


def backend() -> Backend:
    """Which one `functions()` uses here; compiles if that was never done."""
    return Backend.COMPILED if library() else Backend.VIRTUAL_MACHINE


@lru_cache(maxsize=4)
def functions(chosen: Backend | None = None) -> Mapping[str, casadi.Function]:
    """The point functions by name, see `stage.point_functions`."""
    interpreted = _interpreted()
    if chosen == Backend.VIRTUAL_MACHINE or not (path := library()):
        return interpreted
    try:
        return {name: casadi.external(name, str(path)) for name in interpreted}
    except RuntimeError:  # a library that this machine cannot load
        return interpreted


@lru_cache(maxsize=1)
def _interpreted() -> Mapping[str, casadi.Function]:
    return {f.name(): f for free_yaw in (False, True) for f in stage.point_functions(free_yaw)}


def _key() -> str:
    sources = [FilePath(module.__file__).read_bytes() for module in (stage, flatness, airframe) if module.__file__]
    machine = f"{casadi.CasadiMeta.version()} {platform.platform()} {platform.machine()} {COMPILER_OPTIONS}"
    return hashlib.sha256(b"".join([*sources, machine.encode()])).hexdigest()[:20]


def _compile(target: FilePath) -> None:
    tool = compiler()
    if tool is None:
        raise FileNotFoundError("no C compiler")
    with tempfile.TemporaryDirectory(dir=target.parent, prefix="compile-") as name:
        generator = casadi.CodeGenerator("stage.c")
        for function in _interpreted().values():
            generator.add(function)
        generator.generate(name + os.sep)
        made = FilePath(name) / "stage.so"
        subprocess.run(
            [tool, *COMPILER_OPTIONS, str(FilePath(name) / "stage.c"), "-o", str(made), "-lm"],
            check=True, capture_output=True, timeout=COMPILE_TIMEOUT,
        )  # fmt: skip
        os.replace(made, target)  # at once, so that no other process sees half of it
