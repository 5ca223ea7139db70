"""The paper's tables: what is counted, what stands beside it, and the quick runs of their commands."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from cfplan.cli import cfplan
from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from studies import machine
from studies.paper.architectures import amid, architectures
from studies.paper.printed import ABOVE_IN_TEXT, ARCHITECTURES, INPUTS
from studies.paper.trials import PaperTrial, planner_row


def trial(row, *, time=5.0, deviation=0.1, planner="LSTM", reason=""):
    return PaperTrial(planner, "test", row, False, reason, time, 0.01, deviation, 0.001, 0.002, 5.1)


def test_a_row_counts_failures_in_one_mean_and_not_in_the_other():
    reference = [trial(row, planner="TOPPQuad") for row in range(4)]
    own = [
        trial(0, time=5.05), trial(1, time=4.95, deviation=0.3), trial(2, time=4.0, deviation=1.0),
        PaperTrial("LSTM", "test", 3, False, "no spline"),
    ]  # fmt: skip
    row = planner_row(own, reference, ARCHITECTURES["LSTM", "test"])
    assert row["failed"] == 2
    assert row["deviation"] == pytest.approx((0.1 + 0.3 + 1.0 + 1.0) / 4)
    assert row["deviation_flown"] == pytest.approx(0.2)
    assert row["slower"] == pytest.approx((0.01 - 0.01 - 0.2) / 3)
    assert row["slower_flown"] == pytest.approx(0.0)
    assert row["above"] == pytest.approx(0.02)
    assert (row["paper_deviation"], row["paper_failed"]) == (0.143, 0.04)


def test_what_the_paper_prints_is_consistent_where_it_prints_twice():
    for part in ("train", "test"):
        assert ARCHITECTURES["LSTM", part][:4] == INPUTS["pos/vel/acc", part][:4]
    above = [
        ARCHITECTURES["LSTM", part].deviation - ARCHITECTURES["TOPPQuad", part].deviation for part in ("train", "test")
    ]
    assert above == pytest.approx([0.021, 0.090])
    assert all(each != pytest.approx(ABOVE_IN_TEXT) for each in above)  # as the documentation says


@pytest.mark.parametrize(("name", "rows"), [("architectures", 14), ("inputs", 10)])
def test_the_quick_run_makes_all_tables(name, rows, tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "one_thread", lambda: None)  # too late in a process of tests
    out = tmp_path / "out.json"
    done = CliRunner().invoke(cfplan, ["study", name, "--quick", "--paths", "1", "-o", str(out)])
    assert done.exit_code == 0, done.output
    document = json.loads(out.read_text())
    tables = {table["name"]: table for table in document["tables"]}
    assert {name, f"{name}-repaired", "training"} <= set(tables)
    assert len(tables[name]["rows"]) == rows
    assert document["settings"]["quick"]
    found = {table["name"]: table for table in document["details"]}["trials"]
    columns = [column["key"] for column in found["columns"]]
    trials = [dict(zip(columns, row, strict=True)) for row in found["rows"]]
    flown = [each for each in trials if each["repaired"] and not each["reason"]]
    assert flown
    assert max(each["violation"] for each in flown) < 1e-4  # certified
    assert max(each["top_speed"] for each in flown) <= 5.0 + 1e-6
    if name == "architectures":
        (shipped,) = (table for table in document["tables"] if table["name"] == "shipped")
        assert len(shipped["rows"]) == 2


def test_a_path_far_from_the_origin_is_flown_in_the_middle_of_its_room():
    path = min_snap([[-33.0, 20.0, 1.0], [5.0, 21.0, 2.0], [27.0, -4.0, 9.0]])
    moved = amid(path)
    places = moved(np.linspace(0.0, moved.end, 500))
    assert np.abs(places.min(axis=0) + places.max(axis=0)).max() < 1e-2
    np.testing.assert_allclose(moved(3.0) - moved(1.0), path(3.0) - path(1.0), atol=1e-9)


def test_unknown_architectures_are_named():
    with pytest.raises(InputError, match="unknown architecture 'GRU'") as error:
        architectures(kinds=["GRU"])
    assert "ETransformer" in error.value.hint


def test_without_data_the_command_that_makes_it_is_named(tmp_path):
    with pytest.raises(InputError, match="no such dataset") as error:
        architectures(data=tmp_path / "none")
    assert error.value.hint.startswith("make it: cfplan dataset make datasets/paper --count 10100")
