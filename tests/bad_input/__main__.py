"""Draw many wrong inputs of every kind: `python -m tests.bad_input --inputs 100000 [--only plans]`.

An input that fails is left in the folder that the failure names.
"""

import argparse
import os
import sys
from pathlib import Path

import pytest

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Draw many wrong inputs of every kind.")
    parser.add_argument("--inputs", type=int, default=2000, help="number of inputs, all kinds together")
    parser.add_argument("--only", default="", help="part of the name of a kind")
    given = parser.parse_args()
    os.environ["BAD_INPUTS"] = str(given.inputs)
    file = str(Path(__file__).with_name("test_bad_input.py"))
    words = [file, "--hypothesis-profile=random", "--timeout=0", "--durations=0"]
    sys.exit(pytest.main([*words, *(["-k", given.only] if given.only else ["--numprocesses=2"])]))
