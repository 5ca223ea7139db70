"""Plans survive being written and read, and nothing else is taken for a plan."""

import json
import math
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import cfplan
from cfplan.errors import InputError
from cfplan.planning.plan import plan
from cfplan.planning.plan_file import load_plan, save_plan
from cfplan.planning.plan_result import LocalSlowing
from cfplan.safety.certificate import CAPPED_SPEED
from cfplan.safety.speed_caps import SpeedCaps


@pytest.fixture(scope="module")
def made(path, limits):
    return plan(path, limits.airframe, limits, planner="minsnap", speed_factor=0.9)


@pytest.fixture(scope="module")
def saved(made, tmp_path_factory):
    file = tmp_path_factory.mktemp("plans") / "plan.parquet"
    save_plan(made, file, {"path file": "loop.yaml"})
    return file


def rewritten(saved, target, change):
    """The same file with changed metadata."""
    table = pyarrow.parquet.read_table(saved)
    metadata = json.loads(table.schema.metadata[b"cfplan"])
    change(metadata)
    pyarrow.parquet.write_table(table.replace_schema_metadata({b"cfplan": json.dumps(metadata).encode()}), target)
    return target


def test_what_is_loaded_is_what_was_saved(made, saved):
    loaded = load_plan(saved)
    assert loaded.limits == made.limits
    assert loaded.airframe == made.airframe
    assert loaded.certificate == made.certificate
    assert (loaded.planner, loaded.nodes, loaded.repair_speed_factor, loaded.speed_factor, loaded.notes) == (
        made.planner, made.nodes, made.repair_speed_factor, made.speed_factor, made.notes,
    )  # fmt: skip
    times = np.linspace(0, made.trajectory.duration, 100)
    for name in ("position", "motor_thrust", "quaternion", "angular_acceleration"):
        np.testing.assert_array_equal(
            getattr(loaded.trajectory.at(times), name), getattr(made.trajectory.at(times), name)
        )


def test_where_windows_meet_is_kept_and_older_files_tell_of_none(made, saved, tmp_path):
    joints = (made.path.end / 3, made.path.end / 2)
    save_plan(replace(made, joints=joints), tmp_path / "chained.parquet")
    assert load_plan(tmp_path / "chained.parquet").joints == joints
    older = rewritten(saved, tmp_path / "older.parquet", lambda metadata: metadata.pop("joints"))
    assert load_plan(older).joints == ()


@pytest.mark.parametrize("joint", [0.0, -1.0, 1e3, math.nan])
def test_a_joint_outside_the_path_is_no_sound_plan(saved, tmp_path, joint):
    file = rewritten(saved, tmp_path / "p.parquet", lambda metadata: metadata["joints"].append(joint))
    with pytest.raises(InputError, match="joint"):
        load_plan(file)


@pytest.fixture(scope="module")
def slowed(made):
    caps = SpeedCaps.of(made.profile.s, np.full(len(made.profile.s), 5.0))
    return replace(made, slowing=LocalSlowing(caps, 0.9 * made.trajectory.duration, ("link loss near a wall",)))


def test_where_a_plan_is_slower_is_kept_and_certified_and_older_files_tell_of_nothing(slowed, saved, tmp_path):
    save_plan(slowed, tmp_path / "slowed.parquet")
    loaded = load_plan(tmp_path / "slowed.parquet")
    assert loaded.slowing == slowed.slowing
    assert loaded.certificate.margins[-1].name == CAPPED_SPEED
    assert loaded.describe_slowing() == "11.1 % slower for link loss near a wall"
    older = load_plan(rewritten(saved, tmp_path / "older.parquet", lambda metadata: metadata.pop("slowing")))
    assert older.slowing is None
    assert (older.time_lost, older.describe_slowing()) == (0.0, "")


@pytest.mark.parametrize(
    "change",
    [
        lambda slowing: slowing.pop("caps"),
        lambda slowing: slowing.update(before=-1.0),
        lambda slowing: slowing.update(before=None),
        lambda slowing: slowing.update(reasons=[]),
        lambda slowing: slowing.update(reasons=3),
        lambda slowing: slowing["caps"]["s"].append(1e6),
        lambda slowing: slowing["caps"]["s"].__setitem__(-1, 1e6),
        lambda slowing: slowing["caps"]["speed"].__setitem__(2, 0.0),
        lambda slowing: slowing["caps"]["speed"].__setitem__(2, math.nan),
        lambda slowing: slowing["caps"].update(s=[[0.0]], speed=[[1.0]]),
    ],
)
def test_slowing_that_is_not_sound_makes_no_plan(slowed, tmp_path, change):
    save_plan(slowed, tmp_path / "slowed.parquet")
    file = rewritten(tmp_path / "slowed.parquet", tmp_path / "p.parquet", lambda metadata: change(metadata["slowing"]))
    with pytest.raises(InputError) as error:
        load_plan(file)
    assert "\n" not in str(error.value)


def test_a_limit_that_is_left_open_stays_open(made, limits, tmp_path):
    opened = replace(made, limits=replace(limits, plan=replace(limits.plan, speed=math.inf)))
    save_plan(opened, tmp_path / "open.parquet")
    assert load_plan(tmp_path / "open.parquet").limits == opened.limits


def test_any_parquet_reader_sees_the_flight_and_its_provenance(made, saved):
    table = pyarrow.parquet.read_table(saved)
    metadata = json.loads(table.schema.metadata[b"cfplan"])
    assert metadata["version"] == cfplan.__version__
    assert metadata["provenance"] == {"path file": "loop.yaml"}
    assert metadata["certificate"]["passed"] is True
    assert table["time"][-1].as_py() == made.trajectory.duration
    positions = np.column_stack([table[f"position_{axis}"] for axis in "xyz"])
    np.testing.assert_array_equal(positions, made.trajectory.at(table["time"].to_numpy()).position)
    assert {"quaternion_w", "motor_thrust_4", "specific_thrust"} <= set(table.column_names)


def test_the_page_for_programs_has_every_column(saved):
    page = (Path(__file__).parents[2] / "docs" / "python.md").read_text()
    for column in pyarrow.parquet.read_schema(saved).names:
        assert re.search(rf"`{re.sub('_(x|y|z|w|[1-4])$', '_', column)}", page), column


def test_a_plan_is_certified_anew_and_not_taken_at_its_word(saved, tmp_path):
    def tighten(metadata):
        metadata["limits"]["plan"]["speed"] = 0.1

    assert not load_plan(rewritten(saved, tmp_path / "p.parquet", tighten)).certificate.passed


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda m: m.update(format=99), "format 99"),
        (lambda m: m.pop("profile"), "'profile' is missing"),
        (lambda m: m["profile"].pop("dddh"), "'dddh' is missing"),
        (lambda m: m["profile"]["h"].__setitem__(3, -1.0), "falls to zero"),
        (lambda m: m["profile"]["h"].__setitem__(3, None), "not finite"),
        (lambda m: m["profile"]["h"].__setitem__(3, "x"), "not a sound plan"),
        (lambda m: m["profile"].update(h=[1.0, 2.0]), "values of h"),
        (lambda m: m["path"]["coefficients"].pop(), "do not make a path"),
        (lambda m: m["path"]["coefficients"][0][1].__setitem__(0, 0.01), "jumps by 0.01"),
        (lambda m: m["airframe"].update(mass="heavy"), "not a sound plan"),
        (lambda m: m["airframe"].update(mass=0.04), "are not those of its plan"),
        (lambda m: m["limits"].pop("space"), "not a sound plan"),
        (lambda m: m.update(nodes=None), "not a sound plan"),
    ],
)
def test_a_plan_that_is_at_odds_with_itself_is_refused(saved, tmp_path, change, said):
    file = rewritten(saved, tmp_path / "p.parquet", change)
    with pytest.raises(InputError, match=said) as error:
        load_plan(file)
    assert error.value.where == str(file)
    assert "\n" not in str(error.value)


def test_metadata_nested_too_deep_is_refused(saved, tmp_path):
    table, file = pyarrow.parquet.read_table(saved), tmp_path / "deep.parquet"
    pyarrow.parquet.write_table(table.replace_schema_metadata({b"cfplan": b"[" * 20_000 + b"]" * 20_000}), file)
    with pytest.raises(InputError, match="not a sound plan"):
        load_plan(file)


def test_a_file_of_another_kind_is_refused(tmp_path):
    file = tmp_path / "other.parquet"
    pyarrow.parquet.write_table(pyarrow.table({"x": [1.0]}), file)
    with pytest.raises(InputError, match="not a plan of cfplan"):
        load_plan(file)
    with pytest.raises(InputError, match="no such file"):
        load_plan(tmp_path / "none.parquet")
    with pytest.raises(InputError):
        load_plan(tmp_path)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 0.999), noise=st.binary(max_size=20))
def test_a_truncated_or_damaged_file_is_refused_in_one_line(saved, tmp_path, share, noise):
    content = saved.read_bytes()
    file = tmp_path / "cut.parquet"
    file.write_bytes(content[: int(share * len(content))] + noise)
    with pytest.raises(InputError) as error:
        load_plan(file)
    assert "\n" not in str(error.value)


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(made, saved, tmp_path, monkeypatch):
    target = tmp_path / "plan.parquet"
    target.write_bytes(b"old")

    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pyarrow.parquet, "write_table", full)
    with pytest.raises(InputError, match="No space left on device"):
        save_plan(made, target)
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["plan.parquet"]


def test_a_folder_that_does_not_exist_is_named(made, tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        save_plan(made, tmp_path / "nowhere" / "plan.parquet")
