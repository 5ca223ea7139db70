"""Work beside: a thread's and a process's answers are the same, and the death of the process changes nothing."""

import multiprocessing
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from waiting import until

from cfplan.errors import InfeasibleError
from cfplan.preparation.beside import BesideByProcess, BesideByThread

PARENT = """
import multiprocessing
from functools import partial
from cfplan.preparation.beside import BesideByProcess
if __name__ == "__main__":
    other = BesideByProcess(int)
    [answer] = other.begin(partial(int, 7))
    answer.result()
    [child] = multiprocessing.active_children()
    print(child.pid, flush=True)
    input()
"""


def refuse(where: str) -> None:
    raise InfeasibleError("no way", where=where, hint="another way")


def fill(value: float, count: int) -> np.ndarray:
    return np.full(count, value)


def append(file: Path, text: str) -> None:
    with file.open("a") as out:
        out.write(text)


@pytest.fixture(params=[BesideByThread, partial(BesideByProcess, int)], ids=["thread", "process"])
def other(request):
    return request.param()


def children():
    """Return the processes beside; other tests may have left others."""
    return [child for child in multiprocessing.active_children() if child.name == "beside"]


def the_child():
    [child] = children()
    return child


@pytest.fixture(autouse=True)
def _no_process_stays():
    yield
    for child in children():
        child.kill()
        child.join()


def test_each_piece_of_work_has_its_answer_whichever_is_asked_for_first(other):
    first, refused, last = other.begin(partial(fill, 1.5, 4), partial(refuse, "there"), partial(int, 3))
    assert last.result() == 3
    with pytest.raises(InfeasibleError) as error:
        refused.result()
    assert (error.value.what, error.value.where, error.value.hint) == ("no way", "there", "another way")
    assert isinstance(refused.exception(), InfeasibleError)
    assert first.exception() is None
    np.testing.assert_array_equal(first.result(), np.full(4, 1.5))


def test_whether_work_is_done_is_told_without_waiting(other, tmp_path):
    goes_on = tmp_path / "goes on"
    first, second = other.begin(partial(until, goes_on.exists), partial(refuse, "there"))
    assert not first.done()
    assert not second.done()
    goes_on.touch()
    assert until(second.done)
    assert first.done()
    assert isinstance(second.exception(), InfeasibleError)


def test_answers_that_nobody_asks_for_do_not_hold_up_the_next(other):
    """They, and what is asked next, are more than a pipe holds."""
    for value in range(3):
        *_, last = other.begin(*[partial(fill, value, 1_000_000)] * 2)
    np.testing.assert_array_equal(last.result(), np.full(1_000_000, 2.0))
    [answer] = other.begin(partial(len, np.zeros(1_000_000)))
    assert answer.result() == 1_000_000


def test_what_is_done_for_nobody_changes_no_answer(other):
    other.wake()  # nothing was done yet
    for value in range(3):
        [answer] = other.begin(partial(fill, value, 4))
        np.testing.assert_array_equal(answer.result(), np.full(4, value))
        other.wake()
        other.wake()


def test_waking_does_what_was_done_last_once_more(tmp_path):
    other, seen = BesideByProcess(int), tmp_path / "seen"
    for number in (1, 2):
        [answer] = other.begin(partial(append, seen, str(number)))
        answer.result()
    other.wake()
    assert until(lambda: seen.read_text() == "122")


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="processors cannot be chosen on this system")
def test_the_process_keeps_off_the_processor_that_asks():
    processors = os.sched_getaffinity(0)
    if len(processors) < 2:
        pytest.skip("one processor alone")
    other = BesideByProcess(int)
    try:
        for mine in processors:
            os.sched_setaffinity(0, {mine})
            [answer] = other.begin(partial(os.sched_getaffinity, 0))
            assert answer.result() == processors - {mine}
    finally:
        os.sched_setaffinity(0, processors)
    assert os.sched_getaffinity(0) == processors


def test_where_the_process_has_died_the_work_is_done_here():
    other = BesideByProcess(int)
    [answer] = other.begin(partial(os.getpid))
    child = the_child()
    assert answer.result() == child.pid
    before, behind = other.begin(os.getpid, os.getpid)
    child.kill()
    child.join()
    assert {before.result(), behind.result()} <= {child.pid, os.getpid()}
    here, refused = other.begin(os.getpid, partial(refuse, "here"))
    assert here.result() == os.getpid()
    assert isinstance(refused.exception(), InfeasibleError)


def test_the_process_ends_with_the_one_that_began_it():
    with subprocess.Popen([sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        number = int(parent.stdout.readline())
        os.kill(number, 0)  # it is there
        parent.kill()
    assert until(lambda: not alive(number))


def alive(number: int) -> bool:
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{number}/stat")  # one that nobody has waited for is dead
    return not state.exists() or state.read_text().rsplit(")", 1)[1].split()[0] != "Z"
