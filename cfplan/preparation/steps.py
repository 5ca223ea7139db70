"""The steps of preparing a flight, reported one by one to whoever shows or times them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum

from cfplan.errors import CfplanError


class StepState(Enum):
    """How far a step is."""

    BEGUN = "begun"
    FINISHED = "finished"
    WARNED = "warned"  # finished, and a person should read the result
    FAILED = "failed"
    DETAIL = "detail"  # told after the end: what only some readers want to know


OnStep = Callable[[str, StepState, str], None]  # name of the step, how far it is, its result in one line


def ignore_steps(name: str, state: StepState, result: str) -> None:
    """Show nothing."""


class StepResults(list[str]):
    """What a step says at its end, whether that is a warning, and details that only some readers want."""

    def __init__(self) -> None:
        super().__init__()
        self.warning = False
        self.details: list[str] = []

    def warn(self, result: str) -> None:
        """Append a result that a person should read."""
        self.append(result)
        self.warning = True


@contextmanager
def step(on_step: OnStep, name: str) -> Iterator[StepResults]:
    """Report the block as a step. What the block appends to the list is the step's result, joined by commas."""
    on_step(name, StepState.BEGUN, "")
    results = StepResults()
    try:
        yield results
    except CfplanError:
        on_step(name, StepState.FAILED, "")
        raise
    on_step(name, StepState.WARNED if results.warning else StepState.FINISHED, ", ".join(results))
    for detail in results.details:
        on_step(name, StepState.DETAIL, detail)
