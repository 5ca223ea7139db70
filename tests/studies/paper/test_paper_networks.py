"""The paper's networks: inputs, teacher forcing and causality, and training that resumes after a stop."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from cfplan.errors import InputError, NotCertifiedError
from cfplan.geometry.yaw import YawMode
from cfplan.learning.checkpoints import Epoch
from cfplan.learning.dataset import make_dataset
from cfplan.learning.dataset_spec import DatasetSpec, Relabel
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import PlanningTask
from cfplan.safety.limit_sets import PAPER
from cfplan.vehicle.timing import duration_of
from studies.paper.networks import Kind, Size, build_network
from studies.paper.recovery import nodal_time, recover_profile, yaw_of_cosines
from studies.paper.sequences import Inputs, path_inputs, read_sequences, select_inputs
from studies.paper.training import SequenceOptions, UntilFlat, answer, load_network, losses, train_network

SMALL = Size(8, 1)
FED = [Kind.LSTM, Kind.TRANSFORMER, Kind.MLP, Kind.NEIGHBOURS]
SIGNS = torch.tensor([1.0, -1.0]).repeat(50)[:, None]  # from node to node
OPTIONS = SequenceOptions(until=UntilFlat(most=3), batch=4)


@pytest.fixture(scope="module")
def sequences(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    spec = DatasetSpec(
        count=8, seed=2, limits="paper", families=(), boxes=((10.0,) * 3,), waypoints=(4, 4), nodes=99, yaw=YawMode.FREE
    )
    make_dataset(folder, spec)
    return read_sequences(folder)


def network(kind: Kind):
    torch.manual_seed(1)
    return build_network(kind, 9, SMALL).eval()


@pytest.mark.parametrize("kind", FED)
def test_alone_a_network_says_what_it_says_when_it_is_fed_its_own_answers(kind):
    seen = torch.randn(2, 30, 9)
    with torch.inference_mode():
        alone = network(kind)(seen)
        fed = network(kind)(seen, alone)
    assert alone.shape == (2, 30, 2)
    assert alone.numpy() == pytest.approx(fed.numpy(), abs=1e-5)


@pytest.mark.parametrize("kind", FED)
def test_no_answer_knows_itself_or_those_behind_it(kind):
    seen, answers = torch.randn(1, 30, 9), torch.randn(1, 30, 2)
    other = answers.clone()
    other[:, 12:] += 1.0
    with torch.inference_mode():
        first, second = network(kind)(seen, answers), network(kind)(seen, other)
    assert first[:, :13].numpy() == pytest.approx(second[:, :13].numpy(), abs=1e-5)
    assert np.abs((first - second)[:, 13].numpy()).max() > 1e-4


def test_the_encoder_sees_all_of_the_path_and_feeds_nothing_back():
    seen = torch.randn(1, 30, 9)
    other = seen.clone()
    other[:, -1] += 1.0
    with torch.inference_mode():
        found = [network(Kind.ENCODER)(values) for values in (seen, other)]
        assert torch.equal(found[0], network(Kind.ENCODER)(seen, torch.randn(1, 30, 2)))
    assert np.abs((found[0] - found[1])[:, 0].numpy()).max() > 1e-5


def test_inputs_are_the_derivatives_of_the_path_that_are_named(sequences):
    path = sequences.paths[0]
    seen = path_inputs(path, 100)
    s = np.linspace(0, path.end, 100)
    assert select_inputs(seen, Inputs.POSITION) == pytest.approx(path(s), abs=1e-5)
    assert select_inputs(seen, Inputs.ACCELERATION)[:, 3:] == pytest.approx(path(s, 2), abs=1e-4)
    assert [each.width for each in Inputs] == [9, 6, 6, 3]


def test_yaw_goes_on_through_half_a_turn():
    yaw = np.linspace(0.2, 7.0, 60)
    assert yaw_of_cosines(np.cos(yaw)) == pytest.approx(yaw, abs=1e-9)


def test_labels_become_profiles_of_the_same_time(sequences):
    for answers, end, wanted in zip(sequences.answers, sequences.end, sequences.travel_time, strict=True):
        assert duration_of(recover_profile(answers, end)) == pytest.approx(wanted, rel=5e-3)
    times = nodal_time(sequences.answers, sequences.end)
    assert times == pytest.approx(sequences.travel_time, rel=0.02)


def test_an_answer_that_is_no_number_is_refused():
    with pytest.raises(NotCertifiedError):
        recover_profile(np.full((100, 2), np.nan), 10.0)


def test_training_learns_and_goes_on_where_it_stopped(sequences, tmp_path):
    log: list[Epoch] = []
    whole = train_network(sequences, tmp_path / "whole", OPTIONS, on_epoch=log.append)
    assert log[-1].loss < log[0].loss

    class Killed(Exception):
        pass

    def kill(epoch):
        if epoch.epoch == 2:
            raise Killed

    with pytest.raises(Killed):
        train_network(sequences, tmp_path / "part", OPTIONS, on_epoch=kill)
    assert load_network(tmp_path / "part", sequences, OPTIONS) is None
    later: list[Epoch] = []
    resumed = train_network(sequences, tmp_path / "part", OPTIONS, on_epoch=later.append)
    assert [epoch.epoch for epoch in later] == [3]
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, resumed.state_dict()[name]), name
    loaded = load_network(tmp_path / "whole", sequences, OPTIONS)
    assert loaded is not None
    read, training = loaded
    assert training.seconds > 0
    assert (training.epochs, training.flat) == (3, False)
    assert training.unseen_loss == min(epoch.unseen_loss for epoch in log) == log[training.best - 1].unseen_loss
    assert answer(read, sequences.inputs) == pytest.approx(answer(whole, sequences.inputs), abs=1e-6)
    with pytest.raises(InputError, match="another training"):
        load_network(tmp_path / "whole", sequences, replace(OPTIONS, rate=1e-3))
    with pytest.raises(InputError, match="another training"):
        load_network(tmp_path / "whole", sequences.part(slice(0, 6)), OPTIONS)


def test_a_training_ends_when_its_validation_loss_is_flat_at_each_rate():
    until = UntilFlat(patience=3, improvement=0.1, cuts=1, most=20)
    falling = [0.8**n for n in range(10)]
    assert until.cuts_after(falling) == 0
    flat = falling + 2 * [0.95 * falling[-1]]  # it falls, but by too little
    assert until.cuts_after(flat) == 0
    flat += [0.95 * falling[-1]]
    assert until.cuts_after(flat) == 1
    assert not until.ended(flat)
    lower = [*flat, *2 * [0.5 * falling[-1]]]  # at the lower rate it falls again
    assert until.cuts_after(lower) == 1
    assert until.ended(lower + 2 * [0.5 * falling[-1]])
    assert until.ended([0.8**n for n in range(20)])
    assert until.cuts_after([math.nan] * 3) == 1


def test_a_loss_that_counts_slopes_is_larger_where_answers_are_rough(sequences):
    known = network(Kind.BIDIRECTIONAL)
    wanted = torch.from_numpy(sequences.answers)
    known.set_units(torch.from_numpy(sequences.inputs), wanted)
    steady, rough = (wanted * torch.tensor([1.1, 1.0]) ** sign for sign in (torch.ones(100, 1), SIGNS))
    plain, slopes = OPTIONS, replace(OPTIONS, slopes=2.0)
    usual = losses(known, steady, wanted, plain)[0].item()
    assert losses(known, rough, wanted, plain)[0].item() == pytest.approx(usual, rel=1e-3)
    assert losses(known, steady, wanted, slopes)[0].item() == pytest.approx(usual, rel=1e-3)
    assert losses(known, rough, wanted, slopes)[0].item() == pytest.approx((1.0 + 2.0 * 4.0) * usual, rel=1e-3)


def test_noise_moves_what_is_seen_by_at_most_epsilon(sequences):
    noisy = sequences.perturbed_by(0.05, np.random.SeedSequence(3))
    moved = np.linalg.norm((noisy.inputs - sequences.inputs)[..., :3], axis=2)
    assert 0.005 < moved.max() <= 0.05 + 1e-5
    assert noisy.answers is sequences.answers


def test_paths_that_are_solved_again_have_labels_of_their_own(sequences, tmp_path):
    noisy = sequences.perturbed_by(0.05, np.random.SeedSequence(3), Relabel.SOLVE)
    for path, answers in zip(noisy.paths, noisy.answers, strict=True):
        profile = plan_expert(PlanningTask(path, PAPER.airframe, PAPER.limits, 99, YawMode.FREE)).profile
        assert answers[:, 0] == pytest.approx(profile.h, rel=1e-5)
        assert answers[:, 1] == pytest.approx(np.cos(profile.yaw), abs=1e-5)
    assert np.abs(noisy.answers[..., 0] / sequences.answers[..., 0] - 1.0).max() > 1e-3

    kept, solved = (replace(OPTIONS, epsilon=0.05, relabel=relabel) for relabel in Relabel)
    assert {kept.name, solved.name} == {"LSTM-0.05", "LSTM-0.05-solved"}
    ends = [train_network(sequences, tmp_path / each.name, each) for each in (kept, solved)]
    assert any(not torch.equal(*pair) for pair in zip(*(end.state_dict().values() for end in ends), strict=True))


def test_a_perturbed_path_that_cannot_be_solved_keeps_the_clean_label(sequences):
    too_few = replace(sequences, spec=replace(sequences.spec, nodes=4))
    noisy = too_few.perturbed_by(0.05, np.random.SeedSequence(3), Relabel.SOLVE)
    assert np.array_equal(noisy.answers, sequences.answers)


def test_damaged_weights_are_named(sequences, tmp_path):
    (tmp_path / "weights.safetensors").write_bytes(b"no weights")
    with pytest.raises(InputError, match="cannot be read") as error:
        load_network(tmp_path, sequences, OPTIONS)
    assert "weights.safetensors" in error.value.where
