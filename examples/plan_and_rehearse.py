"""Plan the fastest flight through points of your own, save it, and rehearse it in the simulator; nothing flies.

    python examples/plan_and_rehearse.py --output plan.parquet

`cfplan fly plan.parquet` flies what it saves.
"""

import argparse
from collections.abc import Sequence

import cfplan

POINTS = [[0.0, 0.0, 1.0], [1.0, 0.5, 1.2], [0.0, 1.0, 1.4], [-1.0, 0.0, 1.0]]  # m


def plan_and_rehearse(points: Sequence[Sequence[float]], safety: str, output: str) -> tuple[float, float]:
    """Plan, save and rehearse; return the time of flight, s, and the worst deviation, m, of 95 % of vehicles."""
    plan = cfplan.plan(cfplan.load_path(points), safety)
    plan.save(output)
    return plan.duration, cfplan.rehearse(plan).deviation


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--safety", default="safety.yaml")
    options.add_argument("--output", default="plan.parquet")
    given = options.parse_args()
    duration, deviation = plan_and_rehearse(POINTS, given.safety, given.output)
    print(f"{duration:.2f} s; {100 * deviation:.1f} cm beside the plan at most, in 95 %; saved as {given.output}")
