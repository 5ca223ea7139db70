"""Text formats: YAML whose mistakes are reported with their place, tables of numbers, and values as JSON knows them.

And where files are: the nearest of a name above a folder, and what comes with cfplan.
"""

__all__ = ["json_values", "nearest", "shipped", "text", "yaml_with_places"]
