"""Values of wrong kinds, wherever they stand in a file: each is an error with its place and a hint, or is read."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cfplan.errors import CfplanError
from cfplan.geometry.path_file import load_path_file
from cfplan.learning.dataset_spec import load_spec
from cfplan.learning.model_files import load_card
from cfplan.planning.plan_file import load_plan
from cfplan.recording.header import header_from_json, header_to_json
from cfplan.recording.importers.formats import read_log
from cfplan.safety.limits_file import load_limits
from cfplan.vehicle.airframes import AIRFRAMES, load_airframe
from tests.fuzzing import files as fuzzing
from tests.learning.conftest import TINY, card
from tests.recording import conftest as flight
from tests.recording.importers import test_import_logs as logs
from tests.recording.importers import test_import_vicon as vicon

REPOSITORY = Path(__file__).parents[1]
LOOKALIKES = ["1", "1.5", "nan", "yes", "~", "2026-01-01", "12:30", "\x1b[2J"]
words = st.one_of(st.text(max_size=8), st.sampled_from(LOOKALIKES))
values = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), words),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(words, inner, max_size=3)),
    max_leaves=6,
)
quickly = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


def plain(value: Any) -> Any:
    return json.loads(json.dumps(value))


def yaml_of(tree: Any) -> str:
    return yaml.safe_dump(tree, allow_unicode=False, sort_keys=False)


def read_plan(file: Path) -> None:
    """Read a plan with this metadata."""
    import pyarrow.parquet as pq

    table = plan_table(file.parent)
    pq.write_table(table.replace_schema_metadata({b"cfplan": file.read_bytes()}), file.with_suffix(".parquet"))
    load_plan(file.with_suffix(".parquet"))


PLAN: dict[str, Any] = {}


def plan_table(folder: Path) -> Any:
    if not PLAN:
        PLAN["table"] = fuzzing._plan(folder)
    return PLAN["table"]


def plan_metadata(folder: Path) -> Any:
    return json.loads(plan_table(folder).schema.metadata[b"cfplan"])


TREES = {
    "path": ("path.yaml", lambda _: yaml.safe_load((REPOSITORY / "flights/line.yaml").read_text()), load_path_file),
    "yaw": (
        "path.yaml",
        lambda _: {"waypoints": [[0, 0, 1], [1, 0, 1]], "yaw": {"mode": "fixed", "angle_deg": 3}, "place": {"x": 1}},
        load_path_file,
    ),
    "safety": ("safety.yaml", lambda _: yaml.safe_load((REPOSITORY / "safety.yaml").read_text()), load_limits),
    "airframe": ("own.yaml", lambda _: plain(asdict(AIRFRAMES["crazyflie-2.1+"])), load_airframe),
    "dataset": ("dataset.json", lambda _: plain(asdict(TINY)), lambda file: load_spec(file.parent)),
    "model": ("card.json", lambda _: plain(asdict(card())), lambda file: load_card(file.parent)),
    "record": (
        "header.json",
        lambda _: json.loads(header_to_json(flight.header())),
        lambda file: header_from_json(file.read_text(), where=str(file)),
    ),
    "plan": ("plan.json", plan_metadata, read_plan),
}


def places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Yield (mapping or list, key or index) of every value, of long lists the first three."""
    entries = list(tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ())
    for key, value in entries if isinstance(tree, dict) else entries[:3]:
        yield tree, key
        yield from places(value)


def check(read: Any, file: Path) -> None:
    error = refusal(read, file)
    if error is not None:
        assert error.hint
        assert str(file.parent) in error.where


def refusal(read: Any, file: Path) -> CfplanError | None:
    try:
        read(file)
    except CfplanError as error:
        return error
    return None


@pytest.mark.parametrize("kind", TREES)
@quickly
@given(data=st.data(), value=values)
def test_a_value_of_a_wrong_kind_is_refused_with_a_hint(tmp_path, kind, data, value):
    name, sound, read = TREES[kind]
    tree = plain(sound(tmp_path))
    holder, key = data.draw(st.sampled_from(list(places(tree))))
    holder[key] = value
    file = tmp_path / name
    file.write_text(yaml_of(tree) if name.endswith("yaml") else json.dumps(tree))
    check(read, file)


def vicon_csv(folder: Path) -> str:
    return vicon.write(folder / "vicon.csv", {"swift": ("quaternion", vicon.poses(count=5))}).read_text()


def read_table(key: str) -> Any:
    def read(file: Path) -> None:
        (file.parent / "path.yaml").write_text(f"{key}: {file.name}\n")
        load_path_file(file.parent / "path.yaml")

    return read


TABLES = SimpleNamespace(
    points=(lambda _: (REPOSITORY / "flights/circle.csv").read_text(), read_table("points")),
    polynomials=(lambda _: (REPOSITORY / "flights/helix.csv").read_text(), read_table("polynomials")),
    crazyswarm=(lambda _: logs.swarm(), read_log),
    vicon=(vicon_csv, read_log),
)


@pytest.mark.parametrize("kind", vars(TABLES))
@quickly
@given(data=st.data(), word=words)
def test_a_cell_of_a_wrong_kind_is_refused_with_a_hint(tmp_path, kind, data, word):
    sound, read = getattr(TABLES, kind)
    lines = sound(tmp_path).splitlines()
    row = data.draw(st.integers(0, min(len(lines), 12) - 1))
    cells = lines[row].split(",")
    cells[data.draw(st.integers(0, len(cells) - 1))] = word
    lines[row] = ",".join(cells)
    file = tmp_path / "table.csv"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    check(read, file)
