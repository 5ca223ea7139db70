"""Speed caps: a speed limit along a path, lower in places than the limit that holds everywhere."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import InputError

_BEYOND = 1e-9  # fraction of a path's length in s, rounding tolerance for a cap's points past its end


@dataclass(frozen=True, slots=True)
class SpeedCaps:
    """A speed at rising places along a path, linear between them and constant beyond the first and the last.

    Raises InputError if there is no place, a number is not finite, a speed is not positive, or places do not rise.
    """

    s: tuple[float, ...]
    speed: tuple[float, ...]  # m/s

    def __post_init__(self) -> None:
        if not self.s or len(self.s) != len(self.speed):
            raise InputError(
                f"speed caps need a speed at each place: {len(self.s)} places, {len(self.speed)} speeds",
                where="speed caps",
                hint="give as many speeds as places",
            )
        if not all(map(math.isfinite, self.s)) or any(b <= a for a, b in zip(self.s, self.s[1:], strict=False)):
            raise InputError("places of speed caps must be finite and rise", where="speed caps", hint="sort them by s")
        if not all(math.isfinite(speed) and speed > 0.0 for speed in self.speed):
            raise InputError("speed caps must be finite and positive", where="speed caps", hint="give speeds in m/s")

    @staticmethod
    def of(s: ArrayLike, speed: ArrayLike) -> "SpeedCaps":
        """Return caps from places, (K,), and speeds, (K,) m/s."""
        return SpeedCaps(tuple(np.asarray(s, float).tolist()), tuple(np.asarray(speed, float).tolist()))

    def at(self, s: ArrayLike) -> NDArray:
        """Return the cap at each s, m/s."""
        return np.interp(np.asarray(s, dtype=float), self.s, self.speed)

    def part(self, begin: float, end: float) -> "SpeedCaps":
        """Return the caps of a part of the path, with s from its beginning."""
        places = np.array(self.s)
        inside = places[(places > begin) & (places < end)]
        kept = np.concatenate([[begin], inside, [end]])
        return SpeedCaps.of(kept - begin, self.at(kept))

    def scaled(self, factor: float) -> "SpeedCaps":
        """Return the caps times a factor."""
        return SpeedCaps.of(self.s, factor * np.array(self.speed))

    def lie_within(self, end: float) -> bool:
        """Return whether all places are on a path from 0 to `end`."""
        return self.s[0] >= 0.0 and self.s[-1] <= end * (1.0 + _BEYOND)


def allowed_speed(limit: float, caps: SpeedCaps | None, s: NDArray) -> NDArray | float:
    """Return the speed allowed at each s, m/s: the limit, or the cap where that is lower."""
    return limit if caps is None else np.minimum(caps.at(s), limit)
