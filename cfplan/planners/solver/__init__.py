"""The interior point method: a primal-dual solver for banded nonlinear programs."""

__all__ = ["barrier", "interior_point"]
