"""Overlapping windows cover a path of any length, and their answers pass over from one to the next."""

import numpy as np
import pytest

from cfplan.learning.windows import OVERLAP_FRACTION, overlapped, window_starts, window_weights


@pytest.mark.parametrize("nodes", [64, 65, 100, 105, 111, 112, 113, 128, 1000])
def test_windows_cover_the_path_and_overlap(nodes):
    starts = window_starts(nodes, 64)
    assert starts[0] == 0
    assert starts[-1] + 64 == nodes
    assert np.all(np.diff(starts) <= 64 - OVERLAP_FRACTION * 64)
    assert np.all(np.diff(starts) > 0)


@pytest.mark.parametrize("nodes", [64, 65, 105, 130, 777])
def test_shares_add_up_to_one_everywhere_and_are_nothing_next_to_an_end_inside(nodes):
    starts = window_starts(nodes, 64)
    counts = window_weights(starts, 64)
    np.testing.assert_allclose(overlapped(starts, counts), 1.0)
    assert np.all(counts[1:, :5] < 1e-3)
    assert np.all(counts[:-1, -5:] < 1e-3)
    assert counts[0, 0] == counts[-1, -1] == 1.0


def test_what_windows_agree_on_is_kept():
    starts = window_starts(300, 64)
    wave = np.sin(np.arange(301) / 20)
    told = window_weights(starts, 64) * wave[starts[:, None] + np.arange(65)]
    np.testing.assert_allclose(overlapped(starts, told), wave, atol=1e-12)


def test_the_number_of_windows_grows_with_the_path():
    assert len(window_starts(4800, 64)) == 1 + -(-(4800 - 64) // 40)
