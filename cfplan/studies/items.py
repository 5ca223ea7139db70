"""Work through a study's items one by one: by several processes, on a cluster, and onwards from where it was stopped.

What is done is kept item by item in a file beside the result: its first line says of which study, settings and code it
is, each further line holds one item. A run of the same study goes on from it. A file of other code or settings is
stale: it is set aside under a name that says so, and nothing of it is used.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass, replace
from functools import partial
from glob import escape
from pathlib import Path
from typing import Any, NamedTuple

from cfplan.errors import InputError
from cfplan.files.whole import write_whole
from cfplan.learning.workers import pool
from cfplan.studies.provenance import provenance, sources_digest
from cfplan.studies.result import Column, Table

Progress = Callable[[int, int], None]
UNFINISHED, STALE = ".unfinished", ".stale-"  # behind the name of the result's file
SHORT = 12  # characters of a commit, in names


@dataclass(frozen=True, slots=True)
class Running:
    """How a study's items are worked through."""

    workers: int = 1  # processes of this machine
    scheduler: str | None = None  # of a Dask cluster, which works instead: tcp://host:port
    result: Path | None = None  # file of the result, beside which finished items are kept; None: nowhere
    tell: Callable[[str], None] = lambda _: None  # is told what was set aside

    def beside(self, part: str) -> "Running":
        """Return the same for a part of the study, whose items are kept in a file of their own."""
        result = self.result and self.result.with_name(f"{self.result.name}.{part}")
        return replace(self, result=result)


HERE = Running()  # in this process; nothing is kept


class WorkedThrough(NamedTuple):
    """What became of the items."""

    values: list[Any]  # what the function returned, as JSON has it, in the order of the items; without those not done
    interrupted: bool
    seconds: float  # of the processor, for all of them, in this run and those before


class _Done(NamedTuple):
    name: str
    value: Any
    seconds: float


def work_through(
    study: str,
    settings: Mapping[str, Any],
    function: Callable[[Any], Any],
    items: Mapping[str, Any],
    running: Running,
    progress: Progress,
) -> WorkedThrough:
    """Call the function on each item whose name is not kept; `progress` is told how many of all are done.

    Function and items must be picklable; what it returns of them plain data or dataclasses, which JSON can hold. An
    interrupt ends it, and keeps what was done.

    Raises:
        InputError: the file beside the result cannot be written.
        SchedulerError: as `pool`.
    """
    file = None if running.result is None else unfinished_file(running.result)
    kept = {} if file is None else _resume(file, _header(study, settings), running.tell)
    done = {name: kept[name] for name in items if name in kept}
    progress(len(done), len(items))
    interrupted = False
    try:
        with pool(running.workers, running.scheduler) as work:
            for each in work(partial(_timed, function), [item for item in items.items() if item[0] not in done]):
                done[each.name] = each
                if file is not None:
                    _append(file, each._asdict())
                progress(len(done), len(items))
    except KeyboardInterrupt:
        interrupted = True
    found = [done[name] for name in items if name in done]
    return WorkedThrough([each.value for each in found], interrupted, sum(each.seconds for each in found))


def unfinished_file(result: Path) -> Path:
    """Return where the finished items of a result are kept that is not whole yet."""
    return result.with_name(result.name + UNFINISHED)


def forget_unfinished(result: Path) -> None:
    """Delete what is kept beside a result that is whole and written."""
    for file in result.parent.glob(f"{escape(result.name)}*{UNFINISHED}"):
        file.unlink(missing_ok=True)


def count_unfinished(result: Path) -> int:
    """Return how many items this code has done of a result that is not whole yet."""
    file = unfinished_file(result)
    lines = _lines(file) if file.is_file() else []
    return max(len(lines) - 1, 0) if lines and _of_this_code(lines[0]) else 0


def work_table(steps: Mapping[str, tuple[int, float]]) -> Table:
    """Return a detail of a result: how long each kind of step took the processor, from which estimates are made."""
    columns = (Column("step"), Column("count"), Column("seconds"))
    rows = [{"step": step, "count": count, "seconds": seconds} for step, (count, seconds) in steps.items()]
    return Table("work", "", columns, tuple(rows))


def _timed(function: Callable[[Any], Any], item: tuple[str, Any]) -> _Done:
    name, given = item
    begun = time.process_time()
    value = json.loads(json.dumps(function(given), default=_plain))
    return _Done(name, value, time.process_time() - begun)


def _plain(value: Any) -> Any:
    """Return what JSON can hold of a value; unlike in results, what is not finite stays what it is."""
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if hasattr(value, "tolist"):  # of NumPy
        return value.tolist()
    raise TypeError(f"no plain data: {value!r}")


def _header(study: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    plain = json.loads(json.dumps(settings, default=_plain))
    return {"study": study, "settings": plain, "commit": provenance().commit, "sources": sources_digest()}


def _of_this_code(header: Mapping[str, Any]) -> bool:
    return (header.get("commit"), header.get("sources")) == (provenance().commit, sources_digest())


def _resume(file: Path, header: Mapping[str, Any], tell: Callable[[str], None]) -> dict[str, _Done]:
    """Return what is kept of the same study, settings and code; anything else is set aside, and a new file begun."""
    try:
        lines = _lines(file) if file.is_file() else []
        if lines and lines[0] == header:
            write_whole(file, _text(lines))  # without the last, where a kill has cut it off
            return {line["name"]: _Done(**line) for line in lines[1:]}
        if lines:
            aside = file.with_name(file.name.removesuffix(UNFINISHED) + STALE + str(lines[0].get("commit"))[:SHORT])
            file.replace(aside)
            tell(
                f"{aside}: {len(lines) - 1} finished items of another commit or of other settings, stale: not used; "
                "all are measured anew"
            )
        write_whole(file, _text([header]))
    except OSError as error:
        raise _unwritable(file, error) from None
    return {}


def _text(lines: Sequence[Mapping[str, Any]]) -> bytes:
    return "".join(json.dumps(line) + "\n" for line in lines).encode()


def _lines(file: Path) -> list[dict[str, Any]]:
    """Return the lines that are whole, up to the first that is not."""
    found: list[dict[str, Any]] = []
    for line in file.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True):
        try:
            value = json.loads(line)
        except ValueError:
            break
        if not line.endswith("\n") or not isinstance(value, dict) or (found and set(value) != set(_Done._fields)):
            break
        found.append(value)
    return found


def _append(file: Path, line: Mapping[str, Any]) -> None:
    try:
        with file.open("a", encoding="utf-8") as kept:
            kept.write(_text([line]).decode())
    except OSError as error:
        raise _unwritable(file, error) from None


def _unwritable(file: Path, error: OSError) -> InputError:
    return InputError(
        f"cannot be written ({error.strerror or error})", where=str(file),
        hint="make room, or name another file by -o; items that are finished are kept",
    )  # fmt: skip
