"""Sine and cosine without branches, so that a compiler can vectorise them.

The polynomials are those of fdlibm (Sun Microsystems, 1993), good to the last bit or two of a double. They hold for
angles up to a million radians; beyond that, and for infinity, the result is meaningless (NaN stays NaN).
"""

import math
from typing import Any

import numpy as np
from numba.extending import register_jitable

_PER_QUARTER = 2.0 / math.pi
# π/2 in parts, the first two with trailing zeros, so that small multiples of them are exact.
_QUARTER = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_SINE = (
    -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04, 2.75573137070700676789e-06,
    -2.50507602534068634195e-08, 1.58969099521155010221e-10,
)  # fmt: skip
_COSINE = (
    4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05, -2.75573143513906633035e-07,
    2.08757232129817482790e-09, -1.13596475577881948265e-11,
)  # fmt: skip


@register_jitable(forceinline=True)
def sine(angle: float) -> float:
    """Return it for an angle, rad."""
    return wave(angle, 0.0, np.floor)


@register_jitable(forceinline=True)
def cosine(angle: float) -> float:
    """Return it for an angle, rad."""
    return wave(angle, 1.0, np.floor)


@register_jitable(forceinline=True)
def wave(angle: Any, quarters: float, floor: Any) -> Any:
    """Return sin(angle + quarters π/2) for 0 or 1 quarters; `floor` is that of the arithmetic in use."""
    turns = floor(angle * _PER_QUARTER + 0.5)
    x = ((angle - turns * _QUARTER[0]) - turns * _QUARTER[1]) - turns * _QUARTER[2]
    z = x * x
    s, c = _SINE, _COSINE
    sine = x + x * z * (s[0] + z * (s[1] + z * (s[2] + z * (s[3] + z * (s[4] + z * s[5])))))
    cosine = 1.0 - 0.5 * z + z * z * (c[0] + z * (c[1] + z * (c[2] + z * (c[3] + z * (c[4] + z * c[5])))))
    halves = floor(0.5 * (turns + quarters))
    odd, negative = turns + quarters - 2.0 * halves, halves - 2.0 * floor(0.5 * halves)  # 0 or 1
    return (1.0 - 2.0 * negative) * ((1.0 - odd) * sine + odd * cosine)
