"""The notebook of the examples, its cells run one after the other in one namespace."""

import json
from pathlib import Path

import matplotlib as mpl
import pytest
from matplotlib.figure import Figure

from cfplan.simulation.dry_run import DryRun

NOTEBOOK = Path(__file__).parents[2] / "examples" / "notebook.ipynb"

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def ran():
    """What its code leaves behind."""
    mpl.use("Agg")
    names = {"__name__": "__main__"}
    for number, cell in enumerate(json.loads(NOTEBOOK.read_text())["cells"]):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{NOTEBOOK.name}, cell {number}", "exec"), names)
    return names


def test_it_plans_certifies_and_rehearses(ran):
    assert ran["plan"].certificate.passed
    assert ran["plan"].lower_bound() <= ran["plan"].duration
    assert isinstance(ran["rehearsed"], DryRun)
    assert ran["rehearsed"].passed


def test_it_draws_the_plan(ran):
    assert isinstance(ran["figure"], Figure)


def test_it_compares_planners(ran):
    compared = ran["compared"]
    assert all(plan.certificate.passed for plan in compared.values())
    assert abs(compared["learned"].duration / compared["expert"].duration - 1.0) < 0.01


def test_it_is_kept_without_outputs():
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)
