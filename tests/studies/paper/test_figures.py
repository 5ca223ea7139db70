"""The paper's figures: drawn from results, with all that the paper's show."""

import numpy as np
import pytest

from cfplan.errors import InputError
from studies.paper.baselines import ALLOCATION, DRAWN, random_course
from studies.paper.corridors import BOXES, box_corners, corridor_about
from studies.paper.figures import (
    EDGES,
    NETWORKS,
    draw_baselines,
    draw_long,
    draw_tracks,
    draw_yaw_consistency,
    write_figures,
)
from studies.paper.hardware import CERTIFIED, LONG, RAW, SHIPPED, TRACKED
from studies.paper.trials import TOPPQUAD
from studies.paper.yaw_consistency import WAYS, yaw_consistency
from studies.runner.result import StudyResult, detail_table

SEEDS = (60_000, 60_001)


@pytest.fixture
def baselines():
    rows = []
    for seed in SEEDS:
        course = random_course(seed)
        rows.append({"seed": seed, "what": "waypoints", "points": course.waypoints.tolist()})
        rows += [{"seed": seed, "what": name, "points": course.path([0.0, 5.0, 9.0]).tolist()} for name in DRAWN]
        boxes = box_corners(corridor_about(course.path))
        rows += [{"seed": seed, "what": "box", "points": box.tolist()} for box in boxes]
    return StudyResult("baselines", {}, (), (detail_table("drawn", rows),))


@pytest.fixture(scope="module")
def pairs():
    return yaw_consistency(pairs=1)


@pytest.fixture(scope="module")
def hardware():
    rows = []
    for path in ("1", "2", LONG):
        rows.append({"path": path, "planner": "", "way": "", "points": [[0, 0, 0], [900, 900, 0]]})
        rows += [
            {"path": path, "planner": planner, "way": way, "points": [[0, 0, 0], [900, 880, 0]]}
            for way in (RAW, CERTIFIED) for planner in (TOPPQUAD, *NETWORKS) for _ in range(2)
        ]  # fmt: skip
        rows += [{"path": path, "planner": SHIPPED, "way": CERTIFIED, "points": [[0, 0, 500], [900, 890, 500]]}] * (
            path == LONG
        )
    flights = [
        {"limits": TRACKED, "way": RAW, "planner": "LSTM-0.01", "path": "2", "reason": reason, "deviation": deviation}
        for reason, deviation in (("crash", None), ("", 0.1), ("", 1.2))
    ]
    return StudyResult("hardware", {}, (), (detail_table("tracks", rows), detail_table("flights", flights)))


def test_tracks_of_one_network_and_toppquad_stand_over_each_path_as_planned_and_certified(hardware):
    panels = [panel for panel in draw_tracks(hardware, "LSTM-0.01").axes if panel.get_visible()]
    assert [panel.get_title() for panel in panels] == ["path 1", "path 2: 2 of 3 failed", "path 1", "path 2"]
    for panel in panels:
        colours = [line.get_color() for line in panel.lines]
        assert len(colours) == 5
        assert colours.count(NETWORKS["LSTM-0.01"]) == 2
        np.testing.assert_allclose(panel.lines[0].get_xdata(), [0.0, 0.9])


def test_the_long_path_is_drawn_from_above_and_from_the_side_with_all_that_was_flown_certified(hardware):
    above, side = draw_long(hardware).axes
    assert len(above.lines) == len(side.lines) == 1 + 2 * (1 + len(NETWORKS)) + 1
    assert (above.get_xlabel(), side.get_ylabel()) == ("x, m", "z, m")
    np.testing.assert_allclose(above.lines[-1].get_ydata(), [0.0, 0.89])
    np.testing.assert_allclose(side.lines[-1].get_ydata(), [0.5, 0.5])
    without = StudyResult("hardware", {}, (), (detail_table("tracks", hardware.table("tracks").rows[:1]),))
    with pytest.raises(InputError, match="long path"):
        draw_long(without)


def test_each_planner_has_a_panel_for_each_path_and_allocnets_has_its_boxes(baselines):
    panels = draw_baselines(baselines).axes
    assert [panel.get_title() for panel in panels[: len(DRAWN)]] == list(DRAWN)
    assert len(panels) == len(SEEDS) * len(DRAWN)
    for number, panel in enumerate(panels):
        boxes = BOXES if DRAWN[number % len(DRAWN)] == ALLOCATION else 0
        assert len(panel.lines) == 12 * boxes + 2  # the motion, and its waypoints


def test_a_box_has_twelve_edges_of_one_axis_each():
    assert len(set(EDGES)) == 12
    assert all(bin(first ^ second).count("1") == 1 for first, second in EDGES)


def test_every_way_to_plan_has_its_histograms_of_as_many_pairs(pairs):
    panels = draw_yaw_consistency(pairs).axes
    assert len(panels) == 3 * len(WAYS)
    for panel in panels:
        assert sum(bar.get_height() for bar in panel.patches) == 1


def test_figures_are_written_and_those_without_a_result_are_left_out_with_the_reason(
    tmp_path, baselines, pairs, hardware
):
    baselines.write(tmp_path / "baselines.json")
    StudyResult("hardware", {}, ()).write(tmp_path / "hardware.json")  # of a version that kept no tracks
    written = {file.name: reason for file, reason in write_figures(tmp_path, tmp_path)}
    assert not written["paper-baselines.png"]
    assert "No such file" in written["paper-yaw.png"]
    assert "no table 'tracks'" in written["paper-LSTM-0.1.png"]
    assert not (tmp_path / "paper-yaw.png").exists()
    pairs.write(tmp_path / "yaw-consistency.json")
    hardware.write(tmp_path / "hardware.json")
    written = dict(write_figures(tmp_path, tmp_path))
    assert not any(written.values())
    assert {file.stem for file in written} == {
        "paper-baselines",
        "paper-yaw",
        "paper-long",
        *(f"paper-{name}" for name in NETWORKS),
    }
    assert all(file.stat().st_size > 10_000 for file in written)


def test_a_folder_for_figures_must_be_there(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        write_figures(tmp_path, tmp_path / "none")
