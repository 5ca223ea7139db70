"""`cfplan train`: one command from a dataset to a model, and one line where it cannot."""

import json
import sys

import pytest

from cfplan.cli import run_command
from cfplan.learning.model_files import load_model


@pytest.fixture
def run(monkeypatch, capfd):
    """The command as typed: its exit code, what it printed, and what it said of errors."""

    def typed(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["cfplan", "train", *map(str, arguments)])
        with pytest.raises(SystemExit) as ending:
            run_command()
        said = capfd.readouterr()
        return ending.value.code, said.out, said.err

    return typed


SMALL = ("--hidden", 4, "--layers", 1, "--window", 16, "--epochs", 2, "--batch", 8)


def test_one_command_makes_a_model(run, tiny, tmp_path):
    code, out, err = run(tiny, "-o", tmp_path / "mine", *SMALL)
    assert code == 0
    assert "off by" in out
    assert "epoch 2 of 2" in err
    assert load_model(tmp_path / "mine").card.training["command"].startswith("cfplan train tiny0 -o mine --hidden 4")


def test_json_is_one_document(run, tiny, tmp_path):
    code, out, _ = run(tiny, "-o", tmp_path / "mine", *SMALL, "--json")
    assert code == 0
    assert json.loads(out)["name"] == "mine"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--epochs", 0), "epochs is 0"),
        (("--device", "toaster"), "no device"),
        (("--rate", "nan"), "rate is nan"),
        (("--architecture", "oracle"), "oracle"),
    ],
)
def test_options_without_sense_end_in_one_line(run, tiny, tmp_path, options, says):
    code, _, err = run(tiny, "-o", tmp_path / "mine", *options)
    assert code == 2
    assert says in err
    assert "Traceback" not in err
    assert not (tmp_path / "mine").exists()


def test_a_folder_that_cannot_be_written_is_named(run, tiny, tmp_path):
    (tmp_path / "file").write_text("not a folder")
    code, _, err = run(tiny, "-o", tmp_path / "file" / "mine", *SMALL)
    assert code == 2
    assert "cannot be written" in err


def test_what_is_no_dataset_is_named(run, tmp_path):
    code, _, err = run(tmp_path, "-o", tmp_path / "mine")
    assert code == 2
    assert "dataset.json" in err


def test_without_torch_the_remedy_is_named(run, tiny, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    for name in [name for name in sys.modules if name.startswith("cfplan.learning.")]:
        monkeypatch.delitem(sys.modules, name)
    code, _, err = run(tiny, "-o", tmp_path / "mine")
    assert code == 2
    assert "pip install" in err
