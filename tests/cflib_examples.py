"""cflib's own examples, unmodified, on the virtual Crazyflie over UDP, each a process of its own.

They are the files that its wheel brings along, byte for byte: the wheel's own list of checksums is held against them.
"""

import base64
import hashlib
import os
import subprocess
import sys
from importlib.metadata import files
from pathlib import Path

import cflib

from cfplan.simulation.lab.lab import Lab

EXAMPLES = Path(cflib.__file__).parents[1] / "examples"


def unmodified(example: str) -> Path:
    """The example, if it is as cflib was published."""
    (listed,) = [file for file in files("cflib") if file.as_posix() == f"examples/{example}"]
    digest = hashlib.new(listed.hash.mode, (EXAMPLES / example).read_bytes()).digest()
    assert base64.urlsafe_b64encode(digest).rstrip(b"=").decode() == listed.hash.value
    return EXAMPLES / example


def run_example(example: str, lab: Lab, folder: Path) -> str:
    """Run it to its end, in that folder; what it printed."""
    ended = subprocess.run(
        [sys.executable, str(unmodified(example))],
        cwd=folder,
        env=os.environ | {"CFLIB_URI": f"udp://127.0.0.1:{lab.port}"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout
