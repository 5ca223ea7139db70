"""Baselines: the paper's TOPPQuad, convex TOPP with its lower bound, and scaled min-snap."""

__all__ = ["convex", "toppquad", "toppquad_nlp"]
