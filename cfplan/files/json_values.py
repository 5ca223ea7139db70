"""Values as JSON: numbers that are not finite become null, as JSON cannot write them."""

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any


def json_value(value: Any) -> Any:
    """Return the value as dictionaries, lists, text, numbers and None, from dataclasses and arrays too."""
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if is_dataclass(value):
        return {field.name: json_value(getattr(value, field.name)) for field in fields(value)}
    if hasattr(value, "tolist"):  # of NumPy, which need not be loaded for this
        return json_value(value.tolist())
    return value


def replace_surrogates(value: Any) -> Any:
    """Return a document read from JSON with `?` for each lone surrogate, which no file or terminal accepts."""
    if isinstance(value, str):
        return value.encode("utf-8", "replace").decode("utf-8")
    if isinstance(value, dict):
        return {replace_surrogates(key): replace_surrogates(item) for key, item in value.items()}
    if isinstance(value, list):
        return [replace_surrogates(item) for item in value]
    return value
