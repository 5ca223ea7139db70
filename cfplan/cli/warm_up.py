"""Compile every function that flights need ahead of time, in several processes."""

import subprocess
import sys
from pathlib import Path

from cfplan.cli.output import Steps
from cfplan.errors import InputError


def warm_up(safety_file: Path, steps: Steps) -> None:
    """Fly each part of the small flight in its own process, and then all of it, as a step of a command.

    Does nothing if that was done, or if compiled code cannot be cached. Raises InputError if a part fails.
    """
    from cfplan.machine_code import cache_writable, code_folder, count_functions, delete_unused

    done = code_folder() / "ready"
    if not cache_writable() or done.exists():
        return
    steps.meanwhile = lambda: f"compiling, once for this machine: {count_functions()} functions so far"
    with steps.step("machine code") as results:
        _run_side_by_side(safety_file)
        results.append(f"{count_functions()} functions compiled, once for this machine")
    steps.meanwhile = str
    done.touch()
    delete_unused()


def _run_side_by_side(safety_file: Path) -> None:
    from cfplan.preparation.small_flight import PARTS

    command = sys.executable, "-m", "cfplan.preparation.small_flight", str(safety_file)
    processes = [subprocess.Popen([*command, part], stderr=subprocess.PIPE, text=True) for part in PARTS]
    try:
        for process in processes:
            _, errors = process.communicate()
            if process.returncode:
                last = (errors.strip().splitlines() or ["no message"])[-1]
                raise InputError(
                    f"compiling failed: {last}", where=str(safety_file), hint="check it by `cfplan doctor`"
                )
    finally:
        for process in processes:
            process.kill()
