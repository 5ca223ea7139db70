"""How long the paper's tables take: from what their results took, with each network trained once."""

from dataclasses import replace

import pytest
from click.testing import CliRunner
from studies.runner.items import Running, unfinished_file, work_table, work_through

from cfplan.cli import cfplan
from cfplan.errors import InputError
from studies import machine
from studies.paper import expected_time
from studies.paper.all_tables import TABLES
from studies.paper.expected_time import USUALLY_SEEN, WHOLE, ResultState, expected
from studies.runner.provenance import provenance
from studies.runner.result import Column, StudyResult, Table, detail_table

EARLIER = replace(provenance(), commit="b" * 40)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of results, beside which none are known."""
    monkeypatch.setattr(expected_time, "SHIPPED_RESULTS", tmp_path / "none")
    return tmp_path


def write(folder, name, steps, **changed):
    StudyResult(name, {"quick": False}, (), (work_table(steps),), provenance=EARLIER, **changed).write(
        folder / f"{name}.json"
    )


def test_every_table_says_of_which_steps_it_is_made():
    assert set(WHOLE) == set(TABLES)


def test_a_whole_run_takes_as_long_a_step_as_the_results_did(folder):
    write(folder, "architectures", {"path through LSTM": (1000, 10.0), "path": (40, 20.0)})
    write(folder, "inputs", {"path through LSTM": (1000, 10.0), "path through LSTM-pos": (500, 2.5), "path": (4, 8.0)})
    write(folder, "baselines", {"path": (20, 800.0)})  # does not say what corridors take
    found = {each.study: each for each in expected(folder)}
    assert found["architectures"].other_seconds == pytest.approx(200 * 0.5)
    assert found["architectures"].training_seconds == pytest.approx(14 * USUALLY_SEEN * 0.01)
    assert found["inputs"].other_seconds == pytest.approx(200 * 2.0)
    assert found["inputs"].training_seconds == pytest.approx(14 * USUALLY_SEEN * 0.005)  # the LSTM is trained by then
    assert found["baselines"].other_seconds == pytest.approx(50 * 40.0)
    assert found["baselines"].unknown == ("corridor",)
    assert found["hardware"].unknown == ("plan",)
    assert found["hardware"].other_seconds == 0.0
    assert found["architectures"].state is ResultState.STALE
    assert found["architectures"].remark == "of bbbbbbbbbbbb"
    assert found["hardware"].state is ResultState.MISSING


def test_older_results_say_what_their_trainings_and_plans_took(folder):
    training = Table("training", "", tuple(map(Column, ("network", "epochs", "learned_from", "seconds"))),
                     ({"network": "LSTM", "epochs": 5, "learned_from": 100, "seconds": 2.0},))  # fmt: skip
    trials = [{"seed": seed, "repaired": repaired, "seconds": 3.0} for seed in (1, 2) for repaired in (False, True)]
    StudyResult("baselines", {}, (training,), (detail_table("trials", trials),), provenance=EARLIER).write(
        folder / "baselines.json"
    )
    (found,) = (each for each in expected(folder) if each.study == "baselines")
    assert found.training_seconds == pytest.approx(14 * USUALLY_SEEN * 0.004)
    assert found.other_seconds == pytest.approx(50 * 3.0)


def test_what_is_done_of_a_study_is_counted(folder):
    running = Running(result=folder / "inputs.json")
    work_through("inputs", {}, str, {"a": 1, "b": 2}, running, lambda done, total: None)
    found = {each.study: each for each in expected(folder)}
    assert (found["inputs"].state, found["inputs"].remark) == (ResultState.BEGUN, "2 items done")
    assert unfinished_file(folder / "inputs.json").is_file()


def test_the_command_prints_it_and_makes_nothing(folder, monkeypatch):
    monkeypatch.setattr(machine, "one_thread", lambda: None)  # too late in a process of tests
    write(folder, "yaw-consistency", {"pair": (10, 720.0)})
    done = CliRunner().invoke(cfplan, ["study", "paper", str(folder), "--dry-run", "--workers", "2"])
    assert done.exit_code == 0, done.output
    assert "A whole run takes 60 min on 2 processes" in done.output
    assert "bbbbbbbbbbbb" in done.output
    assert [file.name for file in folder.iterdir()] == ["yaw-consistency.json"]


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        expected(tmp_path / "none")
