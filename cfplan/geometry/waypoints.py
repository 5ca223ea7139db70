"""Regions in which a path may pass a waypoint: a ball around it, or a gate."""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Within:
    """A ball around the waypoint."""

    radius: float  # m, positive

    def turned(self, _yaw: float) -> Self:
        """Return the same in a frame turned about z."""
        return self


@dataclass(frozen=True, slots=True)
class Gate:
    """An upright opening around the waypoint, passed through in the direction of its yaw."""

    yaw: float  # rad
    width: float  # m, positive
    height: float  # m, positive

    @property
    def forwards(self) -> NDArray:
        """Return the direction in which it is passed, a unit vector, (3,)."""
        return np.array([math.cos(self.yaw), math.sin(self.yaw), 0.0])

    def half_axes(self, margin: float) -> NDArray:
        """Return half of its width and half of its height as rows, (2, 3) m, less a margin, m, at each side."""
        across = np.array([-math.sin(self.yaw), math.cos(self.yaw), 0.0])
        return np.stack([(self.width / 2 - margin) * across, (self.height / 2 - margin) * np.array([0.0, 0.0, 1.0])])

    def turned(self, yaw: float) -> Self:
        """Return the same in a frame turned about z by `yaw`, rad."""
        return replace(self, yaw=self.yaw + yaw)


Region = Within | Gate | None  # None: exactly at the waypoint
