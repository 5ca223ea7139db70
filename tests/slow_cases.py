"""Tables of cases of which a few are quick: `make test` runs those, `make slow` the others."""

from collections.abc import Collection, Iterable

import pytest


def slow_unless(quick: Collection[object], cases: Iterable[object]) -> list[object]:
    """Return `cases` for pytest.mark.parametrize; those that are not in `quick`, a part of them, are marked slow."""
    cases = list(cases)
    assert all(case in cases for case in quick)
    return [case if case in quick else pytest.param(case, marks=pytest.mark.slow) for case in cases]
