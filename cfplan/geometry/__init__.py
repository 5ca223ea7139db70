"""Geometric paths γ(s): path files, min-snap, polynomials, and random paths."""

__all__ = ["min_snap", "path", "path_file", "random_paths", "yaw"]
