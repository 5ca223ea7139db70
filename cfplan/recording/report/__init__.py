"""The report: a page with a flight's figures and charts."""

__all__ = ["page", "report"]
