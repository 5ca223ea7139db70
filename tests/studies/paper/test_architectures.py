"""The paper's tables of planners: their counts, the paper's numbers, and quick runs."""

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from studies.paper import architectures, inputs
from studies.paper.architectures import AS_BYTES, amid
from studies.paper.networks import Kind
from studies.paper.printed import ABOVE_IN_TEXT, ARCHITECTURES, INPUTS
from studies.paper.sequences import Inputs
from studies.paper.trained import NetworkSettings
from studies.paper.training import OURS
from studies.paper.trials import SHIPPED, TOPPQUAD, PaperTrial, planner_tables
from studies.runner.cases import run_study


def trial(row, *, time=5.0, deviation=0.1, planner="LSTM", reason=""):
    return PaperTrial(planner, "test", row, False, reason, time, 0.01, deviation, 0.001, 0.002, 5.1, 5.0)


def test_a_row_counts_failures_in_one_mean_and_not_in_the_other():
    trials = [
        trial(0, time=5.05), trial(1, time=4.95, deviation=0.3), trial(2, time=4.0, deviation=1.0),
        PaperTrial("LSTM", "test", 3, False, "no spline", reference_time=5.0),
    ]  # fmt: skip
    raw, repaired = planner_tables("architectures", "network", ARCHITECTURES, trials)
    (row,) = raw.rows
    assert row["failed"] == 2
    assert row["deviation"] == pytest.approx((0.1 + 0.3 + 1.0 + 1.0) / 4)
    assert row["deviation_flown"] == pytest.approx(0.2)
    assert row["slower"] == pytest.approx((0.01 - 0.01 - 0.2) / 3)
    assert row["slower_flown"] == pytest.approx(0.0)
    assert row["above"] == pytest.approx(0.02)
    assert (row["paper_deviation"], row["paper_failed"]) == (0.143, 0.04)
    assert not repaired.rows


def test_what_the_paper_prints_is_consistent_where_it_prints_twice():
    for part in ("train", "test"):
        assert ARCHITECTURES["LSTM", part][:4] == INPUTS["pos/vel/acc", part][:4]
    above = [
        ARCHITECTURES["LSTM", part].deviation - ARCHITECTURES["TOPPQuad", part].deviation for part in ("train", "test")
    ]
    assert above == pytest.approx([0.021, 0.090])
    assert all(each != pytest.approx(ABOVE_IN_TEXT) for each in above)  # as the documentation says


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "settings", "planners"),
    [
        (
            architectures,
            architectures.Settings(paths=1, quick=True, seeds=2),
            [TOPPQUAD, "expert", *list(Kind)[:-1], OURS.model, "BiLSTM", SHIPPED],
        ),
        (inputs, NetworkSettings(paths=1, quick=True), [TOPPQUAD, *Inputs]),
    ],
)
def test_the_quick_run_makes_all_tables(module, settings, planners):
    name = module.__name__.rpartition(".")[2]
    result = run_study(name, module.__name__, module.STUDY, settings)
    rows = [(row["planner"], row["part"]) for row in result.table(name).rows]
    assert rows == [(planner, part) for planner in planners for part in ("train", "test")]
    assert len(result.table(f"{name}-repaired").rows) == len(rows)
    trainings = result.table("training").rows
    assert len({row["network"] for row in trainings}) == len({*planners} - {TOPPQUAD, "expert", SHIPPED})
    assert all((row["epochs"], row["flat"], row["labels"]) == (2, 0, "expert") for row in trainings)
    flown = [row for row in result.rows if row.repaired and not row.reason and row.planner != AS_BYTES]
    assert flown
    assert max(row.violation for row in flown) < 1e-4  # certified
    assert max(row.top_speed for row in flown) <= 5.0 + 1e-6
    if module is architectures:
        assert [row["part"] for row in result.table("shipped").rows] == ["train", "test"]
        assert all(row["deviation"] < 0.05 for row in result.table("shipped").rows)


def test_a_path_far_from_the_origin_is_flown_in_the_middle_of_its_room():
    path = min_snap([[-33.0, 20.0, 1.0], [5.0, 21.0, 2.0], [27.0, -4.0, 9.0]])
    moved = amid(path)
    places = moved(np.linspace(0.0, moved.end, 500))
    assert np.abs(places.min(axis=0) + places.max(axis=0)).max() < 1e-2
    np.testing.assert_allclose(moved(3.0) - moved(1.0), path(3.0) - path(1.0), atol=1e-9)


def test_without_data_the_command_that_makes_it_is_named(tmp_path):
    with pytest.raises(InputError, match="no such dataset") as error:
        run_study("inputs", "studies.paper.inputs", inputs.STUDY, NetworkSettings(data=tmp_path / "none"))
    assert error.value.hint.startswith("make it: cfplan dataset make datasets/paper --count 10100")
