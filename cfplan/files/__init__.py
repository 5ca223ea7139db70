"""Files that people write: YAML whose mistakes are reported with their place, and text tables of numbers."""

__all__ = ["text", "yaml_with_places"]
