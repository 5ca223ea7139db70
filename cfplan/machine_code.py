"""Compile functions by numba, and cache the machine code for later processes under one key over all sources.

Modules import `njit` from here. numba caches compiled code in files, with an index for each function by argument types
and processor. Here these files lie in a folder named by a hash of cfplan's sources and the versions of the compilers,
so none can be out of date. If the folder cannot be written, each process compiles for itself.

Loading is numba's own, without two steps that only compilation needs: importing numba's compiler, and parsing the
bitcode of every function. Without them `cfplan plan` starts 0.5 s sooner.
"""

import fcntl
import gc
import hashlib
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numba
import numpy as np
from numba.core import environment, event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserProvidedCacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import cpu_target
from numba.core.runtime._nrt_python import c_helpers

PACKAGE = Path(__file__).parent
LEAVES = ("cli", "steering", "air", "preparation")  # packages on which no compiled function depends
_KEPT_DAYS = 60.0


def cache_folder() -> Path:
    """Return the folder for compiled code: CFPLAN_CACHE, or the platform's cache folder."""
    if chosen := os.environ.get("CFPLAN_CACHE"):
        return Path(chosen)
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "cfplan"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cfplan"


def hash_of_sources() -> str:
    """Return the hash of all that compiled code depends on, except the processor."""
    versions = numba.__version__, llvmlite.__version__, np.__version__, platform.python_version()
    found = hashlib.sha256(repr(versions).encode())
    for file in sorted(PACKAGE.rglob("*.py")):
        name = file.relative_to(PACKAGE)
        if name.parts[0] not in LEAVES:
            found.update(f"{name} {file.stat().st_size} ".encode() + file.read_bytes())
    return found.hexdigest()[:20]


KEY = hash_of_sources()  # when this process began


def code_folder() -> Path:
    """Return the folder of the code compiled from these sources."""
    return cache_folder() / KEY


@lru_cache(maxsize=8)
def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "lock").touch()
        return True
    except OSError:
        return False


def cache_writable() -> bool:
    """Return whether compiled code can be cached."""
    return _writable(code_folder())


def count_functions() -> int:
    """Return how many functions are cached, counting each set of argument types."""
    return sum(1 for _ in code_folder().glob("*.nbc"))


def delete_unused() -> None:
    """Delete the code of sources that no process has used for a long time."""
    oldest = time.time() - _KEPT_DAYS * 86400
    for lock in cache_folder().glob("*/lock"):
        if lock.stat().st_mtime < oldest:
            shutil.rmtree(lock.parent, ignore_errors=True)


class _Locator(UserProvidedCacheLocator):
    """Names the cache files of a function."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file, self._folder = file, str(code_folder())
        self._name = f"{function.__module__}-{function.__code__.co_firstlineno}"

    def get_cache_path(self) -> str:
        return self._folder

    def get_disambiguator(self) -> str:
        return self._name

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> "_Locator":
        return cls(py_func, py_file)


class _CacheFiles(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012, as numba declares it


class _Cache(FunctionCache):
    """numba's cache of one function, for several processes at once."""

    _impl_class = _CacheFiles

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Lock an index and the files that it names, if the file system has locks."""
        with Path(self.cache_path, "lock").open("ab") as file:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled function, or None if it is not cached, without importing numba's compiler."""
        with self._locked():
            try:
                return self._load_overload(sig, target_context)
            except (EOFError, UnpicklingError):  # a damaged file, for instance after a power cut
                self.flush()
                return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Cache a compiled function, unless sources have changed since this process began; a full disk is no error."""
        _listener.on_start(None)  # this counts as compiling
        try:
            if hash_of_sources() == KEY:
                with suppress(OSError), self._locked():
                    super().save_overload(sig, data)
        finally:
            _listener.on_end(None)


class _Library(JITCodeLibrary):
    """Machine code of one function, whose bitcode is parsed when a function that calls it is compiled."""

    _object = b""  # where it was kept
    _bitcode = b""
    _module: Any = None

    @property
    def _shared_module(self) -> Any:
        if self._module is None and self._bitcode:
            self._module = llvm.parse_bitcode(self._bitcode)
        return self._module

    @_shared_module.setter
    def _shared_module(self, module: Any) -> None:
        self._module = module

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> "_Library":
        name, _, (object_code, bitcode) = state
        library = cls(codegen, name)
        library._object, library._bitcode = object_code, bitcode
        library.enable_object_caching()
        library._set_compiled_object(object_code)
        library._finalize_final_module()
        return library

    def get_pointer_to_function(self, name: str) -> int:
        """Return the address of a function, 0 if the library does not have it."""
        if not self._object:
            return int(super().get_pointer_to_function(name))
        return int(self._codegen._engine.get_function_address(name)) if name.encode() in self._object else 0


def _environment(module: str, constants: list[Any], name: str) -> environment.Environment:
    """Return the environment of a compiled function; its globals matter only to code that is not compiled."""
    made = environment.lookup_environment(name)
    if made is None:
        made = environment.Environment(vars(sys.modules[module]) if module in sys.modules else {"__name__": module})
        made.consts[:] = constants
        made.env_name = name
        environment.Environment._memo[name] = made
    return made


cpu_target.target_context.codegen()._library_class = _Library
environment._rebuild_env = _environment  # numba's own imports the module
for _helper, _address in c_helpers.items():  # numba adds these when it imports its compiler
    llvm.add_symbol(_helper if _helper.startswith("_") else f"NRT_{_helper}", _address)


class _Compiling(event.Listener):
    """Suspends garbage collection during compilation, which makes millions of objects."""

    depth = 0
    collector_was_on = False
    begun, seconds = 0.0, 0.0  # s

    def on_start(self, event: Any) -> None:
        if self.depth == 0:
            self.collector_was_on = gc.isenabled()
            gc.disable()
            self.begun = time.monotonic()
        self.depth += 1

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if self.depth == 0:
            self.seconds += time.monotonic() - self.begun
            if self.collector_was_on:
                gc.enable()


_listener = _Compiling()
event.register("numba:compile", _listener)


def compiles() -> bool:
    """Return whether this process is compiling right now."""
    return _listener.depth > 0


def time_without_compiling() -> float:
    """Return the time, s, on a clock that stands still while this process compiles."""
    return (_listener.begun if _listener.depth else time.monotonic()) - _listener.seconds


def njit(function: Callable[..., Any] | None = None, *, allocates: bool = True, **options: Any) -> Any:
    """Compile a function at its first call for each set of argument types, like numba.njit, and cache the result.

    Use `allocates=False` for a function that neither makes nor returns arrays: it then counts no references to its
    arguments, which halves the time of a step of the simulated vehicle.
    """
    if function is None:
        return lambda each: njit(each, allocates=allocates, **options)
    made: Any = numba.njit(**{"_nrt": allocates, "no_cfunc_wrapper": True, **options})(function)
    with_source = os.path.exists(function.__code__.co_filename)  # else it was typed interactively
    if hasattr(made, "_cache") and with_source and cache_writable():  # numba may be switched off
        made._cache = _Cache(function)
    return made


def vector_width() -> int:
    """Return how many doubles a vector register of the target processor holds."""
    features = cpu_target.target_context.codegen().magic_tuple()[2].split(",")
    return 8 if "+avx512f" in features else 4 if "+avx" in features else 2
