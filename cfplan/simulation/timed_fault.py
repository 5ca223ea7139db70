"""The base of the simulated faults of vehicle, radio and cameras: a kind, a start, a duration and a size."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from cfplan.errors import InputError


@dataclass(frozen=True, slots=True)
class TimedFault:
    """One fault."""

    kind: StrEnum
    start: float = 0.0  # s since it was injected
    duration: float = math.inf  # s
    size: float | None = None  # in the unit of its kind; None for the usual one
    usual: ClassVar[Mapping[StrEnum, float]] = {}

    def __post_init__(self) -> None:
        if math.isnan(self.start) or not self.duration > 0 or (self.size is not None and not math.isfinite(self.size)):
            raise InputError(f"{self} is not a fault", hint="a fault has a start, a positive duration and a size")

    @property
    def strength(self) -> float:
        """Return the size, or the usual one if none is given."""
        return self.usual.get(self.kind, 0.0) if self.size is None else self.size
