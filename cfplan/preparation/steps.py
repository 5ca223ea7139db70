"""The steps of preparing a flight, reported one by one to a listener."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum

from cfplan.errors import CfplanError


class StepState(Enum):
    """The progress of a step."""

    BEGUN = "begun"
    FINISHED = "finished"
    WARNED = "warned"  # finished, with a result that a person should read
    FAILED = "failed"
    DETAIL = "detail"  # reported after the end, for verbose output


OnStep = Callable[[str, StepState, str], None]  # name of the step, its progress, its result in one line


def ignore_steps(name: str, state: StepState, result: str) -> None:
    """Ignore all steps."""


class StepResults(list[str]):
    """Results of a step, whether they are a warning, and details for verbose output."""

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
    """Report the block as a step. Its result is what the block appends to the list, joined by commas."""
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
