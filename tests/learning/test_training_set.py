"""What is learned: windows of the labels, wherever they lie and however close their nodes."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cfplan.errors import InputError
from cfplan.learning.dataset import read_dataset
from cfplan.learning.features import COLUMNS, REFERENCE
from cfplan.learning.training_set import START_NOISE, UNKNOWN, WIDEST, draw, read_training_set


@pytest.fixture(scope="module")
def training_set(tiny):
    return read_training_set(tiny)


def batch(training_set, rows, seed=0):
    return draw(training_set.labels, np.array(rows), 24, np.random.default_rng(seed))


def test_targets_and_reference_give_the_label_back(training_set, tiny):
    """These labels have one speed: every coefficient of the spline is that h."""
    _, rows = read_dataset(tiny)
    found = batch(training_set, np.arange(16))
    mean_step = found.inputs[:, :, COLUMNS + 10]  # log, in units of length
    rates = found.inputs[:, :, REFERENCE] - mean_step + found.targets[:, :, 0]  # log √u/Δs, in units of time
    for row, label in enumerate(rows.to_pylist()):
        np.testing.assert_allclose(rates[row], rates[row][0], atol=1e-4)
        time = training_set.scaled[row].time
        step = np.sqrt(label["h"][0]) * time / np.exp(rates[row][0])
        assert 0 < step <= WIDEST * 1.01 * label["end"] / 40


def test_times_are_the_shares_of_the_window(training_set):
    found = batch(training_set, np.arange(16))
    np.testing.assert_allclose(found.times.sum(axis=1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(found.times[:, 1:-1], 1 / 24, rtol=1e-3)  # of one speed


def test_windows_lie_at_both_ends_and_between(training_set):
    flags = batch(training_set, np.tile(np.arange(16), 20)).inputs[:, 0, COLUMNS : COLUMNS + 3]
    at_start, at_end, knows = flags.mean(axis=0)
    assert 0.2 < at_start < 0.45
    assert 0.2 < at_end < 0.45
    assert knows == pytest.approx((1.0 - UNKNOWN) * (1.0 - at_start), abs=0.06)
    assert not (flags[:, 0] * flags[:, 2]).any(), "a rest has no state to tell"


def test_the_start_is_told_a_little_wrong(training_set):
    found = batch(training_set, np.tile(np.arange(16), 40))
    knows = found.inputs[:, 0, COLUMNS + 2] == 1.0
    error = found.inputs[knows, 0, COLUMNS + 3] - found.targets[knows, 0, 0]
    assert error.std() == pytest.approx(START_NOISE[0], rel=0.2)
    assert found.inputs[knows, 0, COLUMNS + 4].std() == pytest.approx(START_NOISE[1], rel=0.2)


def test_the_tail_inside_a_path_counts_little(training_set):
    found = batch(training_set, np.tile(np.arange(16), 5))
    begins, ends, known = (found.inputs[:, 0, COLUMNS + k] == 1.0 for k in range(3))
    assert np.all(found.weights[begins & ends] == 1.0)
    assert np.all(found.weights[~ends, -1] < 0.2)
    assert np.all(found.weights[begins | known, 0] == 1.0)
    assert np.all(found.weights[~begins & ~known, 0] < 0.2)


def test_the_same_seed_draws_the_same_windows(training_set):
    first, again, other = (
        batch(training_set, [0, 1, 2]),
        batch(training_set, [0, 1, 2]),
        batch(training_set, [0, 1, 2], seed=1),
    )
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, two)
    assert np.abs(first.inputs - other.inputs).max() > 0.01


def test_noise_moves_paths_by_at_most_epsilon_and_keeps_the_answers(training_set):
    noisy = training_set.noisy(0.01, np.random.SeedSequence(1))
    rows = np.arange(16)
    clean = draw(training_set.labels, rows, 24, np.random.default_rng(0))
    moved = draw(noisy, rows, 24, np.random.default_rng(0))
    np.testing.assert_array_equal(noisy.h, training_set.labels.h)

    def rates(batch):
        return batch.targets[:, :, 0] + batch.inputs[:, :, REFERENCE] - batch.inputs[:, :, COLUMNS + 10]

    np.testing.assert_allclose(rates(clean), rates(moved), atol=1e-4)
    units = np.array([each.length for each in training_set.scaled])

    def heights(batch):
        return batch.inputs[:, :, 2] * np.exp(batch.inputs[:, :, COLUMNS + 10]) * units[:, None]  # m, from the first

    assert 0 < np.abs(heights(clean) - heights(moved)).max() <= 2 * 0.01  # both ends of a difference moved


def test_what_is_longer_than_a_flight_is_not_learned_from(tiny, training_set):
    longest = np.sort(training_set.labels.length)[-3]
    kept = read_training_set(tiny, max_length=longest)
    assert len(kept.rows) == len(training_set.rows) - 2
    assert kept.labels.length.max() == longest


def test_a_dataset_without_usable_rows_is_refused(tiny, tmp_path):
    (tmp_path / "shards").mkdir()
    (tmp_path / "dataset.json").write_bytes((tiny / "dataset.json").read_bytes())
    rows = read_dataset(tiny)[1]
    failed = rows.set_column(rows.schema.get_field_index("status"), "status", pa.array(["NOT_CONVERGED"] * 16))
    pq.write_table(failed, tmp_path / "shards" / "00000.parquet")
    with pytest.raises(InputError, match="0 of 16 rows are usable") as error:
        read_training_set(tmp_path)
    assert error.value.hint
    assert error.value.where == str(tmp_path)
