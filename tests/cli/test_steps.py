"""A step is one line when it ends; a wait of more than a second says what it is and how long it has taken."""

import time

import pytest

from cfplan.cli import output
from cfplan.cli.output import Steps
from cfplan.errors import InputError


@pytest.fixture
def impatient(monkeypatch):
    """Waits are shown sooner."""
    monkeypatch.setattr(output, "_FIRST_NOTE", 0.05)
    monkeypatch.setattr(output, "_OTHER_NOTES", 0.05)


def test_a_quick_step_is_one_line_with_its_result(capsys):
    with Steps(as_json=False).step("path") as results:
        results += ["line", "6.4 m"]
    printed = capsys.readouterr().out
    assert printed.startswith("✓ path")
    assert printed.endswith("line, 6.4 m\n")
    assert printed.count("\n") == 1


def test_a_step_that_fails_is_marked(capsys):
    with pytest.raises(InputError), Steps(as_json=False).step("path"):
        raise InputError("no such file")
    assert capsys.readouterr().out.startswith("✗ path")


def test_names_with_escape_codes_do_not_reach_the_terminal(capsys):
    with Steps(as_json=False).step("read") as results:
        results.append("\x1b[2Jclear\nline \ud800 °")
    output.print_table("bodies", ["body"], [["\x1b[2Jclear"]])
    printed = capsys.readouterr().out
    assert "\x1b[2J" not in printed
    assert "\\x1b[2Jclear\\nline \\ud800 °" in printed


def test_a_step_with_a_warning_has_no_tick(capsys):
    with Steps(as_json=False).step("link loss") as results:
        results.warn("3.2 m beyond the walls")
    printed = capsys.readouterr().out
    assert printed.startswith("! link loss")
    assert "✓" not in printed


def test_a_long_step_says_meanwhile_what_is_waited_for(capsys, impatient):
    with Steps(as_json=False).step("plan"):
        time.sleep(0.5)
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first == "… plan, 0 s"
    assert last.startswith("✓ plan")


def test_waiting_prints_nothing_at_its_end(capsys, impatient):
    steps = Steps(as_json=False)
    with steps.waiting("loading"):
        pass
    assert capsys.readouterr().out == ""
    with steps.waiting("loading"):
        time.sleep(0.5)
    assert set(capsys.readouterr().out.splitlines()) == {"… loading, 0 s"}


def test_json_is_alone_on_standard_output(capsys, impatient):
    with Steps(as_json=True).step("plan"):
        time.sleep(0.2)
    assert capsys.readouterr().out == ""
