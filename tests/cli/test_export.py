"""`cfplan export`: what is written reads back as its receiver reads it."""

import json

import numpy as np
import pytest

from cfplan.flight.on_board.memory_format import read_raw

PATH = "name: curve\nwaypoints: [[-1.2, -1.2, 0.7], [0.2, 0.4, 1.1], [1.2, -0.6, 0.9]]\n"


@pytest.fixture
def export(cfplan, path_file, safety_file, tmp_path):
    files = path_file(PATH), safety_file()

    def run(form, name, *words):
        return cfplan("export", files[0], "--safety", files[1], "--to", form, "-o", tmp_path / name, *words)

    return run


def test_crazyswarm_reads_what_was_written(export, tmp_path):
    ended = export("crazyswarm", "curve.csv", "--json")
    assert ended.code == 0, ended.err
    # As crazyflie_py and pycrazyswarm load it.
    table = np.loadtxt(tmp_path / "curve.csv", delimiter=",", skiprows=1, usecols=range(33), ndmin=2)
    assert len(table) == ended.json["pieces"] <= 31
    assert table[:, 0].sum() == pytest.approx(ended.json["duration"], abs=1e-5)
    np.testing.assert_allclose(table[0, [1, 9, 17, 25]], [-1.2, -1.2, 0.7, 0.0], atol=1e-6)
    assert ended.json["certificate"]["passed"]
    assert ended.json["dry_run"]["passed"]
    assert ended.json["dry_run"]["deviation_median"] < 0.035  # of drawn vehicles, on the filter's estimate
    # And the last of them ends at rest where the path does.
    end = np.array([np.polynomial.Polynomial(table[-1, k : k + 8])(table[-1, 0]) for k in (1, 9, 17)])
    np.testing.assert_allclose(end, [1.2, -0.6, 0.9], atol=1e-4)


def test_the_memory_s_bytes_are_pieces(export, tmp_path):
    ended = export("memory", "curve.bin", "--json")
    memory = (tmp_path / "curve.bin").read_bytes()
    assert len(memory) == ended.json["bytes"] == 132 * ended.json["pieces"]
    assert read_raw(memory, ended.json["pieces"]).duration == pytest.approx(ended.json["duration"])


def test_samples_are_those_of_the_plan(export, tmp_path):
    ended = export("samples", "curve.csv", "--rate", "50", "--json")
    lines = (tmp_path / "curve.csv").read_text().splitlines()
    assert lines[0] == "t,x,y,z,vx,vy,vz,ax,ay,az,yaw,wx,wy,wz,qx,qy,qz,qw"
    rows = np.loadtxt(tmp_path / "curve.csv", delimiter=",", skiprows=1)
    assert len(rows) == ended.json["samples"]
    assert rows[-1, 0] == pytest.approx(ended.json["duration"], abs=1e-6)
    velocity = np.gradient(rows[:-1, 1:4], 0.02, axis=0)
    np.testing.assert_allclose(velocity[2:-2], rows[2:-3, 4:7], atol=0.02)


@pytest.mark.parametrize(
    ("form", "name", "words", "what"),
    [
        ("crazyswarm", "curve.bin", (), "written as .csv"),
        ("memory", "curve.csv", (), "written as .bin"),
        ("memory", "curve.bin", ("--pieces", "40"), "holds 31 pieces"),
        ("compressed", "curve.bin", ("--pieces", "5"), "--pieces"),
        ("crazyswarm", "curve.csv", ("--pieces", "1"), "--pieces"),
        ("crazyswarm", ".", ("--force",), "that is a folder"),
        ("samples", "nowhere/curve.csv", (), "no such folder"),
    ],
)
def test_what_cannot_be_written_is_refused_first(export, form, name, words, what):
    ended = export(form, name, *words)
    assert ended.code == 2
    assert what in ended.err
    assert ended.out == ""


def test_nothing_is_overwritten_unasked(export, tmp_path):
    (tmp_path / "curve.csv").write_text("mine")
    assert "already" in export("samples", "curve.csv").err
    assert (tmp_path / "curve.csv").read_text() == "mine"
    assert export("samples", "curve.csv", "--force").code == 0


def test_errors_are_json_where_that_was_asked_for(export):
    ended = export("crazyswarm", "curve.csv", "--pieces", "2", "--json")
    assert ended.code == 4
    assert "2 pieces" in json.loads(ended.out)["error"]
