"""A pipe in the place of a file: refused, or read for as long as it gives something; never waited for."""

import os
import threading
from pathlib import Path

from cfplan.errors import InputError
from cfplan.files.text import read_text
from cfplan.geometry.path_file import load_path_file
from cfplan.learning.dataset import describe
from cfplan.learning.model_files import WEIGHTS, load_card, load_model, save_model
from cfplan.planning.plan_file import load_plan
from cfplan.recording.importers.formats import read_log
from cfplan.recording.reader import is_record, read_record
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
    "record": read_record,
    "flight.mcap": lambda file: read_record(file.parent),
    "card.json": lambda file: load_card(file.parent),
    "weights": load_piped_weights,
    "dataset.json": lambda file: describe(file.parent),
}


def test_a_pipe_without_a_writer_is_refused(tmp_path):
    """By all readers at the same time, some of which wait for a moment."""
    found: dict[str, InputError] = {}

    def read(name: str) -> None:
        folder = tmp_path / name.partition(".")[0]
        folder.mkdir()
        os.mkfifo(folder / name)
        try:
            READERS[name](folder / name)
        except InputError as error:
            found[name] = error

    reading = [threading.Thread(target=read, args=(name,), daemon=True) for name in READERS]
    for thread in reading:
        thread.start()
    for thread in reading:
        thread.join(30.0)
    assert set(found) == set(READERS), "some wait"
    assert all(error.hint and error.where for error in found.values())
    assert not is_record(tmp_path / "flight" / "flight.mcap")


def test_points_may_come_from_a_pipe_that_is_written(tmp_path):
    os.mkfifo(tmp_path / "points.csv")
    (tmp_path / "path.yaml").write_text("points: points.csv\n")
    writing = threading.Thread(target=(tmp_path / "points.csv").write_text, args=("0,0,1\n1,0,1\n",), daemon=True)
    writing.start()
    assert len(load_path_file(tmp_path / "path.yaml").waypoints) == 2


def test_a_pipe_is_read_to_its_end(tmp_path):
    pipe, words = tmp_path / "pipe", "1 2 3\n" * 50_000
    os.mkfifo(pipe)
    threading.Thread(target=pipe.write_text, args=(words,), daemon=True).start()
    assert read_text(pipe) == words
