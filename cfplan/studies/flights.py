"""The files of a folder flown one after the other on the virtual Crazyflie, by the command that people type."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cfplan.errors import CfplanError, InputError
from cfplan.studies.machine import Machine, this_machine

COLUMNS = (
    "path", "length", "planned", "over bound", "speed kept", "worst share", "dry run", "flown", "rms", "settled",
    "late p99", "late max",
)  # fmt: skip
_PATIENCE = 600.0  # s, of one flight


@dataclass(frozen=True, slots=True)
class Flown:
    """One flight."""

    path: str
    length: float
    # m
    planned: float
    # s
    lower_bound: float
    # s
    slowed: float
    # share of the planner's speed at which the plan was certified
    worst_share: float
    # of a limit, by the certificate
    dry_run: float
    # m, deviation at most
    deviation_max: float
    # m, flown
    deviation_rms: float
    # m
    settled_after: float | None
    # s; None where it did not settle
    lateness_p99: float
    # s, of setpoints
    lateness_max: float
    # s

    def texts(self) -> list[str]:
        """As COLUMNS has it."""
        return [
            self.path, f"{self.length:.1f} m", f"{self.planned:.2f} s",
            f"{100 * (self.planned / self.lower_bound - 1):.1f} %", f"{100 * self.slowed:.2f} %",
            f"{100 * self.worst_share:.2f} %", *(
                f"{100 * value:.1f} cm" for value in (self.dry_run, self.deviation_max, self.deviation_rms)
            ),
            "–" if self.settled_after is None else f"{self.settled_after:.2f} s",
            f"{1e3 * self.lateness_p99:.2f} ms", f"{1e3 * self.lateness_max:.2f} ms",
        ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Flights:
    """A whole run."""

    command: str
    machine: Machine
    flights: tuple[Flown, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def tables(self) -> list[tuple[str, list[str], list[list[str]]]]:
        """Title, columns and rows of the one table."""
        title = "Flights on the virtual Crazyflie: deviation from the reference in time"
        return [(title, list(COLUMNS), [flight.texts() for flight in self.flights])]


def fly_each(
    path_files: Sequence[Path],
    *,
    command: str = "",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Flights:
    """Fly them all. Raises InputError at the first that does not end landed, with what it said."""
    flown = []
    for done, file in enumerate(path_files):
        progress(done, len(path_files))
        flown.append(_fly(file))
    progress(len(path_files), len(path_files))
    return Flights(command, this_machine(), tuple(flown))


def _fly(file: Path) -> Flown:
    with tempfile.TemporaryDirectory() as records:
        ended = subprocess.run(
            [sys.executable, "-m", "cfplan.cli", "fly", str(file), "--records", records, "--json"],
            capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=_PATIENCE, check=False,
        )  # fmt: skip
    if ended.returncode != 0:
        said = ended.stderr.strip().splitlines()
        raise InputError(f"ended with exit code {ended.returncode}: {said[-1] if said else ''}", where=str(file))
    try:
        flight = json.loads(ended.stdout)
        plan, outcome = flight["plan"], flight["outcome"]
        return Flown(
            path=file.stem,
            length=plan["length"],
            planned=plan["duration"],
            lower_bound=plan["lower_bound"],
            slowed=plan["slowed"],
            worst_share=max(margin["share"] for margin in plan["certificate"]["margins"]),
            dry_run=flight["dry_run_max_deviation"],
            deviation_max=outcome["deviation_max"],
            deviation_rms=outcome["deviation_rms"],
            settled_after=outcome["settled_after"],
            lateness_p99=outcome["lateness_p99"],
            lateness_max=outcome["lateness_max"],
        )
    except (KeyError, ValueError) as error:
        raise CfplanError(f"its JSON lacks {error}", where=str(file), hint="is this cfplan's own command?") from None
