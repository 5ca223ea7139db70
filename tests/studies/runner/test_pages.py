"""Results on pages: README and docs/ show the contents of results/, and figures of other sources are marked."""

import re
from dataclasses import replace

import pytest

from cfplan.errors import InputError
from cfplan.version import REPOSITORY
from studies.runner.pages import OUT_OF_DATE, pages_of, stale_results, with_figures, with_results, write_figures
from studies.runner.provenance import provenance
from studies.runner.reductions import among, count, farthest, largest, mean, median, quantile, total
from studies.runner.result import Column, StudyResult, Table, quantile_columns, read_result, table

pytestmark = pytest.mark.unit
PAGES = pages_of(REPOSITORY)
MODULE = "studies.runner.study"
COLUMNS = (
    Column("path", "path"),
    Column("landed", "landed", of="flights", meaning="at the end of its plan"),
    Column("flights"),
    Column("deviation", "deviation", "cm", ".1f"),
)


def result(deviation=0.0314):
    row = {"path": "line", "landed": 4, "flights": 5, "deviation": deviation}
    return StudyResult(
        "flights", {"seed": 7}, (Table("all", "Flights", COLUMNS, (row,)),), provenance=provenance(MODULE)
    )


@pytest.fixture
def folder(tmp_path):
    result().write(tmp_path / "flights.json")
    return tmp_path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_the_figures_in_a_pages_sentences_are_those_of_the_results(page):
    text = page.read_text(encoding="utf-8")
    filled, shown = (each.replace(OUT_OF_DATE, "") for each in (with_figures(text, REPOSITORY), text))
    assert filled == shown, "python -m studies pages fills them in"


def test_every_result_has_its_tables_on_a_page():
    pages = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    for file in (REPOSITORY / "results").glob("*.json"):
        for each in (each for each in read_result(file).tables if each.rows):
            assert f"<!-- table: results/{file.name}#{each.name} -->" in pages


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_every_mark_of_a_page_names_something_in_a_result(page):
    with_results(page.read_text(encoding="utf-8"), REPOSITORY)


def test_a_figure_within_a_line_is_that_of_its_cell(folder):
    deviation, landed = (f"<!-- figure: flights.json#all/line/{key} -->" for key in ("deviation", "landed"))
    line = f"off by {deviation}?<!-- end -->, {landed}<!-- end --> landed"
    assert with_figures(line, folder) == f"off by {deviation}3.1 cm<!-- end -->, {landed}4/5<!-- end --> landed"
    with pytest.raises(InputError, match="no cell circle/deviation"):
        with_figures(line.replace("/line/", "/circle/"), folder)


def test_a_figure_of_other_sources_is_marked_and_a_release_refuses_it(folder):
    (folder / "docs").mkdir()
    (folder / "README.md").write_text("<!-- figure: flights.json#all/line/deviation --><!-- end -->\n")
    write_figures(folder)
    assert OUT_OF_DATE not in (folder / "README.md").read_text()
    assert stale_results(folder) == []
    made = replace(provenance(MODULE), sources="others")
    replace(result(), provenance=made).write(folder / "flights.json")
    write_figures(folder)
    assert f"3.1 cm{OUT_OF_DATE}<" in (folder / "README.md").read_text()
    assert stale_results(folder, [folder / "README.md"]) == ["flights.json"]
    assert "sources have changed" in with_results("<!-- measured: flights.json -->\n<!-- end -->", folder)


def test_readme_says_what_the_mark_means():
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    assert text.count(OUT_OF_DATE) != 1
    assert OUT_OF_DATE not in text or re.search(rf"^{OUT_OF_DATE} \w", text, re.MULTILINE)


def test_a_figure_is_of_the_row_that_its_first_columns_name(tmp_path):
    columns = (Column("model", "model"), Column("hidden"), Column("epsilon", "ε", "m", "g"), Column("0 to 0.5", "few"))
    rows = [("pos/vel", 0.01, 2), ("pos/vel", 0.1, 3), ("pos", 0.1, 5)]
    all_rows = tuple({"model": m, "hidden": 1, "epsilon": e, "0 to 0.5": few} for m, e, few in rows)
    StudyResult("robustness", {}, (Table("all", "", columns, all_rows),), provenance=provenance(MODULE)).write(
        tmp_path / "robustness.json"
    )

    def figure(row):
        marker = f"<!-- figure: robustness.json#all/{row}/0 to 0.5 -->"
        return with_figures(f"{marker}?<!-- end -->", tmp_path).removeprefix(marker)

    assert figure("pos/vel / 0.01 m") == "2<!-- end -->"
    assert figure("pos") == "5<!-- end -->"
    with pytest.raises(InputError, match="'all' has 2 rows pos/vel"):
        figure("pos/vel")
    with pytest.raises(InputError, match="no cell pos/vel / 1 m"):
        figure("pos/vel / 1 m")


def test_blocks_show_cells_meanings_and_where_they_come_from(folder):
    kinds = ("table: flights.json#all", "columns: flights.json#all", "measured: flights.json")
    page = "before\n" + "".join(f"<!-- {kind} -->\nold\n<!-- end -->\n" for kind in kinds) + "after\n"
    text = with_results(page, folder)
    for shown in ("| path | landed | deviation |", "| line | 4/5 | 3.1 cm |", "- *landed*: at the end of its plan"):
        assert shown in text
    assert f"    {provenance(MODULE).command}" in text
    assert provenance(MODULE).commit[:12] in text
    assert "old" not in text
    assert text.startswith("before\n<!-- table")
    assert text.endswith("<!-- end -->\nafter\n")
    assert with_results(text, folder) == text
    with pytest.raises(InputError, match="no table 'any'"):
        with_results("<!-- table: flights.json#any -->\n<!-- end -->", folder)


def test_a_result_that_was_interrupted_says_so(tmp_path):
    replace(result(), interrupted=True).write(tmp_path / "flights.json")
    assert "interrupted" in with_results("<!-- measured: flights.json -->\n<!-- end -->\n", tmp_path)


def test_what_was_not_measured_is_a_dash():
    assert result(float("nan")).tables[0].cells()[1] == [["line", "4/5", "–"]]
    assert result(float("nan")).to_json()["tables"][0]["rows"] == [["line", 4, 5, None]]


@pytest.mark.parametrize(("spec", "shown"), [("+.1f", "+0.0 cm"), (".1f", "0.0 cm"), ("", "-0.01 cm")])
def test_no_rounded_cell_says_minus_zero(spec, shown):
    assert Column("off", "off", "cm", spec).text({"off": -0.0001}) == shown


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"study": "bench"}'])
def test_a_file_that_is_no_result_is_an_input_error(tmp_path, content):
    (tmp_path / "bench.json").write_text(content)
    with pytest.raises(InputError, match="not the result of a study"):
        read_result(tmp_path / "bench.json")


ROWS = [{"path": path, "off": off} for path, off in (("a", 1.0), ("b", -4.0), ("a", 3.0), ("b", float("nan")))]


def off(row):
    return row["off"]


@pytest.mark.parametrize(
    ("reduction", "value"),
    [
        (count(), 4), (count(lambda row: row["path"] == "a"), 2), (mean(off), 0.0), (median(off), 1.0),
        (quantile(off, 1.0), 3.0), (largest(off), 3.0), (farthest(off), -4.0), (total(off), 0.0),
        (among(lambda row: row["path"] == "a", mean(off)), 2.0),
    ],
)  # fmt: skip
def test_reductions_pass_over_what_is_not_finite(reduction, value):
    assert reduction(ROWS) == value


def test_of_nothing_there_is_no_mean():
    assert str(mean(off)([])) == "nan"
    assert count()([]) == 0


def test_a_table_has_a_line_for_each_group_and_one_of_all():
    columns = (Column("path", "path"), Column("rows", "rows", value=count()), Column("off", value=mean(off)))
    shown = table("t", "", columns, ROWS, by=("path",), last="all")
    assert [(row["path"], row["rows"], row["off"]) for row in shown.rows] == [
        ("a", 2, 2.0), ("b", 2, -4.0), ("all", 4, 0.0)
    ]  # fmt: skip


def test_quantile_columns_are_of_the_rows():
    columns = quantile_columns("off", "off", "m", ".1f", off, shown=("median",))
    assert [column.title for column in columns] == ["off, median", "", ""]
    assert table("t", "", columns, ROWS, by=()).rows[0]["off_median"] == 1.0
