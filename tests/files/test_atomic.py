"""New files appear complete or not at all, and overwrite nothing unasked."""

import os
import re

import pytest

from cfplan.errors import InputError
from cfplan.files.atomic import atomic_write, check_new_file, write_atomically


def test_a_file_is_replaced_in_one_step_and_may_be_read_by_those_who_may(tmp_path):
    file = tmp_path / "plan.json"
    file.write_text("old")
    with atomic_write(file) as unfinished:
        unfinished.write_text("new")
        assert file.read_text() == "old"
    assert file.read_text() == "new"
    other = tmp_path / "other"
    other.touch()
    assert file.stat().st_mode == other.stat().st_mode
    assert sorted(os.listdir(tmp_path)) == ["other", "plan.json"]


def test_what_fails_while_it_is_written_leaves_the_old_one_and_nothing_else(tmp_path):
    file = tmp_path / "plan.json"
    file.write_text("old")

    def fail():
        with atomic_write(file) as unfinished:
            unfinished.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert file.read_text() == "old"
    assert os.listdir(tmp_path) == ["plan.json"]


def test_two_writers_of_a_file_at_once_do_not_disturb_each_other(tmp_path):
    file = tmp_path / "plan.json"
    with atomic_write(file) as first:
        first.write_text("first")
        with atomic_write(file) as second:
            second.write_text("second")
        assert file.read_text() == "second"
    assert file.read_text() == "first"
    assert os.listdir(tmp_path) == ["plan.json"]


def test_the_content_is_on_disk_before_it_takes_the_place_of_the_old_one(tmp_path, monkeypatch):
    file, synced = tmp_path / "plan.json", []
    file.write_text("old")
    monkeypatch.setattr(os, "fsync", lambda opened: synced.append((os.fstat(opened.fileno()), file.read_text())))
    write_atomically(file, b"new")
    ((written, before),) = synced
    assert before == "old"
    assert os.path.samestat(written, file.stat())
    assert written.st_size == len(b"new")


def test_a_device_is_no_file_and_stays(tmp_path):
    link = tmp_path / "null"
    link.symlink_to("/dev/null")
    with pytest.raises(InputError, match="not a regular file"):
        write_atomically(link, b"content")
    assert link.is_symlink()


@pytest.mark.parametrize("place", ["nowhere/plan.json", "folder"])
def test_where_nothing_can_be_written_is_an_error_with_the_place(tmp_path, place):
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=r"cannot be written|not a regular file") as caught:
        write_atomically(tmp_path / place, b"content")
    assert caught.value.where == str(tmp_path / place)
    assert os.listdir(tmp_path) == ["folder"]


@pytest.mark.parametrize(
    ("name", "error"),
    [("a.txt", "must end in .png, .pdf"), ("nowhere/a.png", "no such folder"), ("there.pdf", "exists already")],
)
def test_where_no_new_file_may_be_is_told_before_it_is_made(tmp_path, name, error):
    (tmp_path / "there.pdf").touch()
    with pytest.raises(InputError, match=re.escape(error)):
        check_new_file(tmp_path / name, ".png", ".pdf", overwrite=False)
    check_new_file(tmp_path / "there.pdf", ".png", ".pdf", overwrite=True)
    check_new_file(tmp_path / "a.png", ".png", ".pdf", overwrite=False)
