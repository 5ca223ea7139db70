"""Machine code, by numba and LLVM, and the folder in which it is kept for the next process.

Modules take `njit` from here. What a function is compiled to is kept in a file whose name hashes everything that it
depends on: the module's source, the sources of all cfplan modules that it imports, directly or not, the versions of the
compilers, the processor, and the types of the arguments. So no file can be out of date, and none is ever changed. If a
source has changed since this process began, which may have imported the old one, the process compiles for itself only.
Where two processes need the same function, one compiles it and the other waits. Where the folder cannot be written,
each process compiles for itself.
"""

import ctypes
import gc
import hashlib
import importlib
import inspect
import io
import os
import pickle
import platform
import re
import secrets
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite
import llvmlite.binding as llvm
import numba
import numpy as np
from numba.core import event
from numba.core.caching import _Cache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult
from numba.core.environment import Environment, _rebuild_env, lookup_environment
from numba.core.registry import cpu_target
from numba.core.runtime._nrt_python import c_helpers
from numba.core.serialize import dumps
from numba.core.types import Omitted
from numba.core.typing.typeof import Purpose, typeof

PACKAGE = Path(__file__).parent
_BEGUN = time.time()  # s, when this process began
_IMPORT = re.compile(r"^\s*from (cfplan[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)
_KEPT_DAYS = 60.0  # after which files that no process has read are deleted
_DIGEST = 32  # bytes of the checksum before a file's content
_PLACES = 2**30  # bytes of the lock file, of which each function locks one


def cache_folder() -> Path:
    """Return where compiled code is kept: CFPLAN_CACHE, or the platform's cache folder."""
    if chosen := os.environ.get("CFPLAN_CACHE"):
        return Path(chosen)
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "cfplan"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cfplan"


@lru_cache(maxsize=8)
def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
        return True
    except OSError:
        return False


def kept() -> bool:
    """Return whether the cache folder can be written."""
    return _writable(cache_folder())


def _processor() -> tuple[str, str]:
    """Return name and features of the processor to compile for: this computer's, or that of NUMBA_CPU_NAME."""
    _, name, features = cpu_target.target_context.codegen().magic_tuple()
    return name, features


@lru_cache(maxsize=1)
def _machine() -> bytes:
    """Return what machine code depends on besides sources; a cache folder may be shared by machines that differ."""
    versions = (numba.__version__, llvmlite.__version__, np.__version__, platform.python_version())
    return repr((versions, *_processor())).encode()


@lru_cache(maxsize=512)
def _source(module: str) -> tuple[str, tuple[str, ...]]:
    """Return a module's hash, and the cfplan modules that it imports; none where the name is no module.

    If the file has changed since this process began, the hash is a random one, which no other process has.
    """
    first, *parts = module.split(".")
    if first == PACKAGE.name:
        path = PACKAGE.joinpath(*parts)
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    else:
        path = Path(getattr(sys.modules.get(module), "__file__", None) or "none")
    try:
        text = path.read_bytes()
        changed = path.stat().st_ctime > _BEGUN
    except OSError:
        return "", ()
    imported: list[str] = []
    for package, names in _IMPORT.findall(text.decode()):
        members = (name.split()[0] for name in names.strip("()").split(",") if name.strip())
        imported += [package, *(f"{package}.{member}" for member in members)]
    return secrets.token_hex() if changed else hashlib.sha256(text).hexdigest(), tuple(imported)


@lru_cache(maxsize=512)
def key(module: str) -> str:
    """Return the hash of a module, of all that it imports of this package, of the compilers and of the processor."""
    found, waiting = {}, [module]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found[name], imported = _source(name)
            waiting += imported
    return hashlib.sha256(_machine() + repr(sorted(found.items())).encode()).hexdigest()


def _name(title: str, *parts: str) -> str:
    return f"{title}-{hashlib.sha256(repr(parts).encode()).hexdigest()[:20]}"


def _read(name: str) -> bytes | None:
    """Return what a file of the cache folder holds, if it is there and whole."""
    file = cache_folder() / name
    try:
        data = file.read_bytes()
        if time.time() - file.stat().st_mtime > 86400:
            os.utime(file)  # not to be deleted: it is in use
    except OSError:
        return None
    digest, content = data[:_DIGEST], data[_DIGEST:]
    return content if hashlib.sha256(content).digest() == digest else None


def _write(name: str, data: bytes) -> None:
    """Put a file into the cache folder, whole or not at all; a full disk is no error."""
    folder = cache_folder()
    try:
        handle, made = tempfile.mkstemp(dir=folder, prefix="making-")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(data).digest() + data)
            os.replace(made, folder / name)
        except BaseException:
            os.unlink(made)
            raise
    except OSError:
        pass


class _Locks:
    """Which process compiles what: a lock on one byte of a file for each function. It ends with the process."""

    def __init__(self) -> None:
        self.folder: Path | None = None
        self.file: Any = None

    def take(self, name: str, *, wait: bool = True) -> bool:
        """Return whether this process may compile; where another does, wait until it has, or do not."""
        import fcntl

        try:
            if self.folder != cache_folder():
                self.folder, self.file = cache_folder(), (cache_folder() / "locks").open("a+b")
            fcntl.lockf(self.file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB), 1, self._place(name))
        except BlockingIOError:
            return False
        except OSError:
            pass  # a file system without locks: the same may be compiled twice
        return True

    def give_back(self, name: str) -> None:
        import fcntl

        if self.file is not None:
            with suppress(OSError):
                fcntl.lockf(self.file, fcntl.LOCK_UN, 1, self._place(name))

    @staticmethod
    def _place(name: str) -> int:
        return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") % _PLACES


_locks = _Locks()


class _Compiling(event.Listener):
    """Keeps the garbage collector from walking through a compiler's millions of objects again and again."""

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


class _Library(JITCodeLibrary):
    """Machine code of one function. Where it was kept, its bitcode waits until a function that calls it is compiled.

    numba's own parses it at once and lists its symbols, which takes as long as all the rest of loading.
    """

    _object: bytes | None = None
    _bitcode: bytes | None = None
    _module: Any = None

    @property
    def _shared_module(self) -> Any:
        if self._module is None and self._bitcode is not None:
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
        """Return the address of a function, 0 if it is not here."""
        if self._object is None:
            return int(super().get_pointer_to_function(name))
        return int(self._codegen._engine.get_function_address(name)) if name.encode() in self._object else 0


cpu_target.target_context.codegen()._library_class = _Library
for _helper, _address in c_helpers.items():  # which numba does where it compiles, beside much else
    llvm.add_symbol(_helper if _helper.startswith("_") else f"NRT_{_helper}", _address)


class _Unpickler(pickle.Unpickler):
    """Reads compiled functions without importing the parts of numba that their code comes from."""

    def find_class(self, module: str, name: str) -> Any:
        found = super().find_class(module, name)
        return _environment if found is _rebuild_env else found


def _environment(module: str, constants: list[Any], name: str) -> Environment:
    """Return the environment of a compiled function; its globals are for code that was not compiled."""
    environment = lookup_environment(name)
    if environment is None:
        environment = Environment(vars(sys.modules[module]) if module in sys.modules else {"__name__": module})
        environment.consts[:] = constants
        environment.env_name = name
        Environment._memo[name] = environment
    return environment


class _Kept(_Cache):
    """numba's cache of one function, with one file for each set of argument types."""

    def __init__(self, function: Callable[..., Any]):
        self._module, self._title = function.__module__, f"{function.__module__}.{function.__qualname__}"
        self._line = str(function.__code__.co_firstlineno)

    @property
    def cache_path(self) -> str:
        return str(cache_folder())

    def file_name(self, signature: Any) -> str:
        """Return the name of the file for these types of arguments."""
        return _name(self._title, self._line, key(self._module), str(signature)) + ".numba"

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        """Return the compiled function, waiting if another process compiles it; None if that is ours to do."""
        if not kept():
            return None
        name = self.file_name(sig)
        result = self._load(name, sig, target_context)
        if result is None:
            _locks.take(name)  # until give_back()
            result = self._load(name, sig, target_context)
        return result

    def _load(self, name: str, signature: Any, target_context: Any) -> CompileResult | None:
        data = _read(name)
        if data is None:
            return None
        written_for, payload = _Unpickler(io.BytesIO(data)).load()
        return CompileResult._rebuild(target_context, *payload) if written_for == str(signature) else None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled function for other processes."""
        if not kept():
            return
        name = self.file_name(sig)
        if not data.library.has_dynamic_globals:
            _write(name, dumps((str(sig), data._reduce())))

    def give_back(self, sig: Any) -> None:
        """Release the lock of a compilation, which has ended or failed, to the processes that wait for it."""
        if kept():
            _locks.give_back(self.file_name(sig))

    def enable(self) -> None: ...

    def disable(self) -> None: ...

    def flush(self) -> None: ...


def njit(
    function: Callable[..., Any] | None = None,
    *,
    interpreted: Callable[..., Any] | None = None,
    allocates: bool = True,
    **options: Any,
) -> Any:
    """Compile a function at its first call for each set of argument types, as numba.njit does, and keep the result.

    `interpreted` does the same with numpy, for all elements at once, where loops would take Python too long: see
    without_compiling(). A function that makes no arrays and returns none may say so with `allocates=False`: it then
    counts no references to those that it is given, which is half of the time of a step of the simulated vehicle.
    """
    if function is None:
        return lambda each: njit(each, interpreted=interpreted, allocates=allocates, **options)
    options["_nrt"] = allocates
    if _stand_in is not None:
        return _stand_in(function, interpreted or function, options)
    return _compiling(function, options)


def _compiling(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    options = {"no_cfunc_wrapper": True, **options}
    made: Any = numba.njit(**options)(function)
    if hasattr(made, "_cache"):  # else numba is switched off
        made._cache = cache = _Kept(function)
        made.compile = _giving_back(made.compile, cache)
    return made


def _giving_back(compile_types: Callable[[Any], Any], cache: _Kept) -> Callable[[Any], Any]:
    """Return a dispatcher's compile() that also releases the lock that the cache has taken, even if it raises."""

    def compile_and_give_back(sig: Any) -> Any:
        try:
            return compile_types(sig)
        finally:
            cache.give_back(sig)

    return compile_and_give_back


def kept_or_made(title: str, module: str, make: Callable[[], bytes]) -> bytes:
    """Return what was made earlier, or make it now and keep it, unless another process does: then wait for that.

    What is made depends on nothing but the module and what that imports.
    """
    if not kept():
        return make()
    name = _name(title, key(module)) + ".kept"
    data = _read(name)
    if data is None:
        _locks.take(name)
        try:
            data = _read(name)
            if data is None:
                _listener.on_start(None)
                try:
                    data = make()
                finally:
                    _listener.on_end(None)
                _write(name, data)
        finally:
            _locks.give_back(name)
    return data


def llvm_functions(title: str, module: str, source: Callable[[], str], names: tuple[str, ...]) -> dict[str, Any]:
    """Return functions of LLVM source, to be called through ctypes; see kept_or_made for the arguments."""
    target = _target_machine()
    data = kept_or_made(title, module, lambda: target.emit_object(_parsed(source(), target)))
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target)
    engine.add_object_file(llvm.ObjectFileRef.from_data(data))
    engine.finalize_object()
    _engines.append(engine)
    return {each: ctypes.CFUNCTYPE(None)(engine.get_function_address(each)) for each in names}


_engines: list[Any] = []  # that own the code of functions handed out


def vector_width() -> int:
    """Return how many doubles a register of the processor holds: wider vectors would only crowd the registers."""
    features = _processor()[1].split(",")
    return 8 if "+avx512f" in features else 4 if "+avx" in features else 2


def _target_machine() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    cpu, features = _processor()
    return llvm.Target.from_default_triple().create_target_machine(cpu=cpu, features=features, opt=2, jit=True)


def _parsed(source: str, target: Any) -> Any:
    """Return the module of LLVM source, inlined where it says so.

    Nothing else is rearranged: what LLVM moves out of a long loop goes to the stack, as registers are few.
    """
    module = llvm.parse_assembly(source)
    module.verify()
    passes = llvm.create_pass_builder(target, llvm.create_pipeline_tuning_options(speed_level=0))
    passes.getModulePassManager().run(module, passes)
    return module


class Call(NamedTuple):
    """A compiled function, and types of arguments with which Python calls it."""

    module: str
    function: str
    types: tuple[Any, ...]


_calls: dict[Call, None] = {}  # so far, in order, where calls are noted


class _Interpreted:
    """Stands for a compiled function where nothing is compiled, and runs as Python."""

    def __init__(self, function: Callable[..., Any], interpreted: Callable[..., Any], options: dict[str, Any]):
        self.function, self.interpreted, self.options = function, interpreted, options

    def __call__(self, *arguments: Any) -> Any:
        return self.interpreted(*arguments)


class _Noting(_Interpreted):
    """Stands for a compiled function where calls are noted: those from plain Python alone."""

    within = threading.local()  # of another such call, in this thread

    def __call__(self, *arguments: Any) -> Any:
        outermost = not getattr(self.within, "a_call", False)
        if outermost:
            parameters = list(inspect.signature(self.function).parameters.values())
            types = [typeof(each, Purpose.argument) for each in arguments]
            types += [Omitted(each.default) for each in parameters[len(arguments) :]]
            _calls[Call(self.function.__module__, self.function.__qualname__, tuple(types))] = None
        self.within.a_call = True
        try:
            return self.function(*arguments)
        finally:
            self.within.a_call = not outermost


_stand_in: type[_Interpreted] | None = None  # what njit returns now, instead of compiled functions


@contextmanager
def noted_calls() -> Iterator[dict[Call, None]]:
    """Run the functions of modules that are first imported in the block as Python, and yield the calls of them."""
    global _stand_in
    _stand_in = _Noting
    _calls.clear()
    try:
        yield _calls
    finally:
        compile_from_here()


@contextmanager
def without_compiling() -> Iterator[None]:
    """Run the functions of modules that are first imported in the block as Python; behind it, or once
    compile_from_here() is called, they are compiled.

    Results differ from those of compiled functions by rounding. What would raise a warning is silent, as it is in
    compiled code.
    """
    global _stand_in
    _stand_in = _Interpreted
    try:
        with np.errstate(all="ignore"):
            yield
    finally:
        compile_from_here()


def interprets() -> bool:
    """Return whether functions run as Python now, without_compiling()."""
    return _stand_in is _Interpreted


def compile_from_here() -> None:
    """End without_compiling(): functions of the modules imported in it are compiled from now on."""
    global _stand_in
    if _stand_in is None:
        return
    _stand_in = None
    for module in [each for name, each in sys.modules.items() if name.startswith("cfplan.")]:
        for name, value in list(vars(module).items()):
            if isinstance(value, _Interpreted):
                made = getattr(sys.modules[value.function.__module__], value.function.__qualname__)
                if made is value:
                    made = _compiling(value.function, value.options)
                setattr(module, name, made)


def is_compiled(call: Call) -> bool:
    """Return whether a call needs no compiling."""
    return file_of(call).exists()


def compile_call(call: Call) -> bool:
    """Compile what a call needs, unless another process is compiling it: then return False."""
    name = file_of(call).name
    if not _locks.take(name, wait=False):
        return False
    try:
        getattr(sys.modules[call.module], call.function).compile(call.types)
    finally:
        _locks.give_back(name)
    return True


def file_of(call: Call) -> Path:
    """Return the file in which the machine code of a call is kept, whether it is there or not."""
    function = getattr(importlib.import_module(call.module), call.function)
    return cache_folder() / function._cache.file_name(call.types)


def claim(name: str) -> bool:
    """Return whether no other process has claimed the name; it is this one's until it ends."""
    return _locks.take(name, wait=False)


def delete_unused() -> None:
    """Delete from the cache folder what no process has read for a long time."""
    oldest = time.time() - _KEPT_DAYS * 86400
    for file in cache_folder().glob("*-*"):
        try:
            if file.stat().st_mtime < oldest:
                file.unlink()
        except OSError:
            pass
