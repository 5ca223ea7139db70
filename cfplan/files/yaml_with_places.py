"""Read YAML files strictly: every mistake is reported with its line and column.

Only plain YAML is read: mappings, lists, words and numbers. Anchors, tags and several documents are refused, a key may
occur once, and numbers are what they look like (no `12:30` in base 60, no `yes` for true).
"""

import difflib
import json
import math
import pathlib
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError

from cfplan.errors import InputError
from cfplan.files.text import read_text

Model = TypeVar("Model", bound=BaseModel)
Location = tuple[str | int, ...]

MAX_SIZE = 200_000  # bytes, some 8,000 waypoints: YAML is read slowly, and people write a few kilobytes
HINT = "; hint: "  # between a model's own message and its hint, in the text of a ValueError
_MAX_DEPTH = 20  # of nested mappings and lists
_TAGS = {
    f"tag:yaml.org,2002:{name}"
    for name in ("map", "seq", "str", "int", "float", "bool", "null", "timestamp", "merge", "value")
}
_INTEGER = re.compile(r"[-+]?[0-9]{1,18}")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[-+]?\.?(inf|nan|infinity)", re.IGNORECASE)
_REMEDIES = {  # by the beginning of pydantic's name of a mistake
    "float": "write a plain number, as 0.5, without quotes and without a unit",
    "int": "write a whole number, as 2, without quotes",
    "bool": "write true or false",
    "string_type": "write text, in quotes where it looks like a number",
    "string": "write text of that form",
    "list": "write a list, as [0, 0, 1]",
    "tuple": "write a list, as [0, 0, 1]",
    "too_": "write a list of that length",
    "model": "write keys with values, each on a line of its own",
    "dict": "write keys with values, each on a line of its own",
    "enum": "write one of those words",
    "literal": "write one of those words",
    "greater": "choose a larger value",
    "less": "choose a smaller value",
    "missing": "write a list of that length",
}
_PARSER_WORDS = (  # a part of what the parser says, what that means, and a hint
    ("found character '\\t'", "a tab", "indent with blanks, not with tabs"),
    ("expected <block end>", "this line is not indented like those around it", "indent keys of one section alike"),
    ("expected ',' or ']'", "a list that is not closed before here", "write a comma between values, a ] at the end"),
    (
        "expected ',' or '}'",
        "braces that are not closed before here",
        "write a comma between values and a } at the end",
    ),
    ("mapping values are not allowed", "a second colon, or a line indented too far", "write one `key: value` a line"),
    ("could not find expected ':'", "a key without a colon", "write `key: value`"),
)
_WORDS = {"true": True, "false": False, "null": None, "~": None, "": None}


@dataclass(frozen=True, slots=True)
class Places:
    """The line and column of every value in a YAML file."""

    file: str
    values: dict[Location, tuple[int, int]]  # line and column, from 1, by the keys and indices that lead to the value
    keys: dict[Location, tuple[int, int]]  # the same of each key

    def where(self, *location: str | int) -> str:
        """Return `file:line:column` of a value, or of the innermost value around it."""
        return self._place(self.values, location)

    def where_key(self, *location: str | int) -> str:
        """Return `file:line:column` of the key of a value."""
        return self._place(self.keys, location)

    def _place(self, places: dict[Location, tuple[int, int]], location: Location) -> str:
        if location in places:
            line, column = places[location]
            return f"{self.file}:{line}:{column}"
        return self._place(self.values, location[:-1]) if location else self.file


def read_yaml(file: pathlib.Path | str, model: type[Model]) -> Model:
    """Read a YAML file as a pydantic model, which should forbid extra keys.

    Raises:
        InputError: a mistake in the file, with `file:line:column`.
    """
    return read_yaml_with_places(file, model)[0]


def read_yaml_with_places(
    file: pathlib.Path | str, model: type[Model], complete: Callable[[dict[str, Any]], dict[str, Any]] | None = None
) -> tuple[Model, Places]:
    """Read a YAML file as a pydantic model, and the place of each value, for mistakes that a later check finds.

    `complete` adds what the file may leave out.
    """
    text = read_text(pathlib.Path(file), most=MAX_SIZE)
    if pathlib.Path(file).suffix.lower() == ".toml":
        raise InputError("a TOML file, not YAML", where=str(file), hint="write `key: value` lines in a .yaml file")
    places = Places(str(file), {}, {})
    root = _composed(text, places.file)
    data = _plain(root, (), places)
    if not isinstance(data, dict):
        raise InputError("the file must be keys with values", where=places.where(), hint=_known(model))
    if complete is not None:
        data = complete(data)
    try:
        # By way of JSON: pydantic's strict mode then takes lists for tuples and words for enums, and nothing else
        return model.model_validate_json(json.dumps(data), strict=True), places
    except ValidationError as error:
        raise _input_error(error, model, places) from None


def read_plain(file: pathlib.Path) -> dict[str, Any]:
    """Read a YAML file of keys with values, of no certain form. Raises InputError."""
    data = _plain(_composed(read_text(file, most=MAX_SIZE), str(file)), (), Places(str(file), {}, {}))
    if not isinstance(data, dict):
        raise InputError("the file must be keys with values", where=str(file), hint="write `key: value`")
    return data


class _Loader(yaml.SafeLoader):
    """A YAML loader that refuses anchors, aliases and deep nesting."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise yaml.MarkedYAMLError(problem="anchors and aliases are not allowed", problem_mark=event.start_mark)
        self.depth += 1
        if self.depth > _MAX_DEPTH:
            raise yaml.MarkedYAMLError(problem=f"nested more than {_MAX_DEPTH} deep", problem_mark=event.start_mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def _composed(text: str, file: str) -> yaml.Node:
    try:
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        what, hint = _in_plain_words(_one_line(", ".join(filter(None, (error.context, error.problem)))))
        raise InputError(what, where=_mark(file, error), hint=hint) from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise InputError(
            f"the character {error.character!r} is not allowed in YAML",
            where=f"{file}:{line}",
            hint="save the file as UTF-8 text",
        ) from None
    if node is None:
        raise InputError("the file is empty", where=file, hint="start from a file in flights/")
    return node


def _in_plain_words(problem: str) -> tuple[str, str]:
    """Return what is wrong and a hint, of what the parser says in terms of its grammar."""
    for part, what, hint in _PARSER_WORDS:
        if part in problem:
            return what, hint
    return problem or "not YAML", "check brackets, commas and indents there and just before"


def _mark(file: str, error: yaml.MarkedYAMLError) -> str:
    mark = error.problem_mark or error.context_mark
    return f"{file}:{mark.line + 1}:{mark.column + 1}" if mark else file


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _plain(node: yaml.Node, location: Location, places: Places) -> Any:
    """Return the node as dicts, lists, words and numbers; enter the place of each into `places`."""
    places.values[location] = (node.start_mark.line + 1, node.start_mark.column + 1)
    where = places.where(*location)
    if node.tag not in _TAGS:
        raise InputError(f"the tag {node.tag} is not allowed", where=where, hint="write the value without a tag")
    if isinstance(node, yaml.MappingNode):
        return dict(_entries(node, location, places))
    if isinstance(node, yaml.SequenceNode):
        return [_plain(item, (*location, index), places) for index, item in enumerate(node.value)]
    assert isinstance(node, yaml.ScalarNode)
    return _scalar(node, where)


def _entries(node: yaml.MappingNode, location: Location, places: Places) -> Iterator[tuple[str, Any]]:
    for key, value in node.value:
        place = (key.start_mark.line + 1, key.start_mark.column + 1)
        where = f"{places.file}:{place[0]}:{place[1]}"
        if not isinstance(key, yaml.ScalarNode):
            raise InputError("a key must be a word", where=where, hint="write `key: value`")
        inner = (*location, key.value)
        if inner in places.keys:
            raise InputError(f"the key {key.value!r} occurs twice", where=where, hint="keep one of them")
        places.keys[inner] = place
        yield _checked_text(key.value, where), _plain(value, inner, places)


def _scalar(node: yaml.ScalarNode, where: str) -> Any:
    text = node.value
    if node.style is not None:
        return _checked_text(text, where)
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    if _NOT_FINITE.fullmatch(text):
        raise InputError(f"a finite number is needed, not {text}", where=where, hint="write a plain decimal number")
    if _INTEGER.fullmatch(text):
        return int(text)
    if _FLOAT.fullmatch(text):
        number = float(text)
        if not math.isfinite(number):
            raise InputError(f"the number {text[:40]} is too large", where=where, hint="write a plain decimal number")
        return number
    return _checked_text(text, where)


def _checked_text(text: str, where: str) -> str:
    if any("\ud800" <= character <= "\udfff" for character in text):
        raise InputError("half of a surrogate pair is not a character", where=where, hint="save the file as UTF-8")
    return text


def _input_error(error: ValidationError, model: type[BaseModel], places: Places) -> InputError:
    """Return the first mistake in the file, unknown keys before keys that may be missing because of them."""
    found = [_named(details, model, places) for details in error.errors(include_url=False, include_context=False)]
    _, (line, column), what, hint = min(found, key=lambda mistake: mistake[:2])
    more = len(found) - 1
    return InputError(what + (f" ({more} more)" if more else ""), where=f"{places.file}:{line}:{column}", hint=hint)


def _named(details: Any, model: type[BaseModel], places: Places) -> tuple[int, tuple[int, int], str, str]:
    """Return rank, place, message and hint of one of pydantic's errors."""
    location = _location(details["loc"], places)
    name = _dotted(location)
    place = places.values.get(location, (1, 1))
    if details["type"] == "extra_forbidden":
        owner = _model_at(model, location[:-1])
        hint = _known(owner, str(location[-1])) if owner else ""
        return 0, places.keys.get(location, (1, 1)), f"unknown key {name!r}", hint
    if details["type"] == "missing":
        missing = str(details["loc"][-1])
        owner = _model_at(model, location)
        return (
            2,
            place,
            f"the key {missing!r} is missing" + (f" in {name}" if name else ""),
            f"add `{missing}: …`" + (f"; {_known(owner)}" if owner else ""),
        )
    message, _, hint = _one_line(details["msg"].removeprefix("Value error, ")).partition(HINT)
    if not message.startswith("Input "):
        return 1, place, f"{name}: {message}" if name else message, hint or _remedy(details["type"])
    value = details["input"]
    shown = json.dumps(value, ensure_ascii=False) if isinstance(value, int | float | str | None) else ""
    unlike = f", not {shown}" if 0 < len(shown) <= 40 else ""
    return 1, place, f"{name or 'the file'} {message.removeprefix('Input ')}{unlike}", _remedy(details["type"])


def _remedy(mistake: str) -> str:
    """Return what to write instead, by pydantic's name of a mistake."""
    for beginning, remedy in _REMEDIES.items():
        if mistake.startswith(beginning):
            return remedy
    return "write another value there"


def _location(parts: tuple[str | int, ...], places: Places) -> Location:
    """Return pydantic's location without the names of union members, which are not in the file."""
    location: Location = ()
    for part in parts:
        if (*location, part) in places.values:
            location = (*location, part)
    return location


def _dotted(location: Location) -> str:
    text = ""
    for part in location:
        text += f" item {part + 1}" if isinstance(part, int) else f".{part}" if text else part
    return text


def _model_at(model: type[BaseModel], location: Location) -> type[BaseModel] | None:
    for part in location:
        if isinstance(part, int):
            continue
        field = model.model_fields.get(part) or next((f for f in model.model_fields.values() if f.alias == part), None)
        inner = next(_models(field.annotation), None) if field else None
        if inner is None:
            return None
        model = inner
    return model


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models(argument)


def _known(model: type[BaseModel], near: str = "") -> str:
    keys = [field.alias or name for name, field in model.model_fields.items()]
    close = difflib.get_close_matches(near, keys, n=1)
    return (f"did you mean {close[0]!r}? " if close else "") + f"known keys: {', '.join(keys)}"
