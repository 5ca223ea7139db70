"""Text formats: YAML whose mistakes are reported with their place, tables of numbers, and values as JSON knows them.

And schemas of files that are read into dataclasses; where files are: the nearest of a name above a folder, what comes
with cfplan, and atomic writing of new ones.
"""

__all__ = ["atomic", "json_values", "nearest", "schema", "shipped", "suffixes", "text", "yaml_with_places"]
