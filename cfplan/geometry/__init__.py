"""Geometric paths γ(s): path files, min-snap, polynomial files, random paths, and continued paths."""

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
