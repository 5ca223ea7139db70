"""Baselines: the paper's TOPPQuad, convex TOPP with its lower bound, scaled min-snap."""

__all__ = ["convex", "min_snap", "toppquad", "toppquad_nlp"]
