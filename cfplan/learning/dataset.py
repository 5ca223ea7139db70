"""Datasets on disk: made shard by shard by any number of workers, resumed where they stopped, read and summarised.

A folder holds dataset.json, shards/NNNNN.parquet (the rows), and timing/NNNNN.parquet (solve times, which differ from
run to run and are therefore kept apart from the rows, which every run reproduces byte for byte).
"""

import io
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cfplan.errors import InputError
from cfplan.files.atomic import atomic_write
from cfplan.learning.dataset_spec import SPEC_FILE, DatasetSpec, load_spec, require_same
from cfplan.learning.labels import SCHEMA, TIMING_SCHEMA, ChoosePath, make_rows
from cfplan.learning.workers import pool
from cfplan.planners.solution import Status

SHARDS, TIMING = "shards", "timing"
PERCENTILES = (0, 10, 50, 90, 99, 100)
DISTRIBUTIONS = {
    "length": "m",
    "travel_time": "s",
    "peak_speed": "m/s",
    "mean_speed": "m/s",
    "iterations": "",
    "solve_seconds": "s",
}


def make_dataset(
    folder: Path,
    spec: DatasetSpec,
    *,
    choose: ChoosePath | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    on_rows: Callable[[int], None] = lambda _: None,
) -> DatasetSpec:
    """Make the missing shards of a dataset. `on_rows` is called with the number of rows that were added on disk.

    `choose` chooses paths through waypoints, for a spec that asks for chosen ones.
    If it is stopped, only unfinished shards are lost; the next call makes them.
    Raises InputError where the folder holds another dataset or cannot be written, SchedulerError where the scheduler
    does not answer within ten seconds.
    """
    _prepare(folder, spec)
    missing = [number for number in range(spec.shards) if not _shard(folder, SHARDS, number).exists()]
    on_rows(spec.rows - sum(len(spec.shard(number)) for number in missing))
    with pool(workers, scheduler) as work:
        for number, rows, timing in work(partial(label_shard, spec, choose=choose), missing):
            try:
                for part, content in ((TIMING, timing), (SHARDS, rows)):
                    with atomic_write(_shard(folder, part, number)) as unfinished:
                        unfinished.write_bytes(content)
            except OSError as error:
                raise InputError(
                    f"cannot write: {error.strerror}",
                    where=str(folder),
                    hint="make room and give the same command again: finished shards are kept",
                ) from None
            on_rows(len(spec.shard(number)))
    return spec


def read_dataset(folder: Path) -> tuple[DatasetSpec, pa.Table]:
    """Read all rows that exist, in order. Raises InputError where the folder is no dataset or a shard is damaged."""
    spec = load_spec(folder)
    return spec, _read(folder, SHARDS, SCHEMA)


def read_timing(folder: Path) -> pa.Table:
    """Read the solve time of each existing row."""
    load_spec(folder)
    return _read(folder, TIMING, TIMING_SCHEMA)


def describe(folder: Path) -> dict[str, Any]:
    """Return counts, failures and distributions as plain data. Raises InputError where the folder is no dataset."""
    spec, rows = read_dataset(folder)
    timing = read_timing(folder)
    solved = rows.filter(pa.compute.equal(rows["status"], Status.SOLVED.name))
    factor = _numbers(solved, "certified_share")
    values = {name: _numbers(solved, name) for name in ("length", "travel_time", "peak_speed", "iterations")}
    with np.errstate(all="ignore"):  # damaged rows
        values["mean_speed"] = values["length"] / values["travel_time"]
    values["solve_seconds"] = _numbers(timing, "solve_seconds")
    active = Counter(str(name) for names in solved["active_limits"].to_pylist() for name in names or ())
    return {
        "folder": str(folder),
        "spec": asdict(spec),
        "rows": rows.num_rows,
        "rows_wanted": spec.rows,
        "solved": solved.num_rows,
        "failed": dict(Counter(status for status in rows["status"].to_pylist() if status != Status.SOLVED.name)),
        "certified_as_they_are": int(np.sum(factor >= 1.0)),
        "certified_when_slowed": int(np.sum((factor > 0.0) & (factor < 1.0))),
        "never_certified": int(np.sum(factor <= 0.0)),
        "percentiles": {name: _percentiles(values[name]) for name in DISTRIBUTIONS},
        "active_limits": {name: count / max(1, solved.num_rows) for name, count in active.most_common()},
    }


def label_shard(spec: DatasetSpec, number: int, choose: ChoosePath | None = None) -> tuple[int, bytes, bytes]:
    """Label a shard, as a worker does: return its number and the bytes of its two files."""
    rows, timing = make_rows(spec, spec.shard(number), choose)
    return number, _parquet(rows), _parquet(timing)


def _prepare(folder: Path, spec: DatasetSpec) -> None:
    try:
        for part in (SHARDS, TIMING):
            (folder / part).mkdir(parents=True, exist_ok=True)
        if (folder / SPEC_FILE).exists():
            require_same(load_spec(folder), spec, folder)
        elif any((folder / SHARDS).iterdir()):
            raise InputError(f"has shards but no {SPEC_FILE}", where=str(folder), hint="give another folder")
        else:
            spec.save(folder)
    except OSError as error:
        raise InputError(
            f"cannot be used for a dataset: {error.strerror}", where=str(folder), hint="give another folder"
        ) from None


def _shard(folder: Path, part: str, number: int) -> Path:
    return folder / part / f"{number:05d}.parquet"


def _parquet(table: pa.Table) -> bytes:
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


def _read(folder: Path, part: str, schema: pa.Schema) -> pa.Table:
    files = sorted(file for file in (folder / part).glob("*.parquet") if file.is_file())
    if not files:
        raise InputError("no rows yet", where=str(folder), hint="give `cfplan dataset make` again to go on")
    tables = []
    for file in files:
        try:
            table = pq.read_table(file)
        except (OSError, pa.ArrowException) as error:
            raise _damaged(" ".join(str(error).split())[:160], file) from None
        if not table.schema.equals(schema):
            raise _damaged("its columns are not those of a dataset", file)
        tables.append(table.replace_schema_metadata(None))
    return pa.concat_tables(tables)


def _damaged(why: str, file: Path) -> InputError:
    return InputError(f"damaged ({why})", where=str(file), hint="delete it and give `cfplan dataset make` again")


def _numbers(table: pa.Table, name: str) -> np.ndarray:
    return table[name].to_numpy().astype(float)


def _percentiles(values: np.ndarray) -> dict[str, float | None]:
    known = values[np.isfinite(values)]
    if not len(known):
        return {str(percentile): None for percentile in PERCENTILES}
    found = np.percentile(known, PERCENTILES)
    return {str(percentile): float(value) for percentile, value in zip(PERCENTILES, found, strict=True)}
