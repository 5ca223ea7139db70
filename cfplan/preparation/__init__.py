"""From a path file to a mission: planned, certified, encoded, rehearsed, with a way to stop from every setpoint."""

__all__ = [
    "air_planner",
    "beside",
    "certified_flight",
    "export_flight",
    "from_programs",
    "lead",
    "on_board_flight",
    "path_robustness",
    "plan_flight",
    "planner_process",
    "planner_worker",
    "prepare_flight",
    "proposal_chain",
    "replan",
    "request_queue",
    "small_flight",
    "stepped_planner",
    "steps",
]
