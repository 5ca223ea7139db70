"""docs/contributing.md: what it shows of a new planner and a new source of poses works as it stands there."""

import re
import sys
from pathlib import Path
from types import MappingProxyType, ModuleType

import pytest

from cfplan.flight.mocap import child
from cfplan.flight.mocap.frames import Frame, Scene
from cfplan.flight.mocap.uri import parse_uri
from cfplan.geometry.path_file import load_path_file
from cfplan.planning import planners, policy
from cfplan.planning.plan import plan
from cfplan.safety.limits_file import load_limits

REPOSITORY = Path(__file__).parent.parent
PAGE = (REPOSITORY / "docs" / "contributing.md").read_text(encoding="utf-8")


def example(name):
    """What the page's example of that name defines."""
    block = re.search(rf"<!-- example: {name} -->\n\n```python\n(.*?)```", PAGE, re.DOTALL)
    assert block is not None
    names: dict = {}
    exec(block[1], names)
    return names


def test_the_planner_of_the_page_plans_a_certified_flight(monkeypatch):
    steady = ModuleType("steady")
    vars(steady).update(example("planner"))
    monkeypatch.setitem(sys.modules, "steady", steady)
    entry = planners.PlannerEntry("steady:plan_steadily", planners.Finish.REFINED)
    for module, table, row in (
        (planners, "PLANNERS", entry),
        (policy, "PLANNERS", entry),
        (policy, "POLICIES", (policy.Step(("steady",)),)),
    ):
        monkeypatch.setattr(module, table, MappingProxyType({**getattr(module, table), "steady": row}))
    limits = load_limits(REPOSITORY / "safety.yaml")
    path = load_path_file(REPOSITORY / "flights" / "line.yaml").path
    planned = plan(path, limits.airframe, limits, planner="steady")
    assert planned.planner == "steady"
    assert planned.certificate.passed


def test_the_source_of_poses_of_the_page_delivers_frames(monkeypatch):
    driver = example("poses")["CircleDriver"]()
    monkeypatch.setattr(child, "driver_of", lambda uri: driver)
    monkeypatch.setattr(child, "_alarm", lambda seconds: None)
    sent = []

    class Full(Exception):
        """Enough has come."""

    class Outlet:
        def send(self, message):
            sent.append(message)

        def send_frame(self, frame):
            sent.append(frame)
            if frame.number == 3:
                raise Full

    with pytest.raises(Full):
        child.run(parse_uri("vicon://lab/cf1", subject_needed=True), Outlet(), again=False)
    assert sum(isinstance(message, Frame) for message in sent) == 3
    assert any(isinstance(message, Scene) for message in sent)
