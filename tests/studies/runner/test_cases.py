"""A study's cases: measured by processes or a cluster, resumed after a kill, not mixed with those of other sources."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from waiting import until

from cfplan.errors import InputError
from cfplan.learning.workers import SchedulerError
from studies.runner.cases import UNFINISHED, Effort, run_study
from studies.runner.options import option
from studies.runner.reductions import largest
from studies.runner.result import Column, read_result, table
from studies.runner.study import Study, Work

REPOSITORY = Path(__file__).parents[3]
MODULE = "studies.runner.study"  # any module with sources can stand in for a study's


@dataclass(frozen=True)
class Settings:
    count: int = option(4, "Numbers.")
    log: str = option("", "File for a line per squared number.")
    stop_at: int = option(-1, "Number at which the user interrupts.")


@dataclass(frozen=True)
class Square:
    number: int
    value: float
    pair: tuple[float, float] = (float("nan"), float("inf"))


def squared(settings, number):
    if number == settings.stop_at:
        raise KeyboardInterrupt
    if settings.log:
        with open(settings.log, "a") as file:
            file.write(f"{number}\n")
    return Square(number, float(number**2))


def work(settings, run):
    return Work({f"n{k}": k for k in range(settings.count)}, partial(squared, settings), Square)


def tables(settings, rows):
    yield table("squares", "Squares", (Column("largest", "largest", value=largest("value")),), rows, by=())


STUDY = Study(Settings, work, tables, "")


@pytest.fixture
def log(tmp_path):
    file = tmp_path / "log"
    file.touch()
    return file


def made(log):
    return sorted(int(line) for line in log.read_text().split())


def unfinished(file):
    return file.with_name(file.name + UNFINISHED)


@pytest.mark.parametrize("workers", [1, 2])
def test_rows_come_in_the_order_of_the_cases_and_are_as_they_were(workers):
    calls = []
    effort = Effort(workers, progress=lambda name: lambda done, total: calls.append((name, done, total)))
    result = run_study("squares", MODULE, STUDY, Settings(), effort)
    assert [row.value for row in result.rows] == [0.0, 1.0, 4.0, 9.0]
    assert np.isnan(result.rows[1].pair[0])
    assert result.rows[1].pair[1] == np.inf
    assert [each for each in calls if each[0] == "squares"] == [("squares", done, 4) for done in range(5)]
    assert result.table("squares").rows == ({"largest": 9.0},)
    assert not result.interrupted
    assert result.seconds > 0.0


def test_after_an_interrupt_only_what_was_not_done_is_measured(log, tmp_path):
    out = tmp_path / "r.json"
    first = run_study("squares", MODULE, STUDY, Settings(log=str(log)), Effort(minutes=0.0, output=out))
    assert (first.rows, first.interrupted) == ([], True)
    stopping = Study(Settings, lambda s, run: Work(work(s, run).cases, partial(squared, Settings(log=s.log, stop_at=2)),
                                                   Square), tables, "")  # fmt: skip
    stopped = run_study("squares", MODULE, stopping, Settings(log=str(log)), Effort(output=out))
    assert stopped.interrupted
    assert [row.number for row in stopped.rows] == [0, 1]
    result = run_study("squares", MODULE, STUDY, Settings(log=str(log)), Effort(output=out))
    assert not result.interrupted
    assert made(log) == [0, 1, 2, 3]  # each only once
    assert [row.value for row in result.rows] == [0.0, 1.0, 4.0, 9.0]


def test_a_case_that_a_kill_cut_off_as_it_was_written_is_measured_again(log, tmp_path):
    effort = Effort(output=tmp_path / "r.json")
    run_study("squares", MODULE, STUDY, Settings(log=str(log)), effort)
    file = unfinished(effort.output)
    file.write_text(file.read_text()[:-7])
    run_study("squares", MODULE, STUDY, Settings(log=str(log)), effort)
    assert made(log) == [0, 1, 2, 3, 3]


@pytest.mark.parametrize("key", ["sources", "settings", "study", "identity", "files", None])
def test_what_other_sources_or_settings_made_is_set_aside_and_never_mixed_in(log, tmp_path, key):
    messages = []
    effort = Effort(output=tmp_path / "r.json", say=messages.append)
    run_study("squares", MODULE, STUDY, Settings(log=str(log)), effort)
    file = unfinished(effort.output)
    header, *rest = file.read_text().splitlines()
    changed = {} if key is None else json.loads(header) | {key: "other"}
    file.write_text("\n".join([json.dumps(changed), *rest]) + "\n")
    run_study("squares", MODULE, STUDY, Settings(log=str(log)), effort)
    assert made(log) == [0, 0, 1, 1, 2, 2, 3, 3]
    (aside,) = tmp_path.glob("r.json.stale-*")
    assert len(aside.read_text().splitlines()) == 5  # nothing of it is lost
    assert messages[0].startswith(f"{aside}: 4 cases")


def test_without_an_output_nothing_is_kept_and_where_nothing_can_be_kept_nothing_is_measured(log, tmp_path):
    run_study("squares", MODULE, STUDY, Settings())
    assert list(tmp_path.iterdir()) == [log]
    with pytest.raises(InputError, match="cannot be written"):
        run_study("squares", MODULE, STUDY, Settings(log=str(log)), Effort(output=tmp_path / "none" / "r.json"))
    assert made(log) == []


def test_a_study_that_goes_by_the_clock_takes_no_second_process():
    with pytest.raises(InputError, match="clock"):
        run_study("squares", MODULE, Study(Settings, work, tables, "", one_at_a_time=True), Settings(), Effort(2))


def test_a_result_survives_its_file_and_its_rows_lie_beside_it(tmp_path):
    result = run_study("squares", MODULE, STUDY, Settings())
    result.write(tmp_path / "squares.json")
    read = read_result(tmp_path / "squares.json")
    assert (read.study, read.settings, read.seconds) == ("squares", asdict(Settings()), result.seconds)
    assert read.provenance == result.provenance
    assert read.to_json() == result.to_json()
    rows = pq.read_table(tmp_path / "items" / "squares.parquet").to_pylist()
    assert [row["value"] for row in rows] == [0.0, 1.0, 4.0, 9.0]


@pytest.mark.slow
def test_a_killed_study_goes_on_from_where_it_was(tmp_path):
    out = tmp_path / "runs.json"
    command = [sys.executable, "-m", "studies", "dry-runs", "-o", str(out), *(f"flights/{name}.yaml" for name in
               ("circle", "line", "slalom", "figure8"))]  # fmt: skip

    def begin():
        return subprocess.Popen(command, cwd=REPOSITORY, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)

    def lines():
        return unfinished(out).read_text().splitlines() if unfinished(out).exists() else []

    process = begin()
    try:
        assert until(lambda: len(lines()) >= 2)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    first = json.loads(lines()[1])
    assert not out.exists()
    assert begin().wait() == 0
    result = read_result(out)
    assert not unfinished(out).exists()
    assert [row["path"] for row in result.table("dry-runs").rows] == ["circle", "line", "slalom", "figure8"]
    assert result.table("dry-runs").rows[0]["time_lost"] == first["rows"][0]["time_lost"]
    assert result.seconds > first["seconds"]


def where(number):
    return Square(number, float(os.getpid()))


@pytest.mark.integration
def test_a_cluster_works_for_a_study():
    distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    study = Study(Settings, lambda settings, run: Work({str(k): k for k in range(8)}, where, Square), tables, "")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        result = run_study("where", MODULE, study, Settings(), Effort(scheduler=cluster.scheduler_address))
        assert {int(row.value) for row in result.rows} <= {worker.pid for worker in cluster.workers.values()}


def test_a_scheduler_that_does_not_answer_is_an_error():
    with pytest.raises(SchedulerError) as caught:
        run_study("squares", MODULE, STUDY, Settings(), Effort(scheduler="tcp://127.0.0.1:9"))
    assert "dask scheduler" in caught.value.hint
