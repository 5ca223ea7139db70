"""Datasets: the same rows whoever makes them, nothing lost when the making stops, failures as rows."""

import errno
import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfplan.errors import CfplanError, InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path as Curve
from cfplan.geometry.path_families import Family
from cfplan.geometry.path_file import PathShape
from cfplan.geometry.yaw import YawMode
from cfplan.learning import dataset
from cfplan.learning.dataset import describe, label_shard, make_dataset, read_dataset, read_timing
from cfplan.learning.dataset_spec import DatasetSpec, Labeller, Relabel, load_spec
from cfplan.learning.labels import row_limits, row_path
from cfplan.learning.workers import SchedulerError, pool
from cfplan.planning.path.search import fastest_by_search
from cfplan.safety.feasibility import infeasible_limit
from cfplan.vehicle.airframes import AIRFRAMES

SMALL = DatasetSpec(
    count=6,
    seed=3,
    limits="hardware",
    families=(),
    boxes=((4.5, 8.0, 2.0),),
    waypoints=(2, 3),
    nodes=40,
    yaw=YawMode.FIXED,
    shard_rows=2,
)


def shard_bytes(folder: Path) -> dict[str, bytes]:
    """The files of the rows."""
    return {file.name: file.read_bytes() for file in sorted((folder / "shards").iterdir())}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The small dataset, made by one worker."""
    folder = tmp_path_factory.mktemp("made")
    make_dataset(folder, SMALL)
    return folder


def test_rows_hold_path_grid_label_and_provenance(made):
    spec, rows = read_dataset(made)
    assert spec == SMALL
    assert rows["row"].to_pylist() == list(range(6))
    for row in rows.to_pylist():
        assert row["status"] == "SOLVED"
        assert row["airframe"]["name"] == "crazyflie-2.1+"
        assert row["limits"]["speed"] == 2.0
        assert (row["family"], row["yaw_mode"], row["yaw_angle"]) == ("box", "fixed", 0.0)
        assert row["seed"] == 3
        assert len(row["h"]) == len(row["yaw"]) == row["nodes"] + 1 == 41
        assert 0 < row["certified_share"] <= 1
        stored = Curve(np.array(row["breaks"]), np.array(row["coefficients"]).reshape(len(row["breaks"]) - 1, -1, 3))
        s = np.linspace(0, row["end"], 17)
        np.testing.assert_array_equal(stored(s), row_path(SMALL, row["row"])(s))


def test_limits_vehicles_and_paths_are_drawn_by_seed_and_number():
    """Whatever else is made: any worker draws the same for a row."""
    spec = DatasetSpec(count=300, seed=4)
    drawn = [row_limits(spec, number) for number in range(300)]
    assert drawn[:20] == [row_limits(replace(spec, count=20), number) for number in range(20)]
    assert drawn != [row_limits(replace(spec, seed=5), number) for number in range(300)]
    limits = [chosen.limits for chosen, _, _ in drawn]
    speeds = np.array([each.speed for each in limits])
    assert speeds.min() < 0.5
    assert speeds.max() > 6.0
    assert {mode for _, mode, _ in drawn} == set(YawMode)
    masses = {chosen.airframe.mass for chosen, _, _ in drawn}
    assert {airframe.mass for airframe in AIRFRAMES.values()} < masses
    assert len(masses) > 150
    for chosen, _, _ in drawn:
        assert not infeasible_limit(chosen.airframe, chosen.limits)
        if chosen.airframe.name == "made up":
            jx, jy, jz = sorted(chosen.airframe.inertia)
            assert jz <= jx + jy  # as of a rigid body


def test_every_family_makes_paths_that_can_be_flown():
    spec = DatasetSpec(count=120, seed=2)
    bad = 0
    for number in range(120):
        try:
            row_path(spec, number).check()
        except InputError:
            bad += 1
    assert bad <= 3


def test_drawn_rows_hold_what_they_were_planned_for(tmp_path):
    """Each label keeps its own row's limits on speed and acceleration, by the path's derivatives."""
    make_dataset(tmp_path, DatasetSpec(count=12, seed=11, nodes=60))
    rows = read_dataset(tmp_path)[1].to_pylist()
    assert {row["family"] for row in rows} == set(Family)
    solved = [row for row in rows if row["status"] == "SOLVED" and row["certified_share"] == 1.0]
    assert len(solved) >= 9
    for row in solved:
        path = Curve(np.array(row["breaks"]), np.array(row["coefficients"]).reshape(len(row["breaks"]) - 1, -1, 3))
        s, h = np.linspace(0, row["end"], 61), np.array(row["h"])
        speed = np.linalg.norm(path(s, 1), axis=1) * np.sqrt(h)
        bends = path(s, 2) * h[:, None] + 0.5 * path(s, 1) * np.array(row["dh"])[:, None]
        assert speed.max() <= row["limits"]["speed"] * (1 + 1e-6)
        assert np.linalg.norm(bends, axis=1).max() <= row["limits"]["acceleration"] * (1 + 1e-6)
        assert max(speed.max() / row["limits"]["speed"], len(row["active_limits"]) / 10) > 0.05


def test_limits_of_a_safety_file_are_kept_in_the_spec(tmp_path, limits):
    spec = replace(SMALL, count=1, limits="given", airframe=limits.airframe, plan=replace(limits.plan, speed=1.5))
    make_dataset(tmp_path, spec)
    assert load_spec(tmp_path) == spec
    (row,) = read_dataset(tmp_path)[1].to_pylist()
    assert row["limits"]["speed"] == 1.5


def test_unlimited_turning_survives_the_spec(tmp_path, limits):
    free = replace(limits.plan, angular_acceleration=np.inf)
    spec = replace(SMALL, limits="given", airframe=limits.airframe, plan=free)
    spec.save(tmp_path)
    assert load_spec(tmp_path) == spec


def test_travel_time_is_that_of_the_profile(made):
    """Checked by quadrature of 1/√h, with h from the stored nodes and derivatives."""
    _, rows = read_dataset(made)
    row = rows.to_pylist()[0]
    step = row["end"] / row["nodes"]
    x = np.linspace(0, step, 401)[:, None]
    h, dh, ddh = (np.array(row[name])[:-1] for name in ("h", "dh", "ddh"))
    inside = h + x * (dh + x * (ddh / 2 + x * np.array(row["dddh"]) / 6))
    assert row["travel_time"] == pytest.approx(np.trapezoid(1 / np.sqrt(inside), x, axis=0).sum(), rel=1e-5)


def test_two_workers_make_the_same_bytes_as_one(made, tmp_path):
    make_dataset(tmp_path, SMALL, workers=2)
    assert shard_bytes(tmp_path) == shard_bytes(made)


def test_solve_times_are_kept_apart(made):
    assert read_timing(made)["row"].to_pylist() == list(range(6))
    assert "solve_seconds" not in read_dataset(made)[1].column_names


def test_an_interrupted_run_goes_on_where_it_stopped(made, tmp_path, monkeypatch):
    labelled: list[int] = []

    def label_until_interrupted(spec, number, choose=None):
        if len(labelled) == 1:
            raise KeyboardInterrupt
        labelled.append(number)
        return label_shard(spec, number, choose)

    monkeypatch.setattr(dataset, "label_shard", label_until_interrupted)
    with pytest.raises(KeyboardInterrupt):
        make_dataset(tmp_path, SMALL)
    monkeypatch.undo()
    kept = shard_bytes(tmp_path)
    assert len(kept) == 1
    heard: list[int] = []
    make_dataset(tmp_path, SMALL, on_rows=heard.append)
    assert shard_bytes(tmp_path) == shard_bytes(made)
    assert heard == [2, 2, 2]  # what was there first, then a shard at a time


def test_a_full_disk_loses_nothing_that_was_written(made, tmp_path, monkeypatch):
    write = dataset.atomic_write
    written: list[Path] = []

    def write_until_full(file):
        if len(written) == 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        written.append(file)
        return write(file)

    monkeypatch.setattr(dataset, "atomic_write", write_until_full)
    with pytest.raises(InputError, match="No space left"):
        make_dataset(tmp_path, SMALL)
    monkeypatch.undo()
    assert len(shard_bytes(tmp_path)) == 1
    make_dataset(tmp_path, SMALL)
    assert shard_bytes(tmp_path) == shard_bytes(made)


def test_a_folder_with_another_dataset_is_refused_naming_what_differs(made):
    before = shard_bytes(made)
    with pytest.raises(InputError, match=r"limits hardware there, simulation here; nodes 40 there, 50 here"):
        make_dataset(made, replace(SMALL, limits="simulation", nodes=50))
    with pytest.raises(InputError, match="version"):
        make_dataset(made, replace(SMALL, version="0.0.1"))
    assert shard_bytes(made) == before


def test_paths_that_cannot_be_are_rows_with_a_reason(tmp_path):
    spec = replace(SMALL, count=2, boxes=((0.1, 0.1, 0.1),))
    make_dataset(tmp_path, spec)
    _, rows = read_dataset(tmp_path)
    assert rows["status"].to_pylist() == ["PATH", "PATH"]
    assert all("no room" in reason for reason in rows["reason"].to_pylist())
    assert describe(tmp_path)["failed"] == {"PATH": 2}


@pytest.mark.parametrize("relabel", Relabel)
def test_perturbed_copies_stay_within_epsilon_and_are_labelled_as_asked(tmp_path, relabel):
    spec = replace(SMALL, count=1, epsilon=0.01, copies=2, relabel=relabel)
    make_dataset(tmp_path, spec)
    clean, *copies = read_dataset(tmp_path)[1].to_pylist()
    s = np.linspace(0, clean["end"], spec.nodes + 1)
    for copy in copies:
        distance = np.linalg.norm(row_path(spec, copy["row"])(s) - row_path(spec, 0)(s), axis=1)
        assert 0 < distance.max() <= 0.01
        assert (copy["h"] == clean["h"]) == (relabel is Relabel.KEEP)


def test_info_counts_and_describes(made):
    found = describe(made)
    assert found["rows"] == found["rows_wanted"] == found["solved"] == 6
    assert found["certified_as_they_are"] + found["certified_when_slowed"] == 6
    times = found["percentiles"]["travel_time"]
    assert 0 < times["0"] <= times["50"] <= times["100"]
    assert found["active_limits"]["speed"] > 0.5
    json.dumps(found)


def test_damaged_files_are_named(made, tmp_path):
    with pytest.raises(InputError, match=r"no dataset.json"):
        read_dataset(tmp_path)
    (tmp_path / "dataset.json").write_text("{}")
    with pytest.raises(InputError, match="not a dataset description"):
        load_spec(tmp_path)
    (tmp_path / "dataset.json").write_bytes((made / "dataset.json").read_bytes())
    with pytest.raises(InputError, match="no rows yet"):
        read_dataset(tmp_path)
    (tmp_path / "shards").mkdir()
    (tmp_path / "shards" / "00000.parquet").write_bytes(b"PAR1 damaged")
    with pytest.raises(InputError, match=r"damaged") as error:
        read_dataset(tmp_path)
    assert error.value.where.endswith("00000.parquet")


@pytest.mark.parametrize("change", [{"count": 0}, {"nodes": 1}, {"waypoints": (4, 3)}, {"epsilon": 0.1}, {"seed": -1}])
def test_specs_without_sense_are_refused(change):
    with pytest.raises(InputError, match=next(iter(change))):
        replace(SMALL, **change)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense", "tcp://nowhere.invalid:8786"])
def test_an_unreachable_scheduler_is_an_error(tmp_path, address):
    with pytest.raises(SchedulerError) as error:
        make_dataset(tmp_path, SMALL, scheduler=address)
    assert error.value.where == address
    assert isinstance(error.value, CfplanError)


@pytest.mark.parametrize(("workers", "reason"), [(0, "no worker"), (1, "has 2 threads")])
def test_a_cluster_without_workers_or_with_threads_is_refused(workers, reason):
    distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    with (
        distributed.LocalCluster(
            n_workers=workers, threads_per_worker=2, processes=False, protocol="tcp://", dashboard_address=None
        ) as cluster,
        pytest.raises(SchedulerError, match=reason) as error,
        pool(scheduler=cluster.scheduler_address, worker_patience=0.5),
    ):
        pass
    assert f"dask worker --nworkers -1 --nthreads 1 {cluster.scheduler_address}" in error.value.hint


@pytest.mark.slow
@pytest.mark.integration
def test_a_cluster_makes_the_same_bytes_also_when_a_worker_is_killed(made, tmp_path):
    distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    killed: list[int] = []
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:

        def kill_one(_: int) -> None:
            if not killed and len(heard) > 1:
                killed.append(next(iter(cluster.workers.values())).pid)
                os.kill(killed[0], signal.SIGKILL)

        heard: list[int] = []
        make_dataset(
            tmp_path, SMALL, scheduler=cluster.scheduler_address, on_rows=lambda n: (heard.append(n), kill_one(n))
        )
    assert killed
    assert shard_bytes(tmp_path) == shard_bytes(made)


def test_toppquad_labels_the_same_paths(tmp_path):
    spec = replace(SMALL, count=2, limits="paper", waypoints=(4, 4), yaw=YawMode.FREE)
    make_dataset(tmp_path / "expert", spec)
    make_dataset(tmp_path / "toppquad", replace(spec, planner=Labeller.TOPPQUAD))
    assert load_spec(tmp_path / "toppquad").planner is Labeller.TOPPQUAD
    (_, by_expert), (_, by_toppquad) = read_dataset(tmp_path / "expert"), read_dataset(tmp_path / "toppquad")
    assert by_expert["coefficients"].equals(by_toppquad["coefficients"])
    assert set(by_toppquad["solver"].to_pylist()) == {"IPOPT"}
    assert 0.0 <= min(yaw[0] for yaw in by_toppquad["yaw"].to_pylist()) <= np.pi / 2  # as the paper has it
    for ours, theirs in zip(by_expert["travel_time"].to_pylist(), by_toppquad["travel_time"].to_pylist(), strict=True):
        assert theirs == pytest.approx(ours, rel=0.03)


def test_chosen_paths_lead_through_the_same_waypoints_and_are_flown_sooner(tmp_path):
    plain_spec = replace(SMALL, waypoints=(3, 4))
    made = tmp_path / "plain", tmp_path / "chosen"
    make_dataset(made[0], plain_spec)
    make_dataset(made[1], replace(plain_spec, shape=PathShape.FASTEST), choose=fastest_by_search)
    times = []
    for plain, chosen in zip(*(read_dataset(folder)[1].to_pylist() for folder in made), strict=True):
        assert chosen["status"] == "SOLVED"
        paths = [Curve(np.array(row["breaks"]), np.array(row["coefficients"]).reshape(len(row["breaks"]) - 1, -1, 3))
                 for row in (chosen, plain)]  # fmt: skip
        ours, theirs = (path(path.breaks) for path in paths)
        assert np.linalg.norm(ours[:, None] - theirs, axis=-1).min(axis=0).max() < 1e-9
        times.append((chosen["travel_time"], plain["travel_time"]))
    assert sum(ours for ours, _ in times) < 0.99 * sum(theirs for _, theirs in times)


def test_shapes_and_rooms_are_drawn_by_seed_and_number():
    rooms = []

    def choose(points, space, chosen, yaw, angle):
        assert space.holds(points)
        rooms.append(space)
        return min_snap(2.0 * points)

    spec = DatasetSpec(count=60, seed=4, shape=None)
    for number in range(60):
        row_path(spec, number, choose)
    assert 15 <= len(rooms) <= 45
    heard, rooms = rooms, []
    for number in range(60):
        row_path(replace(spec, count=61), number, choose)
    assert rooms == heard


def test_chosen_paths_need_somebody_who_chooses_them(tmp_path):
    """An error of the program: it must not become a row."""
    with pytest.raises(ValueError, match="chooses"):
        make_dataset(tmp_path, replace(SMALL, shape=PathShape.FASTEST))


def test_a_dataset_from_before_planners_and_shapes_were_named_is_of_the_experts_least_snap(made, tmp_path):
    content = json.loads((made / "dataset.json").read_text())
    del content["planner"], content["shape"]
    (tmp_path / "dataset.json").write_text(json.dumps(content))
    assert load_spec(tmp_path) == SMALL
