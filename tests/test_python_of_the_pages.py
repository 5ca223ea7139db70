"""The Python that README and docs/ show runs as it stands there; what flies goes by the stepped clock."""

import re
import shutil
from functools import partial
from pathlib import Path

import pages
import pytest

import cfplan

REPOSITORY = Path(__file__).parents[1]
RUN_BY = {  # what a page shows, by the test that runs it
    "docs/contributing.md": "tests/test_contributing_page.py",
    "docs/export.md": "tests/integration/test_exports_by_scripts.py",
    "docs/fleets.md": "tests/integration/test_fleet_in_real_time.py",
    "docs/python.md": "tests/test_python_of_the_pages.py",
    "docs/steering.md": "tests/test_python_of_the_pages.py",
    "docs/virtual.md": "tests/simulation/lab/test_other_firmware.py",
}


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def test_every_page_with_python_has_a_test_that_runs_it():
    shown = {page.relative_to(REPOSITORY).as_posix() for page in pages.PAGES if blocks(page)}
    assert shown == set(RUN_BY)
    for page, test in RUN_BY.items():
        assert Path(page).name in (REPOSITORY / test).read_text()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    shutil.copytree(REPOSITORY / "flights", tmp_path / "flights")
    shutil.copy(REPOSITORY / "safety.yaml", tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_plans_are_made_saved_read_and_rehearsed(folder, capsys):
    names: dict = {}
    for block in blocks(REPOSITORY / "docs" / "python.md"):
        exec(block, names)
    said = capsys.readouterr().out
    assert "certified: True" in said
    assert "cm in 95 %" in said
    assert (folder / "mine.parquet").is_file()
    assert (folder / "mine.pdf").read_bytes().startswith(b"%PDF")


def test_a_vehicle_is_steered(folder, monkeypatch):
    monkeypatch.setattr(cfplan, "connect", partial(cfplan.connect, stepped=True))
    names: dict = {}
    for block in blocks(REPOSITORY / "docs" / "steering.md"):
        exec(block, names)
    assert names["vehicle"].outcome.reason == "landed"
