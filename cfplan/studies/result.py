"""The result of a study: what was run, on what and when, with its tables as data; written to JSON and read from it."""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from cfplan.errors import InputError
from cfplan.files.json_values import json_value
from cfplan.numbers import shown
from cfplan.studies.provenance import Provenance, provenance

NOTHING = "–"  # stands where there was nothing to measure
SCALE = {"ms": 1e3, "µs": 1e6, "cm": 1e2, "%": 1e2}  # from a value in SI to one in the unit
LEVELS = {"median": 0.5, "p90": 0.9, "p99": 0.99}
Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table: under which key its values stand, and how they are shown."""

    key: str
    title: str = ""  # empty: in the JSON only
    unit: str = ""  # in which a value, which is in SI, is shown
    format: str = ""  # Python's format specification
    of: str = ""  # key of the total of which this is a count
    goal: str = ""  # what it should not exceed
    meaning: str = ""  # where the title alone does not say it

    def text(self, row: Mapping[str, Any]) -> str:
        """Return the column's cell of this row."""
        value = row[self.key]
        if value is None or value == "" or (isinstance(value, float) and not math.isfinite(value)):
            return NOTHING
        if self.of:
            return f"{value}/{row[self.of]}"
        if isinstance(value, str):
            return value
        value = value * SCALE[self.unit] if self.unit in SCALE else value
        number = shown(value, self.format) if isinstance(value, float) and self.format else f"{value:{self.format}}"
        return number + (self.unit if self.unit == "×" else f" {self.unit}" if self.unit else "")


@dataclass(frozen=True, slots=True)
class Table:
    """Rows by the keys of the columns. Values are in SI; shares are fractions."""

    name: str  # by which a page of docs asks for it
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Mapping[str, Any], ...]
    across: bool = False  # shown with a column for each row, under the first column's value

    def cells(self) -> tuple[list[str], list[list[str]]]:
        """Return the titles and the cells as they are shown."""
        shown = [column for column in self.columns if column.title]
        if not self.across:
            return [column.title for column in shown], [[column.text(row) for column in shown] for row in self.rows]
        name, *figures = shown
        titles = [name.title, "goal", *(name.text(row) for row in self.rows)]
        cells = [[figure.title, figure.goal, *(figure.text(row) for row in self.rows)] for figure in figures]
        return titles, cells if self.rows else []

    def to_json(self) -> dict[str, Any]:
        """Return the table as JSON has it: each row is a list in the order of the columns."""
        return {
            "name": self.name,
            "title": self.title,
            **({"across": True} if self.across else {}),
            "columns": [{key: value for key, value in asdict(column).items() if value} for column in self.columns],
            "rows": [[json_value(row[column.key]) for column in self.columns] for row in self.rows],
        }

    @staticmethod
    def from_json(document: Mapping[str, Any]) -> "Table":
        """Return the table that `to_json` made this of."""
        columns = tuple(Column(**column) for column in document["columns"])
        keys = [column.key for column in columns]
        rows = tuple(dict(zip(keys, row, strict=True)) for row in document["rows"])
        return Table(document["name"], document["title"], columns, rows, document.get("across", False))


@dataclass(frozen=True, slots=True)
class StudyResult:
    """One run of a study."""

    study: str
    settings: Mapping[str, Any]  # what the run was asked for
    tables: tuple[Table, ...]  # those that are shown
    details: tuple[Table, ...] = ()  # what was measured one by one
    interrupted: bool = False  # by the user: holds what was measured until then
    provenance: Provenance = field(default_factory=provenance)

    def table(self, name: str) -> Table:
        """Return the table or detail of that name. Raises InputError."""
        for table in (*self.tables, *self.details):
            if table.name == name:
                return table
        known = ", ".join(table.name for table in (*self.tables, *self.details))
        raise InputError(f"the study {self.study} has no table {name!r}", hint=f"known: {known}")

    def to_json(self) -> dict[str, Any]:
        """Return the result as JSON has it; what is not finite is null."""
        return {
            "study": self.study,
            "provenance": json_value(self.provenance),
            "settings": json_value(self.settings),
            "interrupted": self.interrupted,
            "tables": [table.to_json() for table in self.tables],
            "details": [table.to_json() for table in self.details],
        }

    def write(self, file: Path) -> None:
        """Write the JSON, each row on one line."""
        file.write_text(_text(self.to_json()) + "\n", encoding="utf-8")


def read_result(file: Path) -> StudyResult:
    """Read what `StudyResult.write` wrote. Raises InputError."""
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        return StudyResult(
            study=document["study"],
            settings=document["settings"],
            tables=tuple(map(Table.from_json, document["tables"])),
            details=tuple(map(Table.from_json, document["details"])),
            interrupted=document["interrupted"],
            provenance=Provenance.from_json(document["provenance"]),
        )
    except OSError as error:
        raise InputError(
            error.strerror or str(error), where=str(file), hint="name a file that a study has written"
        ) from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"not the result of a study: {error!r}", where=str(file), hint="cfplan study … -o FILE writes one"
        ) from None


def detail_table(name: str, items: Iterable[Any]) -> Table:
    """Return a table that is in the JSON only: dictionaries or dataclasses with the same keys, a row each."""
    rows = tuple(asdict(item) if is_dataclass(item) and not isinstance(item, type) else dict(item) for item in items)
    return Table(name, "", tuple(Column(key) for key in (rows[0] if rows else ())), rows)


def quantile_columns(
    key: str, title: str, unit: str, spec: str, *, shown: Sequence[str] = ("median", "p99"), meaning: str = ""
) -> tuple[Column, ...]:
    """Return the columns of median, p90 and p99; those not to be shown are in the JSON only."""
    titles = {level: f"{title}, {level}" if level in shown else "" for level in LEVELS}
    first = next(iter(shown), "")
    return tuple(
        Column(f"{key}_{level}", titles[level], unit, spec, meaning=meaning if level == first else "")
        for level in LEVELS
    )


def collect(items: Iterator[Item]) -> tuple[list[Item], bool]:
    """Return everything that is yielded until the end or the user's interrupt, and whether there was one."""
    collected: list[Item] = []
    try:
        for item in items:
            collected.append(item)  # noqa: PERF402 (what was yielded before the interrupt stays)
    except KeyboardInterrupt:
        return collected, True
    return collected, False


def _text(value: Any, indent: str = "") -> str:
    """Write JSON so that a table's row, a column, or anything else without parts is one line."""
    deeper = indent + " "
    match value:
        case dict() if any(isinstance(item, dict | list) for item in value.values()):
            lines = [f"{deeper}{json.dumps(key)}: {_text(item, deeper)}" for key, item in value.items()]
            return "{\n" + ",\n".join(lines) + f"\n{indent}}}"
        case list() if any(isinstance(item, dict | list) for item in value):
            lines = [deeper + (_text(item, deeper) if isinstance(item, dict) else _line(item)) for item in value]
            return "[\n" + ",\n".join(lines) + f"\n{indent}]"
        case _:
            return _line(value)


def _line(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)
