"""The limit sets are what they say they are."""

from pathlib import Path

from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.safety.limits_file import load_limits


def test_the_hardware_set_is_what_the_projects_safety_file_allows():
    limits = load_limits(Path(__file__).parents[2] / "safety.yaml")
    assert LIMIT_SETS["hardware"].airframe == limits.airframe
    assert LIMIT_SETS["hardware"].limits == limits.plan
