"""Malformed and absurd inputs for every reader: `python -m tests.fuzzing`."""

import sys
from pathlib import Path

_SHARED = str(Path(__file__).parents[1])
if _SHARED not in sys.path:  # modules that tests share: pytest finds them by its pythonpath
    sys.path.append(_SHARED)
