"""Trajectories that fly on board: polynomial pieces as the firmware reads them, their bytes, fit and certificate."""

__all__ = [
    "certified_pieces",
    "commands",
    "correction",
    "fall",
    "fitting",
    "go_to",
    "memory_format",
    "piece_certificate",
    "pieces",
    "program",
    "reference",
    "wait",
]
