"""Text files: pipes are read where somebody writes to them, and never waited for without end."""

import os
import threading

import pytest

from cfplan.errors import InputError
from cfplan.files import text
from cfplan.files.text import read_text
from cfplan.planning.plan_file import load_plan
from cfplan.recording.importers.formats import read_log
from cfplan.recording.reader import is_record, read_record


@pytest.fixture
def pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    return tmp_path / "pipe"


def test_a_pipe_that_nobody_writes_to_is_refused(pipe, monkeypatch):
    monkeypatch.setattr(text, "PIPE_PATIENCE", 0.05)
    with pytest.raises(InputError, match="gave nothing") as error:
        read_text(pipe)
    assert error.value.where == str(pipe)
    assert error.value.hint


def test_a_pipe_is_read_to_its_end(pipe):
    words = "1 2 3\n" * 50_000
    threading.Thread(target=pipe.write_text, args=(words,), daemon=True).start()
    assert read_text(pipe) == words


@pytest.mark.parametrize("read", [read_log, read_record, load_plan])
def test_a_log_a_record_and_a_plan_are_files(pipe, read):
    with pytest.raises(InputError, match="a pipe"):
        read(pipe)
    assert not is_record(pipe)
