"""A step is one line when it ends; a wait of more than a second says what it is and how long it has taken."""

import io

import click
import pytest
from rich.console import Console

from cfplan.cli import output, tables
from cfplan.cli.output import Steps
from cfplan.errors import InputError
from cfplan.flight.clock import SteppedClock


@pytest.fixture
def clock():
    return SteppedClock()


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


def test_a_long_step_says_meanwhile_what_is_waited_for(capsys, clock):
    with Steps(as_json=False, clock=clock).step("plan"):
        clock.sleep(0.9)
        assert capsys.readouterr().out == ""
        clock.sleep(5.0)
    first, second, last = capsys.readouterr().out.splitlines()
    assert (first, second) == ("… plan, 1 s", "… plan, 5 s")
    assert last.startswith("✓ plan")
    assert "5900 ms" in last


def test_what_else_goes_on_is_said_too(capsys, clock):
    steps = Steps(as_json=False, clock=clock)
    steps.meanwhile = lambda: "compiling 3 of 20"
    with steps.step("plan"):
        clock.sleep(1.5)
    assert capsys.readouterr().out.splitlines()[0] == "… plan, 1 s (compiling 3 of 20)"


def test_waiting_prints_nothing_at_its_end(capsys, clock):
    steps = Steps(as_json=False, clock=clock)
    with steps.waiting("loading"):
        pass
    assert capsys.readouterr().out == ""
    with steps.waiting("loading"):
        clock.sleep(1.5)
    clock.sleep(100.0)
    assert capsys.readouterr().out.splitlines() == ["… loading, 1 s"]


def test_a_reader_that_went_away_is_no_error_of_a_wait(monkeypatch, clock):
    def gone(*_, **__):
        raise BrokenPipeError

    with Steps(as_json=False, clock=clock).waiting("loading"):
        monkeypatch.setattr(output.click, "echo", gone)
        clock.sleep(10.0)


def test_json_is_alone_on_standard_output(capsys, clock):
    with Steps(as_json=True, clock=clock).step("plan"):
        clock.sleep(5.0)
    assert capsys.readouterr().out == ""


def test_details_of_a_step_are_for_those_who_ask(capsys):
    def print_steps():
        with Steps(as_json=False).step("plan") as results:
            results.append("3.87 s")
            results.details.append("convex 4.09 s")
        return capsys.readouterr().out

    assert "convex" not in print_steps()
    with click.Context(click.Command("fly")) as context:
        context.meta[output.VERBOSE] = True
        assert print_steps().splitlines()[1].strip() == "convex 4.09 s"


def test_a_long_result_goes_on_under_its_beginning(capsys, monkeypatch):
    monkeypatch.setattr(output.sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "80")
    with Steps(as_json=False).step("slowing") as results:
        results.append("word " * 40)
    lines = capsys.readouterr().out.splitlines()
    assert all(len(click.unstyle(line)) <= 80 for line in lines)
    assert len({len(line) - len(line.lstrip()) for line in lines[1:]}) == 1
    assert lines[1].startswith(" " * 20)


@pytest.mark.parametrize("columns", [None, "60"])
def test_a_table_in_a_pipe_is_as_narrow_as_a_terminal(capsys, monkeypatch, columns):
    monkeypatch.delenv("COLUMNS", raising=False)
    if columns is not None:
        monkeypatch.setenv("COLUMNS", columns)
    heads = ["name", *(f"figure {n}" for n in range(9))]
    output.print_table("A title of many words " * 4, heads, [["a", *["1.0"] * 9]])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= int(columns or 80)
    assert all(line == line.rstrip() for line in lines)


@pytest.mark.parametrize(("set_to", "coloured"), [(None, True), ("", True), ("1", False)])
def test_no_color_is_obeyed(monkeypatch, set_to, coloured):
    monkeypatch.delenv("NO_COLOR", raising=False)
    if set_to is not None:
        monkeypatch.setenv("NO_COLOR", set_to)
    assert ("\x1b[" in output.styled("✓", "green")) is coloured


WIDE = [["learned, refined", *(f"{number:.1f} ms" for number in range(15))], ["convex", *["–"] * 15]]


@pytest.mark.parametrize(
    ("columns", "rows"),
    [
        (["planner", *(f"figure {number}" for number in range(15))], WIDE),
        (["", "found", "verdict", "hint"], [["radio", "no Crazyradio is plugged in", "optional", "plug one in; " * 5]]),
        (
            ["planner", "plan, median", "to certificate, median", "speed-up, median"],
            [[f"{name}, refined", "801.1 ms", "2407.7 ms", "124.0×"] for name in ("learned", "expert", "convex")] * 3,
        ),
        (["limit", "worst", "allowed"], [["angular acceleration", "34.93 rad/s²", "35.00"]]),
        (["", "flown [1]", "of [red]two"], [["a [b]", "1.0 m", "–"]]),
        (["", "value"], [["streamed", "655, each as committed, until a pose was too old, after 6.55 s"]]),
    ],
)
def test_tables_fit_80_columns_with_every_cell_whole(columns, rows):
    console = Console(width=80, file=io.StringIO())
    tables.print_fitting(console, "title", columns, rows)
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert "\N{NO-BREAK SPACE}" not in "".join(lines)
    words = {word for line in lines for word in line.split()}
    assert {word for text in (*columns, *(cell for row in rows for cell in row)) for word in text.split()} <= words
