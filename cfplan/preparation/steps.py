"""The steps of preparing a flight, reported one by one to whoever shows or times them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum

from cfplan.errors import CfplanError


class StepState(Enum):
    """How far a step is."""

    BEGUN = "begun"
    FINISHED = "finished"
    FAILED = "failed"


OnStep = Callable[[str, StepState, str], None]  # name of the step, how far it is, its result in one line


def ignore_steps(name: str, state: StepState, result: str) -> None:
    """Show nothing."""


@contextmanager
def step(on_step: OnStep, name: str) -> Iterator[list[str]]:
    """Report the block as a step. What the block appends to the list is the step's result, joined by commas."""
    on_step(name, StepState.BEGUN, "")
    results: list[str] = []
    try:
        yield results
    except CfplanError:
        on_step(name, StepState.FAILED, "")
        raise
    on_step(name, StepState.FINISHED, ", ".join(results))
