"""Geometric paths γ(s): path files, min-snap, polynomial files, random paths; all at rest at both ends."""

__all__ = ["min_snap", "path", "path_file", "random_paths", "yaw"]
