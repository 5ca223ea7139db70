"""Simulated flight: the simulator's engine, the virtual Crazyflie and Vicon, the lab, the dry run and link loss."""

__all__ = [
    "draws",
    "dry_run",
    "engine",
    "geometric_flight",
    "glitches",
    "lab",
    "link_loss",
    "on_board_run",
    "other_bodies",
    "virtual_crazyflie",
    "virtual_vicon",
]
