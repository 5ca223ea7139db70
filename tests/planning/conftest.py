"""A short path."""

import pytest

from cfplan.geometry.min_snap import min_snap


@pytest.fixture(scope="session")
def path():
    return min_snap([[-1, -1, 0.8], [0, 0.5, 1.2], [1, -0.5, 0.9]])
