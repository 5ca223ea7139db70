"""From a path file to a mission: planned, certified, encoded, rehearsed, with a way to stop from every setpoint."""

__all__ = [
    "air_planner",
    "beside",
    "certified_flight",
    "compiled_calls",
    "export_flight",
    "from_programs",
    "on_board_flight",
    "plan_flight",
    "planner_process",
    "prepare_flight",
    "replan",
    "stepped_planner",
    "steps",
]
