"""Simulated flight: dynamics, the virtual Crazyflie and Vicon, the lab, the dry run and link loss."""

__all__ = [
    "dry_run",
    "dynamics",
    "geometric_flight",
    "glitches",
    "lab",
    "left_alone",
    "link_loss",
    "on_board_run",
    "other_bodies",
    "virtual_crazyflie",
    "virtual_vicon",
]
