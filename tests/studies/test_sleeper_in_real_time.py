"""A sleeper measures the latency that the computer imposes on every program."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cfplan.flight.clock import monotonic
from studies.sleeper import Sleeper

pytestmark = pytest.mark.slow


@pytest.mark.skipif(not Path("/proc/self/schedstat").is_file(), reason="this system does not report run-queue times")
def test_a_sleeper_notes_its_deadlines_and_how_long_a_process_waits_for_its_processor():
    processor = {min(os.sched_getaffinity(0))}
    busy = "import time; end = time.monotonic() + 1.5\nwhile time.monotonic() < end: pass"
    commands = [[sys.executable, "-c", f"import os; os.sched_setaffinity(0, {processor})\n{busy}"]] * 2
    with Sleeper(100.0, first=False) as sleeper:
        begin = monotonic()
        time.sleep(0.2)
        assert 15 <= len(sleeper.late(begin, begin + 0.2)) <= 20
        first, second = (subprocess.Popen(command) for command in commands)  # both on one processor
        sleeper.watch(first.pid)
        begin = monotonic() + 0.4
        time.sleep(1.0)
        end = monotonic()
        first.wait()
        second.wait()
        waited = sum(sleeper.queued(begin, end))
        assert 0.2 * (end - begin) < waited < 0.9 * (end - begin)
        assert sleeper.queued(end + 5.0, end + 6.0) == []
