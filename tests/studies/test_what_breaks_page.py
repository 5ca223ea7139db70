"""docs/what-breaks.md has every time-out with the time at which it comes in the code, and a figure of them."""

import re
from pathlib import Path

import pytest

from cfplan.errors import InputError
from cfplan.flight.firmware import TIMEOUTS
from cfplan.simulation.virtual_crazyflie import supervisor
from cfplan.studies.docs_tables import with_tables
from cfplan.studies.time_outs import FIGURE, draw_time_outs, letters_of, time_outs, write_figure

pytestmark = pytest.mark.unit
REPOSITORY = Path(__file__).parents[2]
PAGE = (REPOSITORY / "docs" / "what-breaks.md").read_text(encoding="utf-8")
SAFETY = (REPOSITORY / "safety.yaml").read_text(encoding="utf-8")


def after(table, what, folder=REPOSITORY):
    """The time, s, of the first row that begins so."""
    return next(row.after for row in time_outs(folder)[table] if row.what.startswith(what))


def test_each_table_is_on_the_page():
    assert re.findall(r"<!-- time-outs: (\S+) -->", PAGE) == [*time_outs(REPOSITORY)]


def test_what_the_vehicle_does_alone_is_what_its_simulated_supervisor_does():
    assert after("alone", "setpoints: the pilot") == supervisor.LEVEL_OUT_AFTER / 1e3
    assert after("alone", "setpoints, where the watchdog") == supervisor.SHUT_DOWN_AFTER / 1e3
    assert len(TIMEOUTS) == 1, "the page must say which firmware has which"


def test_times_of_safety_yaml_are_those_of_the_file(tmp_path):
    """Another safety.yaml makes another page: no time of it is written down twice."""
    changed = SAFETY.replace("age_brake: 0.15", "age_brake: 0.21").replace("lateness: 0.005", "lateness: 0.004")
    (tmp_path / "safety.yaml").write_text(changed)
    assert after("poses", "poses", tmp_path) == 0.21
    assert after("computer", "one deadline", tmp_path) == 0.004
    page = with_tables("<!-- time-outs: poses -->\n<!-- end -->", tmp_path)
    assert "| poses | 0.21 s |" in page


def test_each_key_is_one_of_safety_yaml_and_each_module_is_there():
    for rows in time_outs(REPOSITORY).values():
        for row in rows:
            section, _, key = row.where.partition(":")[0].partition(".")
            module = REPOSITORY / "cfplan" / row.where
            assert row.where.startswith("supervisor.") or (
                module.is_file() if row.where.endswith(".py") else re.search(rf"^ *{key or section}:", SAFETY, re.M)
            ), row.where


def test_the_figure_says_what_the_code_does():
    """Letters, as another version of matplotlib has other strokes."""
    assert letters_of((REPOSITORY / FIGURE).read_text(encoding="utf-8")) == letters_of(draw_time_outs(REPOSITORY))


def test_the_figure_is_drawn_anew_only_where_it_differs(tmp_path):
    (tmp_path / "safety.yaml").write_text(SAFETY)
    assert write_figure(tmp_path) == tmp_path / FIGURE
    assert write_figure(tmp_path) is None
    (tmp_path / "safety.yaml").write_text(SAFETY.replace("age_land: 0.5", "age_land: 0.7"))
    assert write_figure(tmp_path) == tmp_path / FIGURE
    assert "0.7" in letters_of((tmp_path / FIGURE).read_text())


def test_a_table_that_is_not_there_is_an_input_error():
    with pytest.raises(InputError, match="no such table"):
        with_tables("<!-- time-outs: nothing -->\n<!-- end -->", REPOSITORY)
