"""Text formats: YAML whose mistakes are reported with their place, tables of numbers, and values as JSON knows them."""

__all__ = ["json_values", "nearest", "text", "yaml_with_places"]
