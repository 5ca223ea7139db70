"""Measure a study's cases: in several processes or on a cluster, resuming a run that was stopped.

Finished cases are kept in a file beside the result: its first line holds study, settings and digest of the sources,
each further line one case. A run of the same study resumes from it. A file of other sources or settings is stale: it is
renamed, and its cases are not used.
"""

import hashlib
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, is_dataclass
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

from cfplan.errors import InputError
from cfplan.files.atomic import write_atomically
from cfplan.learning.workers import pool
from studies.runner.provenance import provenance
from studies.runner.result import StudyResult
from studies.runner.study import Progress, Run, Study, Work

UNFINISHED, STALE = ".unfinished", ".stale-"  # suffixes to the name of the result's file
SHORT = 12  # characters of a commit, in names


@dataclass(frozen=True, slots=True)
class Effort:
    """How a study's cases are measured."""

    workers: int = 1  # processes on this machine
    scheduler: str | None = None  # address of a Dask cluster to use instead
    minutes: float = float("inf")  # after which no further case is begun
    output: Path | None = None  # file of the result; finished cases are kept beside it; None: nowhere
    say: Callable[[str], None] = lambda _: None  # called with a message about a stale file
    progress: Callable[[str], Progress] = lambda name: lambda done, total: None  # makes the callback for a name


def run_study(name: str, module: str, study: Study, settings: Any, effort: Effort | None = None) -> StudyResult:
    """Measure every case and return the result; an interrupt ends the run early with the cases measured so far.

    Raises:
        InputError: several processes for a study that measures wall-clock time, or the file beside the result cannot
            be written; also as the study.
        SchedulerError: as `pool`.
    """
    effort = effort or Effort()
    if study.one_at_a_time and (effort.workers > 1 or effort.scheduler):
        raise InputError("goes by the computer's clock", where=name, hint="leave --workers and --scheduler out")
    made = provenance(module)  # before measuring, as sources may change meanwhile
    with tempfile.TemporaryDirectory() as scratch:
        work = study.work(settings, Run(Path(scratch), effort.workers, effort.scheduler, effort.progress("preparing")))
        rows, interrupted, seconds = _measured(name, module, settings, work, effort)
    tables = tuple(study.tables(settings, rows)) if rows else ()
    return StudyResult(name, plain(asdict(settings)), tables, rows, interrupted, seconds, made)


def _measured(name: str, module: str, settings: Any, work: Work, effort: Effort) -> tuple[list[Any], bool, float]:
    """Return the rows in the order of the cases, whether cases are missing, and the processor time, s."""
    file = None if effort.output is None else unfinished_file(effort.output)
    header = {
        "study": name, "settings": plain(asdict(settings)), "files": _digests(settings),
        "identity": plain(work.identity),
        "commit": provenance(module).commit, "sources": provenance(module).sources,
    }  # fmt: skip
    kept = {} if file is None else _resume(file, header, effort.say)
    done = {case: kept[case] for case in work.cases if case in kept}
    show, until = effort.progress(name), time.monotonic() + 60.0 * effort.minutes
    show(len(done), len(work.cases))
    left = takewhile(lambda _: time.monotonic() < until, (case for case in work.cases.items() if case[0] not in done))
    with suppress(KeyboardInterrupt), pool(effort.workers, effort.scheduler) as measure:
        for each in measure(partial(_timed, work.measure), left):
            done[each.name] = each
            if file is not None:
                _append(file, each._asdict())
            show(len(done), len(work.cases))
    found = [done[case] for case in work.cases if case in done]
    rows = [work.row(**row) for each in found for row in each.rows]
    return rows, len(found) < len(work.cases), sum(each.seconds for each in found)


def _digests(settings: Any) -> dict[str, str]:
    """Return the digest of each file that the settings name."""
    values = (getattr(settings, each.name) for each in fields(settings))
    named = [path for value in values for path in (value if isinstance(value, tuple) else (value,))]
    files = (path for path in named if isinstance(path, Path) and path.is_file())
    return {str(file): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


class _Done(NamedTuple):
    name: str
    rows: list[dict[str, Any]]
    seconds: float  # s of processor time


def write_result(result: StudyResult, file: Path) -> None:
    """Write a result; keep the file of finished cases only if the run was interrupted."""
    result.write(file)
    if not result.interrupted:
        unfinished_file(file).unlink(missing_ok=True)


def unfinished_file(result: Path) -> Path:
    """Return the file of the finished cases of an incomplete result."""
    return result.with_name(result.name + UNFINISHED)


def _timed(measure: Callable[[Any], Any], case: tuple[str, Any]) -> _Done:
    name, given = case
    begun = time.process_time()
    found = measure(given)
    rows = found if isinstance(found, list) else [found]
    return _Done(name, plain(rows), time.process_time() - begun)


def plain(value: Any) -> Any:
    """Return a value as plain JSON types; unlike in results, numbers that are not finite are kept."""
    return json.loads(json.dumps(value, default=_simpler))


def _simpler(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if hasattr(value, "tolist"):  # NumPy arrays and scalars
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"no plain data: {value!r}")


def _resume(file: Path, header: Mapping[str, Any], say: Callable[[str], None]) -> dict[str, _Done]:
    """Return the kept cases of the same study, settings and sources; set anything else aside and begin a new file."""
    try:
        lines = _lines(file) if file.is_file() else []
        if lines and {**lines[0], "commit": ""} == {**header, "commit": ""}:
            write_atomically(file, _text(lines))  # drops a last line that a kill has cut off
            return {line["name"]: _Done(**line) for line in lines[1:]}
        if lines:
            aside = file.with_name(file.name.removesuffix(UNFINISHED) + STALE + str(lines[0].get("commit"))[:SHORT])
            file.replace(aside)
            say(f"{aside}: {len(lines) - 1} cases of other sources or settings, stale: all are measured anew")
        write_atomically(file, _text([header]))
    except OSError as error:
        raise _unwritable(file, error) from None
    return {}


def _text(lines: Sequence[Mapping[str, Any]]) -> bytes:
    return "".join(json.dumps(line) + "\n" for line in lines).encode()


def _lines(file: Path) -> list[dict[str, Any]]:
    """Return the lines that are complete, up to the first that is not."""
    return list(_complete(file.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True)))


def _complete(lines: list[str]) -> Iterator[dict[str, Any]]:
    for number, line in enumerate(lines):
        try:
            value = json.loads(line)
        except ValueError:
            return
        if not line.endswith("\n") or not isinstance(value, dict) or (number and set(value) != set(_Done._fields)):
            return
        yield value


def _append(file: Path, line: Mapping[str, Any]) -> None:
    try:
        with file.open("a", encoding="utf-8") as kept:
            kept.write(_text([line]).decode())
    except OSError as error:
        raise _unwritable(file, error) from None


def _unwritable(file: Path, error: OSError) -> InputError:
    return InputError(
        f"cannot be written ({error.strerror or error})", where=str(file),
        hint="make room, or name another file by -o; finished cases are kept",
    )  # fmt: skip
