"""Malformed and absurd input, by seeds: all of it is read, or refused in one line; none hangs or fills the memory.

pytest -m slow tests/integration/test_fuzz.py                            some 2,000 inputs
FUZZ_INPUTS=100000 pytest -m slow tests/integration/test_fuzz.py         as many as are asked for, of all readers
FUZZ_SEED=7 pytest -m slow tests/integration/test_fuzz.py                other inputs

`python -m tests.fuzzing` does the same with a table of what was read, and makes a single input again.
"""

import os

import pytest

from tests.fuzzing.campaign import Outcome, fuzz, shares
from tests.fuzzing.readers import READERS

pytestmark = pytest.mark.slow
INPUTS, SEED = int(os.environ.get("FUZZ_INPUTS", "2000")), int(os.environ.get("FUZZ_SEED", "0"))


@pytest.mark.timeout(0)
@pytest.mark.parametrize("name", READERS)
def test_whatever_comes_is_read_or_refused(name, tmp_path):
    count = shares(INPUTS, list(READERS))[name]
    (outcome,) = fuzz({name: count}, SEED, tmp_path)
    assert outcome.inputs == count
    assert not outcome.findings, _told(outcome)


def _told(outcome: Outcome) -> str:
    """Return each kind of finding with the command that shows one."""
    again = f"python -m tests.fuzzing --readers {outcome.reader!r} --seed {SEED} --number"
    lines = [f"{len(numbers)} × {kind}: {again} {numbers[0]}" for kind, numbers in outcome.kinds().items()]
    return "\n".join(lines)
