"""The paper's figures, drawn from results, with everything that the originals show."""

import numpy as np
import pytest

from cfplan.errors import InputError
from studies.paper.baselines import ALLOCATION, DRAWN, BaselineTrial, random_course
from studies.paper.corridors import BOXES
from studies.paper.figures import (
    EDGES,
    NETWORKS,
    draw_baselines,
    draw_long,
    draw_tracks,
    draw_training,
    draw_yaw_consistency,
    write_figures,
)
from studies.paper.hardware import CERTIFIED, LONG, RAW, SHIPPED, TRACKED, HardwareFlight
from studies.paper.trials import TOPPQUAD
from studies.paper.yaw_consistency import WAYS, Pair
from studies.runner.result import StudyResult

SEEDS = (60_000, 60_001)
BASELINES = [
    BaselineTrial(name, seed, points=random_course(seed).path([0.0, 5.0, 9.0]).tolist() if name in DRAWN else [])
    for seed in SEEDS for name in (*DRAWN, "expert")
]  # fmt: skip
PAIRS = [Pair(way, 50_000, "", 8.0, 1.0, 0.1, 0.2, 0.3) for way in WAYS]


def flights():
    """Return flights over two paths and the long one; as planned, LSTM-0.01 crashes and is lost over the second."""
    over = {RAW: [[0, 0, 0], [900, 880, 0]], CERTIFIED: [[0, 0, 500], [900, 890, 500]]}
    made = [
        HardwareFlight(TRACKED, way, planner, path, trial, deviation=0.1, points=over[way])
        for path in ("1", "2", LONG) for way in (RAW, CERTIFIED) for planner in (TOPPQUAD, *NETWORKS)
        for trial in range(2)
    ]  # fmt: skip
    made.append(HardwareFlight(TRACKED, RAW, "LSTM-0.01", "2", 2, reason="crash"))
    made.append(HardwareFlight(TRACKED, RAW, "LSTM-0.01", "2", 3, deviation=1.2, points=over[RAW]))
    return [*made, HardwareFlight(TRACKED, CERTIFIED, SHIPPED, LONG, 0, deviation=0.1, points=over[CERTIFIED])]


def test_tracks_of_one_network_and_toppquad_stand_over_each_path_as_planned_and_certified():
    panels = [panel for panel in draw_tracks(flights(), "LSTM-0.01").axes if panel.get_visible()]
    assert [panel.get_title() for panel in panels] == ["path 1", "path 2: 2 of 4 failed", "path 1", "path 2"]
    for panel, count in zip(panels, (2, 4, 2, 2), strict=True):
        colours = [line.get_color() for line in panel.lines]
        assert len(colours) == 1 + 2 + count
        assert colours.count(NETWORKS["LSTM-0.01"]) == count
        np.testing.assert_allclose(panel.lines[1].get_xdata(), [0.0, 0.9])


def test_the_long_path_is_drawn_from_above_and_from_the_side_with_all_that_was_flown_certified():
    above, side = draw_long(flights()).axes
    assert len(above.lines) == len(side.lines) == 1 + 2 * (1 + len(NETWORKS)) + 1
    assert (above.get_xlabel(), side.get_ylabel()) == ("x, m", "z, m")
    np.testing.assert_allclose(above.lines[-1].get_ydata(), [0.0, 0.89])
    np.testing.assert_allclose(side.lines[-1].get_ydata(), [0.5, 0.5])
    with pytest.raises(InputError, match="long path"):
        draw_long(flights()[:1])


def test_each_planner_has_a_panel_for_each_path_and_allocnets_has_its_boxes():
    panels = draw_baselines(BASELINES).axes
    assert [panel.get_title() for panel in panels[: len(DRAWN)]] == list(DRAWN)
    assert len(panels) == len(SEEDS) * len(DRAWN)
    for number, panel in enumerate(panels):
        boxes = BOXES if DRAWN[number % len(DRAWN)] == ALLOCATION else 0
        assert len(panel.lines) == 12 * boxes + 2  # the motion, and its waypoints


def test_a_box_has_twelve_edges_of_one_axis_each():
    assert len(set(EDGES)) == 12
    assert all(bin(first ^ second).count("1") == 1 for first, second in EDGES)


def test_every_way_to_plan_has_its_histograms_of_as_many_pairs():
    panels = draw_yaw_consistency([*PAIRS, Pair(next(iter(WAYS)), 50_001, "no solution")]).axes
    assert len(panels) == 3 * len(WAYS)
    for panel in panels:
        assert sum(bar.get_height() for bar in panel.patches) == 1


def test_figures_are_written_and_those_without_rows_name_the_command_that_makes_them(tmp_path):
    def write(study, rows):
        StudyResult(study, {}, (), rows).write(tmp_path / f"{study}.json")

    write("baselines", BASELINES)
    written = {file.name: reason for file, reason in write_figures(tmp_path, tmp_path, tmp_path)}
    assert not written["paper-baselines.png"]
    assert f"python -m studies yaw-consistency -o {tmp_path}/yaw-consistency.json" in written["paper-yaw.png"]
    assert not (tmp_path / "paper-yaw.png").exists()
    write("yaw-consistency", PAIRS)
    write("hardware", flights())
    assert "python -m studies networks" in written["paper-training.png"]
    for name in ("LSTM", "LSTM-seed-1", "MLP"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "weights.safetensors").touch()
        (tmp_path / name / "log.csv").write_text("epoch,unseen_loss,rate\n1,0.5,0.003\n2,0.4,0.001\n")
    written = dict(write_figures(tmp_path, tmp_path, tmp_path))
    assert not any(written.values())
    assert {file.stem for file in written} == {
        "paper-baselines",
        "paper-yaw",
        "paper-long",
        "paper-training",
        *(f"paper-{name}" for name in NETWORKS),
    }
    assert all(file.stat().st_size > 10_000 for file in written)


def test_each_model_has_a_panel_with_a_line_for_each_seed_and_a_mark_at_each_cut_of_the_rate():
    logs = {name: [(0.5, 3e-3), (0.4, 3e-3), (0.3, 1e-3)] for name in ("LSTM", "LSTM-seed-1", "MLP")}
    panels = [panel for panel in draw_training(logs).axes if panel.get_visible()]
    assert [panel.get_title() for panel in panels] == ["LSTM", "MLP"]
    assert [len(panel.lines) for panel in panels] == [4, 2]
    assert panels[1].lines[1].get_xydata().tolist() == [[2.0, 0.4]]


def test_a_folder_for_figures_must_be_there(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        write_figures(tmp_path, tmp_path / "none", tmp_path)
