"""Baselines: the paper's TOPPQuad, convex TOPP with its lower bound, scaled min-snap, corridors."""

__all__ = ["convex", "corridors", "min_snap", "toppquad", "toppquad_nlp"]
