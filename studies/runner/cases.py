"""Measure a study's cases: by several processes, on a cluster, and onwards from where a run was stopped.

What is measured is kept case by case in a file beside the result: its first line says of which study, settings and
sources it is, each further line holds one case. A run of the same study goes on from it. A file of other sources or
settings is stale: it is set aside under a name that says so, and nothing of it is used.
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
from cfplan.files.whole import write_whole
from cfplan.learning.workers import pool
from studies.runner.provenance import provenance
from studies.runner.result import StudyResult
from studies.runner.study import Progress, Run, Study, Work

UNFINISHED, STALE = ".unfinished", ".stale-"  # behind the name of the result's file
SHORT = 12  # characters of a commit, in names


@dataclass(frozen=True, slots=True)
class Effort:
    """How a study's cases are measured."""

    workers: int = 1  # processes on this machine
    scheduler: str | None = None  # address of a Dask cluster that works instead
    minutes: float = float("inf")  # after which no case is begun
    output: Path | None = None  # file of the result, beside which finished cases are kept; None: nowhere
    say: Callable[[str], None] = lambda _: None  # is told which file was set aside
    progress: Callable[[str], Progress] = lambda name: lambda done, total: None  # of what is named


def run_study(name: str, module: str, study: Study, settings: Any, effort: Effort | None = None) -> StudyResult:
    """Measure every case and return the result; an interrupt ends it early with what is measured by then.

    Raises:
        InputError: several processes for a study that goes by the clock, or a file beside the result that cannot be
            written; what the study raises.
        SchedulerError: as `pool`.
    """
    effort = effort or Effort()
    if study.one_at_a_time and (effort.workers > 1 or effort.scheduler):
        raise InputError("goes by the computer's clock", where=name, hint="leave --workers and --scheduler out")
    made = provenance(module)  # of the beginning
    with tempfile.TemporaryDirectory() as scratch:
        work = study.work(settings, Run(Path(scratch), effort.workers, effort.scheduler, effort.progress("preparing")))
        rows, interrupted, seconds = _measured(name, module, settings, work, effort)
    tables = tuple(study.tables(settings, rows)) if rows else ()
    return StudyResult(name, plain(asdict(settings)), tables, rows, interrupted, seconds, made)


def _measured(name: str, module: str, settings: Any, work: Work, effort: Effort) -> tuple[list[Any], bool, float]:
    """Return the rows in the order of the cases, whether some were not measured, and the processor's seconds."""
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
    """Return the digests of the files that settings name."""
    values = (getattr(settings, each.name) for each in fields(settings))
    named = [path for value in values for path in (value if isinstance(value, tuple) else (value,))]
    files = (path for path in named if isinstance(path, Path) and path.is_file())
    return {str(file): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


class _Done(NamedTuple):
    name: str
    rows: list[dict[str, Any]]
    seconds: float  # of the processor


def write_result(result: StudyResult, file: Path) -> None:
    """Write a result; its finished cases are kept only where it was interrupted."""
    result.write(file)
    if not result.interrupted:
        unfinished_file(file).unlink(missing_ok=True)


def unfinished_file(result: Path) -> Path:
    """Return the file of the finished cases of a result that is not complete yet."""
    return result.with_name(result.name + UNFINISHED)


def _timed(measure: Callable[[Any], Any], case: tuple[str, Any]) -> _Done:
    name, given = case
    begun = time.process_time()
    found = measure(given)
    rows = found if isinstance(found, list) else [found]
    return _Done(name, plain(rows), time.process_time() - begun)


def plain(value: Any) -> Any:
    """Return a value as JSON has it; unlike in results, what is not finite stays what it is."""
    return json.loads(json.dumps(value, default=_simpler))


def _simpler(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if hasattr(value, "tolist"):  # of NumPy
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"no plain data: {value!r}")


def _resume(file: Path, header: Mapping[str, Any], say: Callable[[str], None]) -> dict[str, _Done]:
    """Return the kept cases of the same study, settings and sources; set anything else aside and begin a new file."""
    try:
        lines = _lines(file) if file.is_file() else []
        if lines and {**lines[0], "commit": ""} == {**header, "commit": ""}:
            write_whole(file, _text(lines))  # without the last, where a kill has cut it off
            return {line["name"]: _Done(**line) for line in lines[1:]}
        if lines:
            aside = file.with_name(file.name.removesuffix(UNFINISHED) + STALE + str(lines[0].get("commit"))[:SHORT])
            file.replace(aside)
            say(f"{aside}: {len(lines) - 1} cases of other sources or settings, stale: all are measured anew")
        write_whole(file, _text([header]))
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
