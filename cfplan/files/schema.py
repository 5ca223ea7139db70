"""Files that are read into dataclasses: their schema is the dataclass, with ranges as annotated_types."""

import math
from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel, ConfigDict, create_model

Kind = TypeVar("Kind")


class Keys(BaseModel):
    """Keys with values, all keys known, all numbers finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True, slots=True)
class InDegrees:
    """Marks an angle in rad that files give in degrees, by the same key with `_deg`, with its range in the file."""

    low: Ge | Gt  # °
    high: Le | Lt  # °


def schema_of(kind: type, **others: Any) -> type[Keys]:
    """Return the model of a file with the fields of a dataclass, with their ranges and defaults.

    Fields that are dataclasses are sections. `others` are annotations of keys that the file has instead of fields, or
    besides them, and requires; None leaves a field out.
    """
    hints = get_type_hints(kind, include_extras=True)
    keys: dict[str, Any] = {}
    for field in fields(kind):
        hint, default = hints[field.name], field.default
        if field.name in others:
            if other := others.pop(field.name):
                keys[field.name] = (other, ...)
        elif isinstance(hint, type) and is_dataclass(hint):
            section = schema_of(hint)
            keys[field.name] = (section, ... if default is MISSING else section())
        elif angle := _in_degrees(hint):
            degrees = Annotated[float, angle.low, angle.high]
            keys[f"{field.name}_deg"] = (degrees, ... if default is MISSING else math.degrees(default))
        else:
            keys[field.name] = (hint, ... if default is MISSING else default)
    keys |= {name: (hint, ...) for name, hint in others.items()}
    return create_model(f"_{kind.__name__}", __base__=Keys, **keys)


def read_as(kind: type[Kind], section: Keys, **others: Any) -> Kind:
    """Return the dataclass of a section by `schema_of`; `others` are the values of fields that are not in the file."""
    hints = get_type_hints(kind, include_extras=True)
    values: dict[str, Any] = {}
    for name in hints.keys() - others.keys():
        if _in_degrees(hints[name]):
            values[name] = math.radians(getattr(section, f"{name}_deg"))
        else:
            value = getattr(section, name)
            values[name] = read_as(hints[name], value) if is_dataclass(hints[name]) else value
    return kind(**values, **others)


def _in_degrees(hint: Any) -> InDegrees | None:
    return next((part for part in get_args(hint)[1:] if isinstance(part, InDegrees)), None)
