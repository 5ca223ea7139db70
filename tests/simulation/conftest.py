"""Numbers that the real firmware computed; they lie beside the repository."""

from pathlib import Path

import numpy as np
import pytest

FIRMWARE = Path(__file__).parents[3] / "shared" / "data" / "firmware"


@pytest.fixture
def firmware():
    """A function from a file's name to its arrays."""
    if not FIRMWARE.is_dir():
        pytest.skip("the firmware's numbers, ../shared/data/firmware, are not here")
    return lambda name: dict(np.load(FIRMWARE / f"{name}.npz"))
