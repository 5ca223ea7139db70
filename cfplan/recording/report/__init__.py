"""The report: a page with the figures and charts of flights."""

__all__ = ["charts", "page", "report"]
