"""Studies of cfplan: each measures one thing, makes one result with its tables, and is one command.

Run one with `python -m studies NAME`. Studies need a checkout; cfplan itself needs none of them.
"""

STUDIES = {
    name.rpartition(".")[2].replace("_", "-"): f"studies.{name}"
    for name in (
        "blind_link_loss", "dry_runs", "exports", "faults", "fleet_faults", "fleet_flights", "fleets", "flights",
        "giving_way", "horizon", "identification", "lateness", "latency", "link_loss", "physics", "planners",
        "random_faults", "real_flights", "second_flights", "steering", "stops", "waypoints",
        "paper.architectures", "paper.baselines", "paper.hardware", "paper.inputs", "paper.labels",
        "paper.robustness", "paper.search", "paper.simulators", "paper.yaw_consistency",
    )
}  # fmt: skip
"""The module of each study by its name on the command line."""

COMMANDS = dict.fromkeys(("figures", "networks", "paper"), "studies.paper.commands")
"""The module of each other command by its name there."""
