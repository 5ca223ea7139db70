"""The figure of a plan shows the room in one scale and as a map does, and what was flown where it was flown."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.planning.active_limits import LIMIT_COLOURS, active_limits
from cfplan.planning.figure import Flown, draw_plan, save_figure
from cfplan.planning.plan import plan


@pytest.fixture(scope="module")
def made(limits):
    path = min_snap([[-1, -1, 0.8], [0, 0.5, 1.2], [1, -0.5, 0.9]])
    return plan(path, limits.airframe, limits, planner="minsnap", nodes=60)


@pytest.fixture(scope="module")
def figure(made):
    time = np.linspace(0.0, made.trajectory.duration, 200)
    off = 0.05 * np.sin(np.pi * np.linspace(0.0, 1.0, 200))
    return draw_plan(made, r"$\bent$", Flown(time, made.trajectory.at(time).position + off[:, None] * [1.0, 0, 0], off))


def test_the_room_is_drawn_in_one_scale_and_not_mirrored(figure, limits):
    FigureCanvasAgg(figure).draw()
    above, aside = (axes for axes in figure.axes if axes.get_title(loc="left"))
    for axes in (above, aside):
        across, up = axes.get_xlabel(), axes.get_ylabel()
        right, top = axes.transData.transform([[0, 0], [1, 0], [0, 1]])[1:] - axes.transData.transform([0, 0])
        assert abs(right[0]) == pytest.approx(abs(top[1]), rel=1e-6)
        # Seen from above, x to the right has y up; with x up, y is to the left.
        assert (across, up, right[0] > 0) in (("x, m", "y, m", True), ("y, m", "x, m", False)) or axes is aside
        box = axes.patches[0].get_bbox()
        assert sorted((abs(box.width), abs(box.height)))[-1] == pytest.approx(
            limits.space.high[1] - limits.space.low[1]
        )


def test_curves_are_of_the_plan_and_of_the_flight(figure, made):
    labels = {axes.get_ylabel(): axes for axes in figure.axes}
    speed = labels["speed, m/s"].lines[0].get_ydata()
    assert speed.max() == pytest.approx(
        np.linalg.norm(made.trajectory.at(active_limits(made).time).velocity, axis=1).max()
    )
    assert labels["deviation, cm"].lines[0].get_ydata().max() == pytest.approx(5.0, rel=1e-3)
    assert max(np.max(line.get_ydata()) for line in labels["share of the limit, %"].lines) <= 100.0 + 1e-9
    named = {text.get_text() for legend in figure.subfigs[0].legends for text in legend.get_texts()}
    assert {"start", "end", "flown"} <= named
    assert named <= {"start", "end", "flown", "no limit", *LIMIT_COLOURS}


def test_the_largest_deviation_is_magnified(figure):
    above = next(axes for axes in figure.axes if axes.get_title(loc="left") == "from above")
    (inset,) = above.child_axes
    assert inset.texts[0].get_text() == "5.0 cm off"
    planned, flown = (np.array(line.get_xydata()[0]) for line in inset.lines[-2:])
    assert np.linalg.norm(flown - planned) == pytest.approx(0.05, rel=0.02)


@pytest.mark.parametrize(("suffix", "begins"), [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")])
def test_figures_are_written_whole_and_nothing_is_overwritten(figure, tmp_path, suffix, begins):
    file = tmp_path / f"plan{suffix}"
    save_figure(figure, file)
    assert file.read_bytes().startswith(begins)
    with pytest.raises(InputError, match="already"):
        save_figure(figure, file)
    assert [found.name for found in tmp_path.iterdir()] == [file.name]


def test_what_is_no_figure_is_refused(figure, tmp_path):
    with pytest.raises(InputError, match=r"must end in \.png, \.pdf, \.svg"):
        save_figure(figure, tmp_path / "plan.jpg")
    with pytest.raises(InputError, match="no such folder"):
        save_figure(figure, tmp_path / "no" / "plan.pdf")
