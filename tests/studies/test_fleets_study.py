"""The study of fleets: two vehicles are kept apart, by its own check too."""

import math

from studies.fleets import STUDY, Settings
from studies.runner.cases import run_study


def test_a_fleet_is_coordinated_and_checked():
    settings = Settings(fleets=1, sizes=(2,), moments=3, seed=1)
    (row,) = run_study("fleets", "studies.fleets", STUDY, settings).table("fleets").rows
    assert (row["vehicles"], row["fleets"], row["solved"]) == (2, 1, 1)
    assert row["nearest"] >= 0.3
    assert 1.0 <= row["makespan"] < 2.0
    assert (row["replanned"], row["regards_lost"]) == (0, 1)
    if row["keeps_lost"]:
        assert row["lost_makespan"] >= row["makespan"] - 0.01
        assert row["lost_nearest"] > 0.12  # 0.20 m less 0.08 m that drawn vehicles leave the swept box by
    else:
        assert math.isnan(row["lost_makespan"])
