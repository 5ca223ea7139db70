"""The tables in docs/ are what `cfplan study docs` makes of results/, and a result survives its file."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from cfplan.errors import InputError
from studies.runner.docs_tables import pages_of, with_tables
from studies.runner.provenance import provenance
from studies.runner.result import Column, StudyResult, Table, collect, read_result

pytestmark = pytest.mark.unit
REPOSITORY = Path(__file__).parents[2]
PAGES = pages_of(REPOSITORY)
OF_WORDS = {"| | the paper says | measured here | the difference |", "| | the paper | here |"}
COLUMNS = (
    Column("path", "path"),
    Column("landed", "landed", of="flights", meaning="at the end of its plan"),
    Column("flights"),
    Column("deviation", "deviation", "cm", ".1f"),
)


def result(deviation=0.0314):
    row = {"path": "line", "landed": 4, "flights": 5, "deviation": deviation}
    return StudyResult("flights", {"seed": 7}, (Table("all", "Flights", COLUMNS, (row,)),))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_the_tables_of_a_page_are_those_of_the_results(page):
    text = page.read_text(encoding="utf-8")
    assert with_tables(text, REPOSITORY) == text, "cfplan study docs writes the tables anew"


def test_every_result_has_its_tables_on_a_page():
    pages = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    for file in (REPOSITORY / "results").glob("*.json"):
        for table in (table for table in read_result(file).tables if table.rows):
            assert f"<!-- table: results/{file.name}#{table.name} -->" in pages


def test_tables_of_results_are_made_by_commands():
    """All but two of words: what the paper claims beside what was found, and on which terms it is repeated here."""
    for page in (REPOSITORY / "docs" / "results").glob("*.md"):
        text = re.sub(r"<!-- \w[\w-]*: .*?<!-- end -->", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        heads = re.findall(r"^(\|.*)\n\|[-| ]+\|$", text, re.MULTILINE)
        assert set(heads) <= (OF_WORDS if page.name == "paper.md" else set()), page.name


def test_every_result_says_of_which_commit_it_is():
    for file in (REPOSITORY / "results").glob("*.json"):
        made = read_result(file).provenance
        assert len(made.commit) == 40
        assert made.command.startswith("cfplan ")


def test_a_result_survives_its_file(tmp_path):
    result().write(tmp_path / "flights.json")
    assert read_result(tmp_path / "flights.json") == result()


def test_a_figure_within_a_line_is_that_of_its_cell(tmp_path):
    result().write(tmp_path / "flights.json")
    deviation, landed = (f"<!-- figure: flights.json#all/line/{key} -->" for key in ("deviation", "landed"))
    line = f"off by {deviation}?<!-- end -->, {landed}<!-- end --> landed"
    assert with_tables(line, tmp_path) == f"off by {deviation}3.1 cm<!-- end -->, {landed}4/5<!-- end --> landed"
    with pytest.raises(InputError, match="no cell circle/deviation"):
        with_tables(line.replace("/line/", "/circle/"), tmp_path)


def test_a_figure_is_of_the_row_that_its_first_columns_name(tmp_path):
    columns = (Column("model", "model"), Column("hidden"), Column("epsilon", "ε", "m", "g"), Column("0 to 0.5", "few"))
    rows = [("pos/vel", 0.01, 2), ("pos/vel", 0.1, 3), ("pos", 0.1, 5)]
    table = Table(
        "all", "", columns, tuple({"model": m, "hidden": 1, "epsilon": e, "0 to 0.5": few} for m, e, few in rows)
    )
    StudyResult("robustness", {}, (table,)).write(tmp_path / "robustness.json")

    def figure(row):
        marker = f"<!-- figure: robustness.json#all/{row}/0 to 0.5 -->"
        return with_tables(f"{marker}?<!-- end -->", tmp_path).removeprefix(marker)

    assert figure("pos/vel / 0.01 m") == "2<!-- end -->"
    assert figure("pos/vel / 0.1 m") == "3<!-- end -->"
    assert figure("pos") == "5<!-- end -->"
    with pytest.raises(InputError, match="'all' has 2 rows pos/vel"):
        figure("pos/vel")
    with pytest.raises(InputError, match="no cell pos/vel / 1 m"):
        figure("pos/vel / 1 m")


def test_a_block_is_replaced_by_title_and_cells_and_nothing_else_changes(tmp_path):
    result().write(tmp_path / "flights.json")
    page = "before\n<!-- table: flights.json#all -->\nold\n<!-- end -->\nafter\n"
    text = with_tables(page, tmp_path)
    assert "| path | landed | deviation |" in text
    assert "| line | 4/5 | 3.1 cm |" in text
    assert "old" not in text
    assert text.startswith("before\n<!-- table")
    assert text.endswith("<!-- end -->\nafter\n")
    assert with_tables(text, tmp_path) == text


def test_meanings_and_provenance_have_blocks_too(tmp_path):
    result().write(tmp_path / "flights.json")
    page = "<!-- columns: flights.json#all -->\n<!-- end -->\n<!-- measured: flights.json -->\n<!-- end -->\n"
    text = with_tables(page, tmp_path)
    assert "- *landed*: at the end of its plan" in text
    assert f"    {provenance().command}" in text
    assert provenance().commit[:12] in text


def test_a_result_that_was_interrupted_says_so(tmp_path):
    replace(result(), interrupted=True).write(tmp_path / "flights.json")
    text = with_tables("<!-- measured: flights.json -->\n<!-- end -->\n", tmp_path)
    assert text.count("It was interrupted") == 1


def test_what_was_not_measured_is_a_dash():
    assert result(float("nan")).tables[0].cells()[1] == [["line", "4/5", "–"]]
    assert result(float("nan")).to_json()["tables"][0]["rows"] == [["line", 4, 5, None]]


def test_a_table_that_is_not_in_the_result_is_an_input_error(tmp_path):
    result().write(tmp_path / "flights.json")
    with pytest.raises(InputError, match="no table 'any'"):
        with_tables("<!-- table: flights.json#any -->\n<!-- end -->", tmp_path)


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"study": "bench"}'])
def test_a_file_that_is_no_result_is_an_input_error(tmp_path, content):
    (tmp_path / "bench.json").write_text(content)
    with pytest.raises(InputError, match="not the result of a study"):
        read_result(tmp_path / "bench.json")


def test_an_interrupt_keeps_what_was_yielded():
    def items():
        yield from (1, 2)
        raise KeyboardInterrupt

    assert collect(items()) == ([1, 2], True)
    assert collect(iter([3])) == ([3], False)
