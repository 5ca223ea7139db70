"""From a path file to a mission: planned, certified, encoded, rehearsed, with a stop from every setpoint."""

__all__ = [
    "export_fleet",
    "export_flight",
    "fleet_figure",
    "from_programs",
    "link_loss_assessment",
    "on_board_fleet",
    "on_board_flight",
    "path_robustness",
    "plan_fleet",
    "plan_flight",
    "prepare_flight",
    "small_flight",
    "steps",
]
