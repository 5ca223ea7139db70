"""The networks of all tables are trained one after another, and those that are trained are kept."""

from dataclasses import replace

import pytest
from click.testing import CliRunner

from cfplan.errors import InputError
from cfplan.learning.dataset import make_dataset
from cfplan.learning.dataset_spec import Relabel
from studies.paper.all_networks import ALL, train_all
from studies.paper.architectures import Settings, wanted
from studies.paper.networks import Kind
from studies.paper.sequences import Inputs
from studies.paper.trained import TESTED, quick_spec
from studies.runner.commands import studies


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")

    make_dataset(folder, replace(quick_spec(), count=TESTED + 6))
    return folder


def test_all_tables_networks_are_among_them_and_the_papers_lstm_is_the_first():
    assert next(iter(ALL)) == "LSTM"
    assert {each.kind for each in ALL.values()} == {*Kind}
    assert {each.inputs for each in ALL.values()} == {*Inputs}
    assert {each.epsilon for each in ALL.values()} == {0.0, 0.001, 0.01, 0.1}
    assert {each.relabel for each in ALL.values()} == {*Relabel}
    assert [each.seed for each in wanted(Settings()) if each.model == "LSTM"] == [0, 1, 2]


def test_the_command_trains_a_network_until_it_is_flat_and_keeps_one_that_is_trained(data, tmp_path):
    line = ["networks", "MLP", "--data", str(data), "--networks", str(tmp_path)]
    first = CliRunner().invoke(studies, line, catch_exceptions=False)
    (said,) = [
        text for text in first.output.splitlines() if text.startswith("MLP: ") and "validation loss flat" in text
    ]
    assert "MLP: epoch 1, loss" in first.output
    weights = (tmp_path / "MLP" / "weights.safetensors").read_bytes()
    second = CliRunner().invoke(studies, line, catch_exceptions=False)
    assert second.output.splitlines() == [said]
    assert (tmp_path / "MLP" / "weights.safetensors").read_bytes() == weights
    assert [path.name for path in sorted((tmp_path / "MLP").iterdir())] == ["log.csv", "weights.safetensors"]


def test_an_unknown_network_and_a_missing_dataset_are_refused(data, tmp_path):
    with pytest.raises(InputError, match="no network 'LSTM-2'") as error:
        next(train_all(data, tmp_path, ["LSTM-2"]))
    assert "LSTM-seed-1" in error.value.hint
    with pytest.raises(InputError, match="no such dataset"):
        next(train_all(tmp_path / "none", tmp_path))
