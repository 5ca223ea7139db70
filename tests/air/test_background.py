"""Background checks: a thread and a process answer alike, and the death of the process changes nothing."""

import multiprocessing
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from waiting import until

from cfplan.air.background import ChecksByProcess, ChecksByThread
from cfplan.errors import InfeasibleError

PARENT = """
import multiprocessing
from functools import partial
from cfplan.air.background import ChecksByProcess
if __name__ == "__main__":
    other = ChecksByProcess(int)
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


@pytest.fixture(params=[ChecksByThread, partial(ChecksByProcess, int)], ids=["thread", "process"])
def other(request):
    return request.param()


def children():
    """Return the processes that do checks; other tests may have left others."""
    return [child for child in multiprocessing.active_children() if child.name == "checks"]


def the_child():
    [child] = children()
    return child


@pytest.fixture(autouse=True)
def _no_process_stays():
    yield
    for child in children():
        child.kill()
        child.join()


def test_each_check_has_its_answer_whichever_is_asked_for_first(other):
    first, refused, last = other.begin(partial(fill, 1.5, 4), partial(refuse, "there"), partial(int, 3))
    assert last.result() == 3
    with pytest.raises(InfeasibleError) as error:
        refused.result()
    assert (error.value.what, error.value.where, error.value.hint) == ("no way", "there", "another way")
    assert isinstance(refused.exception(), InfeasibleError)
    assert first.exception() is None
    np.testing.assert_array_equal(first.result(), np.full(4, 1.5))


def test_answers_that_nobody_asks_for_do_not_hold_up_the_next(other):
    """They, and what is asked next, are more than a pipe holds."""
    for value in range(3):
        *_, last = other.begin(*[partial(fill, value, 1_000_000)] * 2)
    np.testing.assert_array_equal(last.result(), np.full(1_000_000, 2.0))
    [answer] = other.begin(partial(len, np.zeros(1_000_000)))
    assert answer.result() == 1_000_000


def test_where_the_process_has_died_checks_are_done_here():
    other = ChecksByProcess(int)
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
