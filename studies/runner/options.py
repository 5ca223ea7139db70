"""Command-line options of a study, derived from the dataclass of its settings."""

from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, field, fields
from enum import StrEnum
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import click

_HELP, _CHOICES, _LEAST, _ARGUMENT = "help", "choices", "least", "argument"  # keys in a field's metadata


def option(default: Any, text: str, *, least: float | None = None, choices: tuple[str, ...] = ()) -> Any:
    """Return a dataclass field that becomes an option, with its default, help, least value and choices.

    An option with a tuple as default is repeatable; `least` and `choices` apply to each value.
    """
    return field(default=default, metadata={_HELP: text, _LEAST: least, _CHOICES: choices})


def argument() -> Any:
    """Return a dataclass field that becomes an argument; a tuple takes one or more values."""
    return field(metadata={_ARGUMENT: True})


def parameters(settings: type) -> Iterator[Callable[[Callable[..., Any]], Callable[..., Any]]]:
    """Yield the decorators that add the options and arguments of `settings` to a command, in order."""
    hints = get_type_hints(settings)
    for each in fields(settings):
        yield _parameter(each, hints[each.name])


def _parameter(each: Field, hint: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    if get_origin(hint) is UnionType:  # T | None
        hint = get_args(hint)[0]
    several = get_origin(hint) is tuple
    kind = get_args(hint)[0] if several else hint
    if each.metadata.get(_ARGUMENT):
        name = each.name.removesuffix("_files").removesuffix("_file").upper()
        return click.argument(each.name, metavar=f"{name}..." if several else name, type=_type(kind, each),
                              nargs=-1 if several else 1, required=True)  # fmt: skip
    default = None if each.default is MISSING else each.default
    default = default.value if isinstance(default, StrEnum) else default
    text, spelled = each.metadata[_HELP], "--" + _singular(each.name, several).replace("_", "-")
    if kind is bool:
        return click.option(spelled, each.name, is_flag=True, help=text)
    if several:
        usual = ", ".join(map(str, default or ()))
        text += "  May be given several times." + (f"  [default: {usual}]" if usual else "")
        return click.option(spelled, each.name, type=_type(kind, each), multiple=True, help=text)
    return click.option(
        spelled, each.name, type=_type(kind, each), default=default, show_default=default not in (None, ""), help=text
    )


def _singular(name: str, several: bool) -> str:
    return {"boxes": "box", "only": "only"}.get(name, name.removesuffix("s")) if several else name


def _type(kind: type, each: Field) -> click.ParamType:
    least, choices = each.metadata.get(_LEAST), each.metadata.get(_CHOICES)
    if choices:
        return click.Choice(choices)
    if kind is Path:
        return click.Path(path_type=Path)
    if issubclass(kind, StrEnum):
        return click.Choice([each.value for each in kind])
    if kind is int:
        return click.INT if least is None else click.IntRange(int(least))
    if kind is float:
        return click.FLOAT if least is None else click.FloatRange(least)
    return click.STRING


def settings_of(settings: type, given: dict[str, Any]) -> Any:
    """Return the settings for a command's parameters; options that were left out keep their defaults."""
    hints = get_type_hints(settings)
    chosen = {}
    for each in fields(settings):
        value = given[each.name]
        if value == () and not each.metadata.get(_ARGUMENT):
            continue
        kind = hints[each.name]
        chosen[each.name] = kind(value) if isinstance(kind, type) and issubclass(kind, StrEnum) else value
    return settings(**chosen)
