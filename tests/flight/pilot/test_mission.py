"""The time to go to a start suffices for the limits of plans, however far the vehicle turns."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cfplan.flight.on_board.go_to import go_to_states
from cfplan.flight.pilot.mission import go_to_time
from cfplan.flight.setpoints.hover_to_hover import hover_to_hover
from cfplan.safety.limits_file import load_limits

LIMITS = load_limits(Path(__file__).parents[3] / "safety.yaml")
PLACE = (0.5, -1.0, 0.7)


@given(turn=st.floats(-math.pi, math.pi), rate=st.floats(0.06, 10.0), change=st.floats(0.06, 40.0))
def test_a_turn_keeps_the_limits_by_setpoints_and_by_the_commander(turn, rate, change):
    allowed = replace(LIMITS, plan=replace(LIMITS.plan, angular_velocity=rate, angular_acceleration=change))
    duration = go_to_time(0.0, turn, allowed)
    setpoints = hover_to_hover(PLACE, 0.3, PLACE, 0.3 + turn, duration, 200.0 / duration).body_rate[:, 2]
    begin = np.zeros((1, 3, 4))
    commander = go_to_states(begin, np.array([[0.0, 0.0, 0.0, turn]]), duration, 201)[0, :, 1, 3]
    for rates in (setpoints, commander):
        assert np.abs(rates).max() <= rate * (1.0 + 1e-6)
        assert np.abs(np.gradient(rates, duration / 200.0)).max() <= change * (1.0 + 1e-6)


def test_a_short_straight_way_takes_as_long_as_any_short_way():
    assert go_to_time(0.1, 0.0, LIMITS) == go_to_time(0.0, math.pi, LIMITS) == 1.5
    assert go_to_time(3.0, 0.0, LIMITS) == 3.0 / LIMITS.ground.go_to_speed
