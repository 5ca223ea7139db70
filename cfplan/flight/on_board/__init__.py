"""Trajectories that fly on board: polynomial pieces as the firmware reads them, their bytes, fit and certificate."""

__all__ = ["certified_pieces", "fitting", "memory_format", "piece_certificate", "pieces", "reference"]
