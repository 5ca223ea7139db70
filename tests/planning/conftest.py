"""The limits of the project's own safety.yaml, and a short path."""

from pathlib import Path

import pytest

from cfplan.geometry.min_snap import min_snap
from cfplan.safety.limits_file import load_limits


@pytest.fixture(scope="session")
def limits():
    return load_limits(Path(__file__).parents[2] / "safety.yaml")


@pytest.fixture(scope="session")
def path():
    return min_snap([[-1, -1, 0.8], [0, 0.5, 1.2], [1, -0.5, 0.9]])
