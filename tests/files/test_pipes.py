"""A pipe in the place of a file: refused, or read for as long as it gives something; never waited for."""

import os
import threading
from pathlib import Path

import pytest

from cfplan.errors import InputError
from cfplan.files import text
from cfplan.geometry.path_file import load_path_file
from cfplan.learning.dataset import describe
from cfplan.learning.model_files import WEIGHTS, load_card, load_model, save_model
from cfplan.planning.plan_file import load_plan
from cfplan.recording.importers.formats import read_log
from cfplan.recording.reader import read_record
from cfplan.safety.limits_file import load_limits
from cfplan.vehicle.airframes import load_airframe
from tests.learning.conftest import card, weights


def load_piped_weights(pipe: Path) -> None:
    folder = pipe.parent / "model"
    save_model(folder, card(), weights())
    pipe.replace(folder / WEIGHTS)
    load_model(folder)


READERS = {
    "path.yaml": load_path_file,
    "safety.yaml": load_limits,
    "own.yaml": lambda file: load_airframe(str(file)),
    "plan.parquet": load_plan,
    "log.csv": read_log,
    "flight.mcap": lambda file: read_record(file.parent),
    "card.json": lambda file: load_card(file.parent),
    "weights": load_piped_weights,
    "dataset.json": lambda file: describe(file.parent),
}


@pytest.mark.parametrize("name", READERS)
def test_a_pipe_without_a_writer_is_refused(tmp_path, name, monkeypatch):
    monkeypatch.setattr(text, "PIPE_PATIENCE", 0.2)
    os.mkfifo(tmp_path / name)
    found: list[InputError] = []

    def read() -> None:
        try:
            READERS[name](tmp_path / name)
        except InputError as error:
            found.append(error)

    reading = threading.Thread(target=read, daemon=True)
    reading.start()
    reading.join(30.0)
    assert found, "it waits"
    assert found[0].hint


def test_points_may_come_from_a_pipe_that_is_written(tmp_path):
    os.mkfifo(tmp_path / "points.csv")
    (tmp_path / "path.yaml").write_text("points: points.csv\n")
    writing = threading.Thread(target=(tmp_path / "points.csv").write_text, args=("0,0,1\n1,0,1\n",), daemon=True)
    writing.start()
    assert len(load_path_file(tmp_path / "path.yaml").waypoints) == 2
