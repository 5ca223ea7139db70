"""The limit sets are what they say they are."""

from cfplan.safety.limit_sets import LIMIT_SETS


def test_the_hardware_set_is_what_the_projects_safety_file_allows(limits):
    assert LIMIT_SETS["hardware"].airframe == limits.airframe
    assert LIMIT_SETS["hardware"].limits == limits.plan
