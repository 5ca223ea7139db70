"""All tables of the paper: results of the present sources and settings are kept, others are measured again."""

from dataclasses import replace

import pytest
from click.testing import CliRunner

from cfplan.errors import InputError
from studies import STUDIES
from studies.paper.all_tables import QUICK, paper_results
from studies.runner.commands import studies
from studies.runner.result import read_result

CHEAP = {"yaw-consistency": {"pairs": 1, "seed": 50_003}}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return the folder of one result."""
    folder = tmp_path_factory.mktemp("results")
    (first,) = paper_results(folder, quick=True, studies=CHEAP)
    assert not first.kept
    return folder


def test_what_was_made_of_the_present_sources_is_kept(made):
    (again,) = paper_results(made, quick=True, studies=CHEAP)
    assert again.kept
    assert again.result.table("differences").rows
    assert again.result.seconds > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("change", ["sources", "settings", "interrupted"])
def test_a_result_of_other_sources_or_settings_or_an_unfinished_one_is_made_anew(made, change, tmp_path):
    result = read_result(made / "yaw-consistency.json")
    other = {
        "sources": {"provenance": replace(result.provenance, sources="others")},
        "settings": {"settings": result.settings | {"seed": 3}},
        "interrupted": {"interrupted": True},
    }[change]
    replace(result, **other).write(tmp_path / "yaw-consistency.json")
    (again,) = paper_results(tmp_path, quick=True, studies=CHEAP)
    assert not again.kept
    assert read_result(again.file).provenance.fresh


def test_each_study_of_the_paper_has_a_quick_run_and_a_folder_must_be_there(tmp_path):
    assert {STUDIES[name] for name in QUICK} == {module for module in STUDIES.values() if ".paper." in module}
    with pytest.raises(InputError, match="no such folder"):
        next(paper_results(tmp_path / "none"))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_quick_command_makes_every_table_on_data_of_its_own_and_says_what_each_took(tmp_path):
    done = CliRunner().invoke(studies, ["paper", str(tmp_path), "--quick"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    for name in QUICK:
        result = read_result(tmp_path / f"{name}.json")
        assert not result.interrupted
        assert all(table.rows for table in result.tables if table.name != "long"), name
        assert f"{name}.json: {result.seconds:.0f} s" in done.output
    assert sum(read_result(tmp_path / f"{name}.json").seconds for name in QUICK) < 600
