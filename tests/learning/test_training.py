"""Training: one way from a seed to the weights, whatever happens on the way."""

import csv
import json
import math
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from cfplan.errors import InputError
from cfplan.learning import training
from cfplan.learning.checkpoints import CHECKPOINT, LOG
from cfplan.learning.dataset_spec import load_spec
from cfplan.learning.model_files import load_model
from cfplan.learning.networks import Architecture
from cfplan.learning.smooth import travel_time
from cfplan.learning.training import CURVES, Options, loss, train
from cfplan.learning.training_set import read_training_set, split
from cfplan.vehicle.timing import measure

SMALL = Options(hidden=6, layers=1, window=16, epochs=3, windows=16, batch=8, rate=1e-2)


@pytest.fixture(scope="module")
def trained(tiny, tmp_path_factory):
    """A folder of a training that nothing disturbed, and its card."""
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("models") / "small"
    return folder, train(tiny, folder, SMALL, command="cfplan train tiny")


def log_of(folder) -> list[dict[str, str]]:
    """All but the seconds, which no two runs repeat."""
    with (folder / LOG).open() as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def test_a_model_folder_holds_all_that_was_promised(trained, tiny):
    folder, card = trained
    model = load_model(folder)
    assert model.card == card
    assert card.training["command"] == "cfplan train tiny"
    assert card.training["hidden"] == 6
    assert card.data["seed"] == load_spec(tiny).seed
    assert card.data["learned_from"] + card.data["judged_on"] == 16
    assert set(card.scores) == {"unseen_loss", "time_error", "time_error_mean", "time_error_p95"}
    ranges = json.loads((folder / "card.json").read_text())["ranges"]
    assert ranges["tilt"] == pytest.approx([math.radians(30)] * 2)
    assert (folder / CURVES).read_bytes().startswith(b"\x89PNG")
    assert [row["epoch"] for row in log_of(folder)] == ["1", "2", "3"]
    assert {file.name for file in folder.iterdir()} == {"weights.safetensors", "card.json", CHECKPOINT, LOG, CURVES}


def test_training_learns(trained):
    losses = [float(row["unseen_loss"]) for row in log_of(trained[0])]
    assert losses[-1] < 0.8 * losses[0]


def test_a_killed_training_goes_on_as_if_it_had_not_been(trained, tiny, tmp_path):
    """Killed behind the first epoch: of the next one nothing is on disk before its end."""

    def killed(epoch):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(tiny, tmp_path, SMALL, on_epoch=killed)
    assert load_model(tmp_path).card.scores["unseen_loss"] > 0.0  # the best so far
    heard = []
    train(tiny, tmp_path, SMALL, on_epoch=heard.append)
    assert [epoch.epoch for epoch in heard] == [2, 3]
    assert log_of(tmp_path) == log_of(trained[0])
    assert (tmp_path / "weights.safetensors").read_bytes() == (trained[0] / "weights.safetensors").read_bytes()


def test_a_model_without_its_training_is_not_overwritten(trained, tiny, tmp_path):
    folder = tmp_path / "shipped"
    shutil.copytree(trained[0], folder)
    (folder / CHECKPOINT).unlink()
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    with pytest.raises(InputError, match="model without its training"):
        train(tiny, folder, SMALL)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def test_a_training_killed_between_checkpoint_and_model_ends_with_its_best_network(tiny, tmp_path, monkeypatch):
    def killed(*_):
        raise KeyboardInterrupt

    once = replace(SMALL, epochs=1)
    monkeypatch.setattr(training, "save_model", killed)
    with pytest.raises(KeyboardInterrupt):
        train(tiny, tmp_path, once)
    monkeypatch.undo()
    train(tiny, tmp_path, once)
    kept = float(log_of(tmp_path)[0]["unseen_loss"])
    assert load_model(tmp_path).card.scores["unseen_loss"] == pytest.approx(kept, rel=1e-3)


def test_a_finished_training_is_not_begun_again(trained, tiny):
    heard = []
    train(tiny, trained[0], SMALL, on_epoch=heard.append)
    assert heard == []


def test_another_training_in_the_folder_is_refused_naming_what_differs(trained, tiny):
    with pytest.raises(InputError, match=r"hidden 6 there, 7 here; batch 8 there, 9 here"):
        train(tiny, trained[0], replace(SMALL, hidden=7, batch=9))


def test_a_training_goes_on_for_more_epochs_and_ends_with_its_best_network(trained, tiny, tmp_path):
    folder = tmp_path / "longer"
    shutil.copytree(trained[0], folder)
    card = train(tiny, folder, replace(SMALL, epochs=5))
    losses = [float(row["unseen_loss"]) for row in log_of(folder)]
    assert len(losses) == 5
    assert card.scores["unseen_loss"] == pytest.approx(min(losses), rel=1e-3)


def test_a_training_starts_from_the_weights_of_a_model(trained, tiny, tmp_path):
    """At a rate of nearly nothing the first epoch is as good as the model, which a drawn network is not."""
    folder, before = trained
    still = replace(SMALL, epochs=1, rate=1e-9)
    card = train(tiny, tmp_path / "started", replace(still, start=folder))
    assert card.scores["unseen_loss"] == pytest.approx(before.scores["unseen_loss"], rel=1e-3)
    assert card.training["start"] == folder.name
    assert card.ranges == before.ranges
    drawn = train(tiny, tmp_path / "drawn", still)
    assert drawn.scores["unseen_loss"] > 1.5 * before.scores["unseen_loss"]


def test_a_start_of_another_size_is_refused_naming_the_option(trained, tiny, tmp_path):
    with pytest.raises(InputError, match="hidden is 6 there, 7 here") as error:
        train(tiny, tmp_path, replace(SMALL, hidden=7, start=trained[0]))
    assert error.value.hint == "give --hidden 6"


@pytest.mark.parametrize("damage", [b"", b"nonsense"])
def test_a_damaged_checkpoint_is_named(tiny, tmp_path, damage):
    (tmp_path / CHECKPOINT).write_bytes(damage)
    with pytest.raises(InputError, match="cannot be read") as error:
        train(tiny, tmp_path, SMALL)
    assert error.value.where.endswith(CHECKPOINT)


@pytest.mark.parametrize("options", [{"architecture": Architecture.ENCODER_DECODER}, {"epsilon": 0.01}])
def test_the_other_ways_train_too(tiny, tmp_path, options):
    card = train(tiny, tmp_path, replace(SMALL, epochs=1, **options))
    assert math.isfinite(card.scores["time_error_mean"])
    load_model(tmp_path)


def test_a_loss_that_is_no_number_ends_the_training(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "loss", lambda *_: (torch.tensor(math.nan, requires_grad=True), None))
    with pytest.raises(InputError, match=r"epoch 1 is not a number"):
        train(tiny, tmp_path, SMALL)
    assert not (tmp_path / CHECKPOINT).exists()


@pytest.mark.parametrize("seed", [-1, 2**64])
def test_seeds_fit_the_generator(seed):
    with pytest.raises(InputError, match="seed"):
        replace(SMALL, seed=seed)


@pytest.mark.parametrize(
    "change",
    [{"hidden": 0}, {"layers": 0}, {"window": 4}, {"epochs": 0}, {"batch": 0}, {"rate": 0.0}, {"epsilon": math.nan}],
)
def test_options_without_sense_are_refused(change):
    with pytest.raises(InputError, match=next(iter(change))):
        replace(SMALL, **change)


@pytest.mark.parametrize("device", ["cuda:99", "toaster"])
def test_a_device_that_is_not_there_is_named(tiny, tmp_path, device):
    with pytest.raises(InputError, match="no device"):
        train(tiny, tmp_path, SMALL, device=device)


def test_copies_of_a_path_are_all_learned_from_or_all_kept_apart(tiny):
    training_set = read_training_set(tiny)
    copied = replace(
        training_set, spec=replace(training_set.spec, epsilon=0.01, copies=3)
    )  # sixteen rows of four paths
    seen, unseen = split(copied, 0)
    assert set(seen.rows // 4).isdisjoint(unseen.rows // 4)
    assert len(seen.rows) + len(unseen.rows) == 16
    assert len(unseen.rows) % 4 == 0


def test_travel_time_is_that_of_the_profile(make_profile):
    u = np.random.default_rng(0).uniform(0.5, 2.0, 33)
    assert travel_time(u, 3.0 / 30) == pytest.approx(measure(make_profile(3.0, u)).time[-1], rel=1e-6)


def test_the_loss_knows_the_error_of_time():
    """Answers that are off by a constant make every interval longer by the same factor."""
    targets = torch.zeros(2, 9, 3)
    answers = targets - torch.tensor([0.01, 0.0, 0.0])
    value, late = loss(answers, targets, torch.ones(2, 9), torch.full((2, 9), 1 / 9))
    np.testing.assert_allclose(late, math.exp(0.01) - 1.0, rtol=1e-4)
    assert float(value) == pytest.approx(1e-4 + (math.exp(0.01) - 1) ** 2, rel=1e-3)


@pytest.mark.slow
@pytest.mark.integration
def test_two_processes_train_one_model(tiny, tmp_path):
    command = [
        sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "cfplan",
        "train", str(tiny), "-o", str(tmp_path / "both"), "--hidden", "6", "--layers", "1", "--window", "16",
        "--epochs", "2", "--batch", "8", "--json",
    ]  # fmt: skip
    done = subprocess.run(
        command, check=False, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}, timeout=240
    )
    assert done.returncode == 0, done.stderr
    card = json.loads(done.stdout)  # one document: one of the two speaks
    assert card["training"]["epochs"] == 2
    assert len(log_of(tmp_path / "both")) == 2
    load_model(tmp_path / "both")
