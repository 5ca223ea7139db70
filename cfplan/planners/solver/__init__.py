"""A primal-dual interior point method for banded nonlinear programs."""

__all__ = ["barrier", "interior_point"]
