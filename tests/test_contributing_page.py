"""docs/contributing.md: what it shows of a new planner and a new source of poses works as it stands there."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cfplan.flight.mocap import child
from cfplan.flight.mocap.frames import Frame, Scene
from cfplan.flight.mocap.uri import parse_uri

REPOSITORY = Path(__file__).parent.parent
PAGE = (REPOSITORY / "docs" / "contributing.md").read_text(encoding="utf-8")


def source(name):
    """The Python of the page's example of that name."""
    block = re.search(rf"<!-- example: {name} -->\n\n```python\n(.*?)```", PAGE, re.DOTALL)
    assert block is not None
    return block[1]


def example(name):
    """What the page's example of that name defines."""
    names: dict = {}
    exec(source(name), names)
    return names


@pytest.mark.slow
@pytest.mark.integration
def test_the_planner_of_the_page_plans_a_certified_flight(tmp_path):
    """In a copy of the package, with the rows that the page shows; it is not compiled, as nothing can be kept."""
    package = tmp_path / "cfplan"
    shutil.copytree(REPOSITORY / "cfplan", package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "planners" / "baselines" / "steady.py").write_text(source("planner"))
    for name in ("PLANNERS", "POLICIES"):
        shown = re.search(rf"`{name}` of\s+`(planning/\w+\.py)`\s+\(`(.*?)`\)", PAGE, re.DOTALL)
        assert shown is not None
        file, row = package / shown[1], shown[2]
        text, table = file.read_text(), f"{name} = MappingProxyType(\n    {{\n"
        assert table in text
        file.write_text(text.replace(table, f"{table}        {row},\n"))
    (tmp_path / "file").write_text("")
    shutil.copy(REPOSITORY / "safety.yaml", tmp_path)
    shutil.copy(REPOSITORY / "flights" / "line.yaml", tmp_path)
    planned = subprocess.run(
        [sys.executable, "-m", "cfplan", "plan", "line.yaml", "--planner", "steady", "--json"],
        cwd=tmp_path, capture_output=True, text=True, timeout=280,
        env=os.environ | {"PYTHONPATH": str(tmp_path), "CFPLAN_CACHE": str(tmp_path / "file" / "below")},
    )  # fmt: skip
    assert planned.returncode == 0, planned.stderr
    told = json.loads(planned.stdout)
    assert told["planner"] == "steady"
    assert told["certificate"]["passed"]


def test_the_source_of_poses_of_the_page_delivers_frames(monkeypatch):
    driver = example("poses")["CircleDriver"]()
    monkeypatch.setattr(child, "driver_of", lambda uri: driver)
    monkeypatch.setattr("signal.setitimer", lambda which, seconds: None)
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
