"""What programs import of cfplan: paths, plans, rehearsals; and that importing it costs nothing."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import cfplan
from cfplan.errors import InputError

REPOSITORY = Path(__file__).parents[2]
POINTS = [[0, 0, 1], [1, 0, 1], [1, 1, 1.2]]


def test_every_name_is_there():
    assert all(getattr(cfplan, name) for name in cfplan.__all__)
    assert set(cfplan.__all__) <= set(dir(cfplan))


def test_importing_loads_no_more_than_commands_need():
    code = "import cfplan, sys; print(any(m in sys.modules for m in ('numpy', 'scipy', 'pydantic', 'numba')))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"


def test_a_list_of_points_is_planned_as_the_path_through_them(limits):
    of_points, of_path = cfplan.plan(POINTS, limits), cfplan.plan(cfplan.load_path(POINTS), limits)
    assert of_points.certificate.passed
    assert of_points.duration == of_path.duration


def test_a_saved_plan_is_the_same_flight(limits, tmp_path):
    plan = cfplan.plan(cfplan.load_path(POINTS), limits, planner="convex")
    assert isinstance(plan, cfplan.Plan)
    assert plan.certificate.passed
    plan.save(tmp_path / "plan.parquet")
    again = cfplan.plan(str(tmp_path / "plan.parquet"), limits)
    assert again.duration == plan.duration
    with pytest.raises(InputError, match="parquet"):
        plan.save(tmp_path / "plan.csv")


def test_what_is_returned_is_printed_in_a_line(limits):
    path = cfplan.load_path(POINTS)
    planned = cfplan.plan(path, limits)
    said = [repr(each) for each in (path.path, planned, cfplan.rehearse(planned))]
    assert said[0] == f"<Path of {path.path.length:.1f} m in {len(POINTS) - 1} pieces>"
    assert f"{planned.duration:.2f} s by {planned.plan.planner}, certified" in said[1]
    assert said[2].startswith("<DryRun: passed, ")
    assert all(len(line) < 120 for line in said)


def test_points_and_a_file_of_them_are_one_path(tmp_path):
    angle = np.linspace(0.0, 3.0, 12)
    points = np.stack([np.cos(angle), np.sin(angle), np.ones(12)], axis=1)
    np.savetxt(tmp_path / "arc.csv", points, delimiter=",", fmt="%.17g")
    (tmp_path / "arc.yaml").write_text("points: arc.csv\n")
    of_file, of_points = cfplan.load_path(str(tmp_path / "arc.yaml")), cfplan.load_path(points)
    assert np.array_equal(of_file.path.coefficients, of_points.path.coefficients)
    assert of_file.yaw is of_points.yaw


@pytest.mark.parametrize(
    "wrong",
    ["no/such.yaml", Path("no-such.yaml"), [0, 0, 1], [[0, 0], [1, 1]], [[0, 0, 1], [1]], [["a", "b", "c"]], [],
     [[0, 0, 1], [0, 1, float("nan")]], [[0, 0, 1]], [[0, 0, 1], [0, 0, 1]], None, {"x": 1}, 3.0],
)  # fmt: skip
def test_what_is_no_path_is_refused_with_place_and_hint(wrong):
    with pytest.raises(InputError) as refused:
        cfplan.load_path(wrong)
    assert refused.value.where
    assert refused.value.hint


def test_other_wrong_arguments_are_refused_with_place_and_hint(limits):
    path = cfplan.load_path(POINTS)
    for call in (
        lambda: cfplan.plan(POINTS[:1], limits),
        lambda: cfplan.plan(None, limits),
        lambda: cfplan.plan(path, None),
        lambda: cfplan.plan(path, "no-such.yaml"),
        lambda: cfplan.plan("no-such.parquet", limits),
        lambda: cfplan.plan(path, limits, planner="best"),
        lambda: cfplan.plan(path, limits, speed_factor=2.0),
        lambda: cfplan.plan(path, limits, speed_factor=float("nan")),
        lambda: cfplan.rehearse(path),
    ):
        with pytest.raises(InputError) as refused:
            call()
        assert refused.value.where
        assert refused.value.hint


def test_the_page_runs_as_it_stands(tmp_path, monkeypatch, capsys):
    (tmp_path / "safety.yaml").write_text((REPOSITORY / "safety.yaml").read_text())
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    snippets = re.findall(r"^```python\n(.*?)^```", (REPOSITORY / "docs" / "python.md").read_text(), re.M | re.S)
    for snippet in snippets:
        exec(snippet, names)
    printed = capsys.readouterr().out
    assert "certified: True" in printed
    assert "cm in 95 %" in printed
    assert "row 2" in printed
