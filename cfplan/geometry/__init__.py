"""Geometric paths γ(s): path files, min-snap, polynomial files, random paths at rest at both ends; continued paths."""

__all__ = [
    "banded",
    "continued",
    "guides",
    "min_snap",
    "min_snap_gradient",
    "path",
    "path_families",
    "path_file",
    "polynomial_csv",
    "polynomials",
    "random_paths",
    "waypoints",
    "yaw",
]
