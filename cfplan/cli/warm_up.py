"""Compiles what flights need ahead of time, in other processes, and shows how far that is."""

import subprocess
import sys
import threading
import time
from pathlib import Path

import click

from cfplan.cli.output import Steps
from cfplan.preparation.compiled_calls import Stage, find_calls

SHOWN_EVERY = 4.0  # s


class Worker:
    """A process that compiles the calls of a stage, one after the other, from the end or from a place of its own."""

    def __init__(self, stage: Stage, safety_file: Path, first: str):
        self.done = self.total = 0
        self.process = subprocess.Popen(
            [sys.executable, "-m", "cfplan.cli.warm_up", stage.name, str(safety_file), first],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.done, self.total = map(int, line.split())

    def progress(self) -> str:
        """Return how far compiling is, in words; nothing once it is done."""
        if self.process.poll() is not None:
            return ""
        return "compiling, once for this machine" + (f": {self.done} of {self.total} functions" if self.total else "")

    def stop(self) -> None:
        """End the process; what it was compiling is lost."""
        self.process.kill()
        self.process.wait()


def compile_ahead(stage: Stage, safety_file: Path, steps: Steps) -> None:
    """Compile what a command is going to need, from the end of its way, while it starts from the beginning.

    Does nothing where all is compiled. Stops as the command ends.
    """
    from cfplan.machine_code import kept

    if not kept() or _ready_file(stage).exists():
        return
    worker = Worker(stage, safety_file, "last")
    click.get_current_context().call_on_close(worker.stop)
    steps.meanwhile = worker.progress


def warm_up(safety_file: Path, processes: int) -> None:
    """Compile everything that flights need, and return when that is done."""
    begun = time.perf_counter()
    workers = [Worker(Stage.FLIGHT, safety_file, f"{number / processes:.3f}") for number in range(processes)]
    try:
        while not _all_ended(workers, SHOWN_EVERY):
            click.echo(max(workers, key=lambda worker: worker.done).progress() or "compiling", err=True)
    finally:
        for worker in workers:
            worker.stop()
    if any(worker.process.returncode for worker in workers):
        raise click.ClickException("compiling failed")
    click.echo(f"compiled in {time.perf_counter() - begun:.0f} s by {processes} processes", err=True)


def _all_ended(workers: list[Worker], seconds: float) -> bool:
    latest = time.monotonic() + seconds
    for worker in workers:
        try:
            worker.process.wait(max(0.0, latest - time.monotonic()))
        except subprocess.TimeoutExpired:
            return False
    return True


def _ready_file(stage: Stage) -> Path:
    from cfplan import machine_code

    return machine_code.cache_folder() / f"ready-{stage.name.lower()}-{machine_code.key(find_calls.__module__)[:20]}"


def work(stage: Stage, safety_file: Path, first: str) -> None:
    """Compile the calls of a stage, leaving out what other processes are at; print how many are compiled of how many.

    `first` is "last", or how far along the calls to begin, in [0, 1).
    """
    import os

    from cfplan.machine_code import compile_call, delete_unused, is_compiled

    parent = os.getppid()
    calls = find_calls(safety_file, stage)
    order = calls[::-1] if first == "last" else calls[int(float(first) * len(calls)) :] + calls
    while waiting := [call for call in order if not is_compiled(call)]:
        for call in waiting:
            print(sum(map(is_compiled, calls)), len(calls), flush=True)
            if os.getppid() != parent:
                return
            if not is_compiled(call):
                compile_call(call)
        time.sleep(0.1)
    print(len(calls), len(calls), flush=True)
    _ready_file(stage).touch()
    delete_unused()


if __name__ == "__main__":
    work(Stage[sys.argv[1]], Path(sys.argv[2]), sys.argv[3])
