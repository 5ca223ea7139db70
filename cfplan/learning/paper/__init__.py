"""The paper's networks, trained as the paper trains them: from sequences of a path's derivatives to h and cos ψ."""

__all__ = ["bayesian_times", "networks", "recovery", "sequences", "time_allocation", "training"]
