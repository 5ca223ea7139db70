"""All tables of the paper: what was made by this commit is kept, what was made by another is made anew."""

from dataclasses import replace
from types import MappingProxyType

import pytest

from cfplan.errors import InputError
from studies.paper import all_tables
from studies.paper.all_tables import QUICK, TABLES, paper_tables
from studies.runner.provenance import provenance
from studies.runner.result import StudyResult, read_result

NOW = replace(provenance(), commit="a" * 40, modified=False)


@pytest.fixture
def asked(monkeypatch):
    """The studies that were made, by a stand-in for each; of commit NOW."""
    monkeypatch.setattr(all_tables, "provenance", lambda: NOW)
    names: list[str] = []

    def study(name, interrupted=False):
        def make(progress, quick=False, **_):
            names.append(name)
            progress(1, 1)
            return StudyResult(name, {"quick": quick}, (), interrupted=interrupted, provenance=NOW)

        return make

    def run(folder, stopped="", **given):
        table = MappingProxyType({name: study(name, name == stopped) for name in ("inputs", "robustness")})
        names.clear()
        made = paper_tables(folder, tables=table, **given)
        return list(names), made

    return run


def test_a_run_that_was_stopped_goes_on(asked, tmp_path):
    assert asked(tmp_path, stopped="inputs")[0] == ["inputs"]
    assert asked(tmp_path, stopped="robustness")[0] == ["inputs", "robustness"]  # an interrupted result is no result
    names, made = asked(tmp_path)
    assert names == ["robustness"]
    assert [each.kept for each in made] == [True, False]
    assert asked(tmp_path)[0] == []


@pytest.mark.parametrize("other", [{"commit": "b" * 40}, {"modified": True}])
def test_results_of_other_code_are_made_anew(asked, tmp_path, other):
    asked(tmp_path)
    file = tmp_path / "inputs.json"
    replace(read_result(file), provenance=replace(NOW, **other)).write(file)
    assert asked(tmp_path)[0] == ["inputs"]


def test_quick_results_do_not_stand_for_whole_ones(asked, tmp_path):
    asked(tmp_path, quick=True)
    assert asked(tmp_path)[0] == ["inputs", "robustness"]


@pytest.mark.slow
def test_a_quick_run_makes_every_table_on_data_of_its_own_in_less_than_ten_minutes(tmp_path):
    made = paper_tables(tmp_path, quick=True)
    assert [each.file.stem for each in made] == list(TABLES)
    for each in made:
        assert not each.result.interrupted
        assert all(table.rows for table in each.result.tables if table.name != "long"), each.file.stem
        assert read_result(each.file).study == each.result.study
    assert sum(each.seconds for each in made) < 600  # of the processor


def test_every_table_has_a_quick_run_and_a_folder_must_be_there(tmp_path):
    assert set(QUICK) == set(TABLES)
    with pytest.raises(InputError, match="no such folder"):
        paper_tables(tmp_path / "none")
