"""Files as text: YAML that remembers places, and tables of numbers, whatever they say."""

__all__ = ["text", "yaml_with_places"]
