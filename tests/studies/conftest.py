"""The study of lateness with flights that are not flown."""

from dataclasses import fields
from pathlib import Path

import pytest

from studies import lateness
from studies.lateness import WakeUps, lateness_study

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture
def study(monkeypatch):
    """A function from flights to the study of them; nothing is given up, as other tests may need it."""
    given_up, flights = [], []
    monkeypatch.setattr(lateness, "give_up_priority", lambda: given_up.append(True))
    monkeypatch.setattr(lateness, "fly_in_real_time", lambda *_, **__: flights.pop(0)())

    def run(*ends, permitted=True):
        monkeypatch.setattr(lateness, "may_use_fifo_scheduling", lambda: permitted)
        flights.extend(ends)
        result = lateness_study(REPOSITORY / "flights" / "line.yaml", REPOSITORY / "safety.yaml", 0.1)
        assert given_up == [True]
        return result

    return run


@pytest.fixture
def measured():
    """A function from the study's result to its rows."""
    names = [field.name for field in fields(WakeUps)]
    return lambda result: [
        WakeUps(**{name: row[name] for name in names if name in row}) for row in result.table("lateness").rows
    ]
