"""The result of a study: settings, provenance, and tables as data, with reading and writing of JSON."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from cfplan.errors import InputError
from cfplan.files.json_values import json_value
from cfplan.numbers import shown
from studies.runner.provenance import Provenance
from studies.runner.reductions import Reduction, Value, quantile

NOTHING = "–"  # shown for a value that was not measured
SCALE = {"ms": 1e3, "µs": 1e6, "cm": 1e2, "%": 1e2}  # factor from SI to the unit
LEVELS = {"median": 0.5, "p90": 0.9, "p99": 0.99}
ITEMS = "items"  # folder beside the results for the rows of the cases


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table: how the rows of a group are reduced to a value, and how that is shown."""

    key: str
    title: str = ""  # empty: the column is only in the JSON
    unit: str = ""  # in which the value, stored in SI units, is shown
    format: str = ""  # Python's format specification
    of: str = ""  # key of the column with the total of this count
    goal: str = ""  # target, as text
    meaning: str = ""  # explanation, where the title alone is not enough
    value: Reduction | None = None  # of the group's rows; None: the field `key` of its first row

    def text(self, row: Mapping[str, Any]) -> str:
        """Return the text of this column's cell in a row."""
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
    """A table: each row maps the columns' keys to values in SI units, with percentages as fractions."""

    name: str  # by which a page of the docs refers to it
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Mapping[str, Any], ...]
    across: bool = False  # transposed: one column per row, headed by its first cell

    def cells(self) -> tuple[list[str], list[list[str]]]:
        """Return the titles and the cells as shown."""
        shown = [column for column in self.columns if column.title]
        if not self.across:
            return [column.title for column in shown], [[column.text(row) for column in shown] for row in self.rows]
        name, *figures = shown
        titles = [name.title, "goal", *(name.text(row) for row in self.rows)]
        cells = [[figure.title, figure.goal, *(figure.text(row) for row in self.rows)] for figure in figures]
        return titles, cells if self.rows else []

    def to_json(self) -> dict[str, Any]:
        """Return the table for JSON: each row is a list in the order of the columns."""
        return {
            "name": self.name,
            "title": self.title,
            **({"across": True} if self.across else {}),
            "columns": [_column_json(column) for column in self.columns],
            "rows": [[json_value(row[column.key]) for column in self.columns] for row in self.rows],
        }

    @staticmethod
    def from_json(document: Mapping[str, Any]) -> "Table":
        """Return the table from the output of `to_json`."""
        columns = tuple(Column(**column) for column in document["columns"])
        keys = [column.key for column in columns]
        rows = tuple(dict(zip(keys, row, strict=True)) for row in document["rows"])
        return Table(document["name"], document["title"], columns, rows, document.get("across", False))


def _column_json(column: Column) -> dict[str, str]:
    return {
        each.name: value for each in fields(column) if each.name != "value" and (value := getattr(column, each.name))
    }


def table(
    name: str,
    title: str,
    columns: Sequence[Column],
    rows: Sequence[Any],
    *,
    by: Sequence[str] | None = None,
    last: str = "",
    across: bool = False,
) -> Table:
    """Return a table of rows, dataclasses or mappings, with one line per group of rows.

    Rows of a group agree in the fields `by`; None: each row is a group. `last` names an additional line for all rows.
    """
    groups: dict[Any, list[Any]] = {}
    for number, row in enumerate(rows):
        groups.setdefault(number if by is None else tuple(_field(row, key) for key in by), []).append(row)
    lines = [_line(columns, group) for group in groups.values()]
    if last and rows:
        lines.append(_line(columns, rows) | {columns[0].key: last})
    return Table(name, title, tuple(columns), tuple(lines), across)


def _line(columns: Sequence[Column], group: Sequence[Any]) -> dict[str, Any]:
    return {each.key: each.value(group) if each.value else _field(group[0], each.key) for each in columns}


def _field(row: Any, key: str) -> Any:
    return row[key] if isinstance(row, Mapping) else getattr(row, key)


def quantile_columns(
    key: str, title: str, unit: str, spec: str, value: Value | None = None, *,
    shown: Sequence[str] = ("median", "p99"), meaning: str = "",
) -> tuple[Column, ...]:  # fmt: skip
    """Return columns of median, p90 and p99 of a value, by default the field `key`; those not in `shown` are hidden."""
    titles = {level: f"{title}, {level}" if level in shown else "" for level in LEVELS}
    first = next(iter(shown), "")
    return tuple(
        Column(f"{key}_{level}", titles[level], unit, spec, meaning=meaning if level == first else "",
               value=quantile(value or key, LEVELS[level]))
        for level in LEVELS
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class StudyResult:
    """One run of a study."""

    study: str
    settings: Mapping[str, Any]  # options and arguments of the run
    tables: tuple[Table, ...]
    rows: Sequence[Any] = ()  # measured case by case; not in the JSON
    interrupted: bool = False  # by the user or --minutes: only the cases measured before are included
    seconds: float = 0.0  # s of processor time to measure the cases
    provenance: Provenance | None = None

    def table(self, name: str) -> Table:
        """Return the table of this name. Raises InputError if there is none."""
        for each in self.tables:
            if each.name == name:
                return each
        known = ", ".join(each.name for each in self.tables)
        raise InputError(f"the study {self.study} has no table {name!r}", hint=f"known: {known}")

    def to_json(self) -> dict[str, Any]:
        """Return the result for JSON; numbers that are not finite become null."""
        return {
            "study": self.study,
            "provenance": json_value(self.provenance),
            "settings": json_value(self.settings),
            "interrupted": self.interrupted,
            "seconds": self.seconds,
            "tables": [each.to_json() for each in self.tables],
        }

    def write(self, file: Path) -> None:
        """Write the JSON, one line per row, and the rows of the cases as Parquet in a folder beside it."""
        file.write_text(_text(self.to_json()) + "\n", encoding="utf-8")
        if self.rows:
            _write_rows(self.rows, file.parent / ITEMS / f"{file.stem}.parquet")


def _write_rows(rows: Iterable[Any], file: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    file.parent.mkdir(exist_ok=True)
    plain = [dict(row) if isinstance(row, Mapping) else asdict(row) for row in rows]
    pq.write_table(pa.Table.from_pylist(plain), file)


def read_result(file: Path) -> StudyResult:
    """Read a result written by `StudyResult.write`, without the rows of the cases. Raises InputError."""
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        return StudyResult(
            study=document["study"],
            settings=document["settings"],
            tables=tuple(map(Table.from_json, document["tables"])),
            interrupted=document["interrupted"],
            seconds=document.get("seconds", 0.0),
            provenance=Provenance.from_json(document["provenance"]),
        )
    except OSError as error:
        raise InputError(
            error.strerror or str(error), where=str(file), hint="name a file that a study has written"
        ) from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"not the result of a study: {error!r}", where=str(file), hint="python -m studies NAME -o FILE writes one"
        ) from None


def _text(value: Any, indent: str = "") -> str:
    """Return JSON in which a table's row, a column, and any other value without nested containers is one line."""
    deeper = indent + " "
    match value:
        case dict() if any(isinstance(item, dict | list) for item in value.values()):
            lines = [f"{deeper}{json.dumps(key)}: {_text(item, deeper)}" for key, item in value.items()]
            return "{\n" + ",\n".join(lines) + f"\n{indent}}}"
        case list() if any(isinstance(item, dict | list) for item in value):
            lines = [deeper + (_text(item, deeper) if isinstance(item, dict) else _dumped(item)) for item in value]
            return "[\n" + ",\n".join(lines) + f"\n{indent}]"
        case _:
            return _dumped(value)


def _dumped(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)
