"""Scheduling of threads: the stream goes first where that is permitted, and nothing that it starts does."""

import ctypes
import os
import platform
import struct
import subprocess
import sys
import threading

import pytest

from cfplan.flight import real_time
from cfplan.flight.real_time import (
    lock_memory,
    may_use_fifo_scheduling,
    shorten_time_slice,
    use_fifo_scheduling,
    use_ordinary_scheduling,
    uses_fifo_scheduling,
)

pytestmark = pytest.mark.unit


def in_a_thread(what):
    """Its result; nothing of it is left behind in the thread that tests."""
    found = []
    thread = threading.Thread(target=lambda: found.append(what()))
    thread.start()
    thread.join()
    return found[0]


def test_asking_whether_it_may_go_first_changes_nothing():
    before = uses_fifo_scheduling()
    may_use_fifo_scheduling()
    assert uses_fifo_scheduling() == before


def test_a_thread_goes_first_exactly_where_it_is_permitted():
    permitted = may_use_fifo_scheduling()
    assert in_a_thread(lambda: (use_fifo_scheduling(), uses_fifo_scheduling())) == (permitted, permitted)


def test_where_the_system_refuses_it_goes_with_all_others(monkeypatch):
    def refuse(*_arguments):
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert in_a_thread(lambda: (use_fifo_scheduling(), uses_fifo_scheduling())) == (False, False)
    assert not may_use_fifo_scheduling()


def test_a_system_that_knows_of_no_such_thing_is_no_fault(monkeypatch):
    for name in ("sched_setscheduler", "SCHED_FIFO"):
        monkeypatch.delattr(real_time.os, name)
    assert not may_use_fifo_scheduling()
    assert not uses_fifo_scheduling()


def slice_of_this_thread():
    """(nice, s) of it, as Linux tells by sched_getattr(2)."""
    told = ctypes.create_string_buffer(56)
    assert ctypes.CDLL(None).syscall({"x86_64": 315, "aarch64": 275}[platform.machine()], 0, told, len(told), 0) == 0
    _, _, _, nice, _, runtime = struct.unpack_from("=IIQiIQ", told)
    return nice, runtime / 1e9


@pytest.mark.skipif(
    sys.platform != "linux" or tuple(map(int, platform.release().split(".")[:2])) < (6, 12),
    reason="this system gives no thread turns of its own length",
)
def test_without_permission_a_thread_asks_for_short_turns_and_keeps_its_niceness():
    def ask():
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 5)
        before = slice_of_this_thread()
        return before, shorten_time_slice(), slice_of_this_thread()

    (_, usual), granted, after = in_a_thread(ask)
    assert granted
    assert after == (5, 1e-4)
    assert usual > 1e-4


def test_a_system_without_short_turns_is_no_fault(monkeypatch):
    monkeypatch.setattr(real_time.platform, "machine", lambda: "unknown")
    assert not shorten_time_slice()


def test_a_child_of_the_stream_goes_with_all_others():
    def start():
        use_fifo_scheduling()
        child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
        use_ordinary_scheduling(child.pid)
        with child:
            return os.sched_getscheduler(child.pid)

    assert in_a_thread(start) == os.SCHED_OTHER


LOCKED = """
from cfplan.flight.real_time import lock_memory
permitted = lock_memory()
more = bytearray(30_000_000)  # must be given in any case
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
print(permitted, int(status["VmLck"].split()[0]) > 30_000)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="locks memory on Linux alone")
def test_memory_is_locked_exactly_where_it_is_permitted():
    found = subprocess.run([sys.executable, "-c", LOCKED], capture_output=True, text=True, check=True).stdout.split()
    assert found in (["True", "True"], ["False", "False"])


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="locks memory on Linux alone")
def test_a_limit_that_is_not_reached_yet_locks_nothing(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    import resource

    monkeypatch.setattr(resource, "getrlimit", lambda _which: (8 << 20, 8 << 20))
    monkeypatch.setattr(real_time.ctypes, "CDLL", lambda _name: pytest.fail("asked for it"))
    assert not lock_memory()
