"""Paths through waypoints are replanned around a vehicle that blocks them."""

import numpy as np
import pytest

from cfplan.errors import InfeasibleError
from cfplan.preparation.plan_fleet import plan_fleet

APART, SKEW = 0.35, 0.03
ENDS_APART = {"there": ([0.0, -1.6, 1.0], [0.0, 1.2, 1.0]), "back": ([0.0, 1.6, 1.0], [0.0, -1.2, 1.0])}

# Each straight path passes through the other's start, 0.37 m ahead: nearer than `apart` and the detours' slack, 0.40 m.
STARTS_NEAR = {"there": ([0.0, 0.0, 1.0], [0.0, 1.6, 1.0]), "back": ([0.0, 0.37, 1.0], [0.0, -1.4, 1.0])}


@pytest.fixture
def face_to_face(tmp_path):
    """Two vehicles that meet on one line, with the shape of each path, and its start and end by name."""

    def make(shapes, all_ends=ENDS_APART):
        lines = [f"apart: {APART}", f"skew: {SKEW}", "lost: warn", "vehicles:"]
        for (name, ends), shape in zip(all_ends.items(), shapes, strict=True):
            (tmp_path / f"{name}.yaml").write_text(f"waypoints: {list(ends)}\nshape: {shape}\n")
            lines.append(f"  {name}: {{path: {name}.yaml}}")
        file = tmp_path / "fleet.yaml"
        file.write_text("\n".join(lines))
        return file

    return make


@pytest.mark.parametrize(
    ("shapes", "all_ends"),
    [
        (("fastest", "fastest"), ENDS_APART),
        (("min-snap", "fastest"), ENDS_APART),
        (("fastest", "min-snap"), ENDS_APART),
        (("fastest", "fastest"), STARTS_NEAR),
    ],
    ids=["both fastest", "first min-snap", "second min-snap", "near starts"],
)
def test_vehicles_that_meet_on_one_line_pass_each_other(face_to_face, limits, shapes, all_ends):
    steps = {}
    fleet = plan_fleet(
        face_to_face(shapes, all_ends), limits, on_step=lambda name, state, result: steps.update({name: result})
    )

    times = np.arange(0.0, fleet.end + 0.5, 0.002)

    def columns(member, late):
        trajectory = member.plan.trajectory
        return trajectory.at(np.clip(times + late - member.delay, 0.0, trajectory.duration)).position[:, :2]

    there, back = fleet.members
    nearest = min(
        float(np.linalg.norm(columns(there, 0.0) - columns(back, late), axis=1).min())
        for late in np.linspace(-SKEW, SKEW, 13)
    )
    assert nearest > APART - 1e-3
    for member in fleet.members:
        assert np.allclose(member.plan.path(np.array([0.0, member.plan.path.end])), all_ends[member.name], atol=1e-6)
        straight = np.abs(member.plan.path(np.linspace(0.0, member.plan.path.end, 200))[:, 0]).max() < 1e-6
        assert any(f"the path of {member.name} leads around" in each for each in fleet.detours) != straight
    assert fleet.detours
    assert all(detour in steps["coordination"] for detour in fleet.detours)
    assert list(fleet.detours) == list(fleet.to_dict()["detours"])


def test_min_snap_paths_are_not_replanned(face_to_face, limits):
    with pytest.raises(InfeasibleError, match=r"0\.35 m apart: .* blocks "):
        plan_fleet(face_to_face(("min-snap", "min-snap")), limits)
