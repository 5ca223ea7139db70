"""A chain of windows covers a path of any length, once."""

import pytest

from cfplan.learning.windows import chain


@pytest.mark.parametrize("nodes", [64, 65, 100, 111, 112, 113, 128, 1000])
def test_kept_parts_follow_each_other_and_cover_the_path(nodes):
    windows = list(chain(nodes, 64, 48))
    at = 0
    for window in windows:
        assert window.first == at
        assert 0 < window.keep <= 64
        assert window.first + 64 <= nodes
        at += window.keep
    assert at == nodes
    assert [window.last for window in windows] == [False] * (len(windows) - 1) + [True]


def test_the_number_of_windows_grows_with_the_path():
    assert len(list(chain(4800, 64, 48))) == 100
