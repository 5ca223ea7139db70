"""Compile the functions that flights need ahead of time, in other processes, and show the progress."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path

import click

from cfplan.cli.output import Steps
from cfplan.preparation.compiled_calls import Stage, find_calls

SHOWN_EVERY = 4.0  # s
LEAST_PRIORITY = 19  # see nice(2)


class Worker:
    """A process that compiles the calls of a stage one after another, from the end or from a given position.

    It continues when this process ends.
    """

    def __init__(self, stage: Stage, safety_file: Path, first: str):
        self.done = self.total = 0
        self._arguments = stage, safety_file, first
        self.process = subprocess.Popen(
            [sys.executable, "-m", "cfplan.cli.warm_up", stage.name, str(safety_file), first],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
            start_new_session=True,
        )  # fmt: skip
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.done, self.total = map(int, line.split())

    def progress(self) -> str:
        """Return the progress of compiling, in words; empty once it is done."""
        if self.process.poll() is not None:
            return ""
        return "compiling, once for this machine" + (f": {self.done} of {self.total} functions" if self.total else "")

    def stop(self) -> None:
        """End the process; the function being compiled is lost."""
        self.process.kill()
        self.process.wait()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stop, and start again after the block unless everything is compiled."""
        done = self.process.poll() == 0
        self.stop()
        yield
        if not done:
            Worker(*self._arguments)


def compile_ahead(stage: Stage, safety_file: Path, steps: Steps) -> str:
    """Compile in another process what a command will need, beginning with what it needs last; return a note about it.

    If planning is not compiled either, the command runs without_compiling(). Does nothing if everything is compiled.
    """
    from cfplan.machine_code import kept, without_compiling

    context = click.get_current_context()
    if kept() and _ready(stage):
        return ""
    if kept():
        worker = context.meta[__name__] = Worker(stage, safety_file, "last")
        steps.meanwhile = worker.progress
        if _ready(Stage.PLAN):
            return ""
    context.with_resource(without_compiling())
    return "planning without machine code" + (", which is compiled meanwhile" if kept() else "")


def compiling_paused() -> AbstractContextManager[None]:
    """Return a context manager that pauses compiling ahead, so that a flight has the processors to itself."""
    worker: Worker | None = click.get_current_context().meta.get(__name__)
    return nullcontext() if worker is None else worker.paused()


def warm_up(safety_file: Path, processes: int) -> None:
    """Compile everything that flights need, and wait for it."""
    begun = time.perf_counter()
    workers = [Worker(Stage.FLIGHT, safety_file, f"{number / processes:.3f}") for number in range(processes)]
    try:
        while not _all_ended(workers, SHOWN_EVERY):
            click.echo(max(workers, key=lambda worker: worker.done).progress() or "compiling", err=True)
    finally:
        for worker in workers:
            worker.stop()
    if any(worker.process.returncode for worker in workers):
        raise click.ClickException(
            "compiling failed: see `cfplan doctor`; flights work without it, and plan more slowly"
        )
    click.echo(f"compiled in {time.perf_counter() - begun:.0f} s by {processes} processes", err=True)


def _all_ended(workers: list[Worker], seconds: float) -> bool:
    latest = time.monotonic() + seconds
    for worker in workers:
        try:
            worker.process.wait(max(0.0, latest - time.monotonic()))
        except subprocess.TimeoutExpired:
            return False
    return True


def _ready(stage: Stage) -> bool:
    """Return whether all calls of a stage are compiled."""
    return any(_ready_file(each).exists() for each in Stage if each >= stage)


def _ready_file(stage: Stage) -> Path:
    from cfplan import machine_code

    return machine_code.cache_folder() / f"ready-{stage.name.lower()}-{machine_code.key(find_calls.__module__)[:20]}"


def work(stage: Stage, safety_file: Path, first: str) -> None:
    """Compile the calls of a stage that no other process is compiling; print the number compiled and the total.

    `first` is "last", or the fraction of the calls at which to begin, in [0, 1). Of the processes whose command has
    ended, only one at a time continues.
    """
    from cfplan.machine_code import compile_call, delete_unused, is_compiled

    parent = os.getppid()
    calls = find_calls(safety_file, stage)
    order = calls[::-1] if first == "last" else calls[int(float(first) * len(calls)) :] + calls
    while waiting := [call for call in order if not is_compiled(call)]:
        for call in waiting:
            if not _may_go_on(parent):
                return
            _print_unless_alone(sum(map(is_compiled, calls)), len(calls))
            if not is_compiled(call) and compile_call(call) and not is_compiled(call):
                return  # the cache cannot be written
        time.sleep(0.1)
    _print_unless_alone(len(calls), len(calls))
    _ready_file(stage).touch()
    delete_unused()


def _may_go_on(parent: int) -> bool:
    """Return False if the parent has ended and another such process already continues."""
    from cfplan.machine_code import claim

    return os.getppid() == parent or claim("compiling in the background")


def _step_back_once_alone() -> None:
    """Wait until the parent, which holds the input pipe, has ended; then compile at the lowest priority."""
    while os.read(0, 1):
        pass
    os.setpriority(os.PRIO_PROCESS, os.getpid(), LEAST_PRIORITY)


def _print_unless_alone(done: int, total: int) -> None:
    with suppress(BrokenPipeError):
        print(done, total, flush=True)


if __name__ == "__main__":
    threading.Thread(target=_step_back_once_alone, daemon=True).start()
    work(Stage[sys.argv[1]], Path(sys.argv[2]), sys.argv[3])
