"""The version of cfplan, which plans, records and results are marked with."""

__version__ = "0.1.0"
