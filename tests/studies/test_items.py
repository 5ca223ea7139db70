"""A study's items: worked through by processes or a cluster, onwards from a kill, never with those of other code."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from waiting import until

from cfplan.cli import cfplan
from cfplan.errors import InputError
from cfplan.learning.workers import SchedulerError
from studies import items as module
from studies import machine
from studies.runner.items import (
    HERE,
    Running,
    count_unfinished,
    forget_unfinished,
    unfinished_file,
    work_through,
)
from studies.paper.robustness import robustness
from studies.paper.yaw_consistency import yaw_consistency
from studies.runner.provenance import provenance
from studies.runner.result import read_result

REPOSITORY = Path(__file__).parents[2]
ITEMS = {name: k for k, name in enumerate("abcd")}


@dataclass(frozen=True)
class Square:
    value: float
    pair: tuple[float, float]


def squared(log, number):
    """A trial of the item, and a line in a file that says that it was made."""
    with log.open("a") as file:
        file.write(f"{number}\n")
    return Square(float(number**2), (float("nan"), float("inf"))) if number else None


@pytest.fixture
def log(tmp_path):
    file = tmp_path / "log"
    file.touch()
    return file


def made(log):
    return sorted(int(line) for line in log.read_text().split())


def run(log, running=HERE, *, items=ITEMS, settings=None, told=None):
    told = [] if told is None else told
    return work_through("squares", settings or {"size": 1}, partial(squared, log), items, running,
                        lambda done, total: told.append((done, total)))  # fmt: skip


def trials(result, name):
    """What was measured one by one, without how long it took, as text: NaN is no NaN's equal."""
    rows = result.to_json()
    (table,) = (each for each in rows["details"] if each["name"] == name)
    keys = [column["key"] for column in table["columns"]]
    return [
        [value for key, value in zip(keys, row, strict=True) if "seconds" not in key] for row in table["rows"]
    ]  # fmt: skip


def stop_after_two(log):
    """An interrupt as the third item begins."""

    def function(number):
        if number == 2:
            raise KeyboardInterrupt
        return squared(log, number)

    return function


@pytest.mark.parametrize("workers", [1, 2])
def test_values_come_in_the_order_of_the_items_and_are_as_they_were(log, workers):
    told = []
    work = run(log, Running(workers), told=told)
    assert work.values[0] is None
    assert [value["value"] for value in work.values[1:]] == [1.0, 4.0, 9.0]
    assert np.isnan(work.values[1]["pair"][0])
    assert work.values[1]["pair"][1] == np.inf
    assert told == [(done, 4) for done in range(5)]
    assert not work.interrupted
    assert work.seconds > 0.0


def test_after_an_interrupt_only_what_was_not_done_is_worked_on(log, tmp_path):
    running = Running(result=tmp_path / "r.json")
    first = work_through("squares", {"size": 1}, stop_after_two(log), ITEMS, running, lambda done, total: None)
    assert first.interrupted
    assert len(first.values) == count_unfinished(running.result) == 2
    told = []
    second = run(log, running, told=told)
    assert made(log) == [0, 1, 2, 3]  # each once
    assert told[0] == (2, 4)
    assert not second.interrupted
    assert json.dumps(second.values) == json.dumps(run(log).values)
    forget_unfinished(running.result)
    assert not list(tmp_path.glob("r.json*"))


def test_an_item_that_a_kill_cut_off_as_it_was_written_is_worked_on_again(log, tmp_path):
    running = Running(result=tmp_path / "r.json")
    run(log, running)
    file = unfinished_file(running.result)
    whole = file.read_text()
    file.write_text(whole[:-7])
    assert count_unfinished(running.result) == 3
    run(log, running)
    assert made(log) == [0, 1, 2, 3, 3]
    kept, before = ([json.loads(line) for line in text.splitlines()] for text in (file.read_text(), whole))
    assert kept[:-1] == before[:-1]  # also how long those took that were kept
    assert kept[-1]["value"] == before[-1]["value"]


@pytest.mark.parametrize("other", ["commit", "sources", "settings", "study", "damaged"])
def test_what_other_code_or_settings_made_is_stale_and_never_mixed_with_new(log, tmp_path, monkeypatch, other):
    told = []
    running = Running(result=tmp_path / "r.json", tell=told.append)
    with monkeypatch.context() as then:
        if other == "commit":
            then.setattr(module, "provenance", lambda: replace(provenance(), commit="b" * 40))
        if other == "sources":
            then.setattr(module, "sources_digest", lambda: "0")
        study = "cubes" if other == "study" else "squares"
        settings = {"size": 2 if other == "settings" else 1}
        work_through(study, settings, lambda number: Square(-1.0, (0.0, 0.0)), ITEMS, running, lambda done, total: None)
    if other == "damaged":
        file = unfinished_file(running.result)
        file.write_text("{}\n" + file.read_text().split("\n", 1)[1])
    assert count_unfinished(running.result) == (4 if other in ("settings", "study") else 0)
    work = run(log, running)
    assert made(log) == [0, 1, 2, 3]  # all anew
    assert all(value is None or value["value"] >= 0.0 for value in work.values)
    (aside,) = tmp_path.glob("r.json.stale-*")
    assert len(aside.read_text().splitlines()) == 5  # nothing of it is lost
    assert told == [f"{aside}: {told[0].split(': ', 1)[1]}"]
    assert "stale: not used" in told[0]


def test_without_a_place_for_them_nothing_is_kept(log, tmp_path):
    run(log)
    assert list(tmp_path.iterdir()) == [log]
    with pytest.raises(InputError, match="cannot be written"):
        run(log, Running(result=tmp_path / "none" / "r.json"))


def test_a_killed_study_goes_on_from_where_it_was(tmp_path, monkeypatch):
    out = tmp_path / "yaw.json"
    command = [sys.executable, "-m", "cfplan", "study", "yaw-consistency", "--pairs", "2", "-o", str(out)]
    process = subprocess.Popen(
        command, env=os.environ | {"PYTHONPATH": str(REPOSITORY)}, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
    )
    try:
        assert until(lambda: count_unfinished(out) >= 1)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert not out.exists()
    before = unfinished_file(out).read_text().splitlines()[1 : 1 + count_unfinished(out)]
    monkeypatch.setattr(machine, "one_thread", lambda: None)  # too late in a process of tests
    done = CliRunner().invoke(cfplan, command[3:])
    assert done.exit_code == 0, done.output
    found, whole = read_result(out), yaw_consistency(pairs=2)
    assert not unfinished_file(out).exists()
    assert trials(found, "pairs") == trials(whole, "pairs")
    (work,) = found.table("work").rows
    kept = sum(json.loads(line)["seconds"] for line in before)
    assert work["count"] == 2
    assert work["seconds"] > kept  # of both runs


def small_robustness(running):
    return robustness(paths=1, draws=1, models=["LSTM"], reference="expert", quick=True, running=running)


@pytest.mark.integration
def test_a_cluster_measures_the_same_as_this_process(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    monkeypatch.setattr(machine, "one_thread", lambda: None)  # too late in a process of tests
    out = tmp_path / "yaw.json"
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        pids = {worker.pid for worker in cluster.workers.values()}
        by_cluster = set(work_through(
            "where", {}, lambda _: os.getpid(), dict.fromkeys("abcdefgh"), Running(scheduler=address),
            lambda done, total: None,
        ).values)  # fmt: skip
        assert by_cluster <= pids
        done = CliRunner().invoke(
            cfplan, ["study", "yaw-consistency", "--pairs", "1", "--scheduler", address, "-o", str(out)]
        )
        assert done.exit_code == 0, done.output
        networks = small_robustness(Running(scheduler=address))
    assert trials(read_result(out), "pairs") == trials(yaw_consistency(pairs=1), "pairs")
    assert trials(networks, "trials") == trials(small_robustness(HERE), "trials")


def test_a_scheduler_that_does_not_answer_is_an_error():
    done = CliRunner().invoke(
        cfplan, ["study", "yaw-consistency", "--scheduler", "tcp://127.0.0.1:9"], standalone_mode=False
    )
    assert isinstance(done.exception, SchedulerError)
    assert "dask scheduler" in done.exception.hint
