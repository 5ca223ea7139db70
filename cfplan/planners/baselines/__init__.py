"""Baselines: the paper's TOPPQuad, convex TOPP with its lower bound, scaled min-snap, a point mass."""

__all__ = ["convex", "min_snap", "point_mass", "toppquad", "toppquad_nlp"]
