"""Sine, cosine and arctangent without branches, so that a compiler can work on several points at once.

The polynomials are those of fdlibm (Sun Microsystems, 1993), good to the last bit or two of a double. They hold for
angles up to a million radians; beyond, and for what is not finite, the result is of no use (NaN stays NaN).
"""

import math

import numpy as np
from numba.extending import register_jitable

PER_QUARTER = 2.0 / math.pi
QUARTER = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
# π/2 in parts, the first two with zeros at their ends, so that a small multiple of them is exact
SINE = (
    -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04, 2.75573137070700676789e-06,
    -2.50507602534068634195e-08, 1.58969099521155010221e-10,
)  # fmt: skip
COSINE = (
    4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05, -2.75573143513906633035e-07,
    2.08757232129817482790e-09, -1.13596475577881948265e-11,
)  # fmt: skip
_ARCTANGENT = (
    3.33333333333329318027e-01, -1.99999999998764832476e-01, 1.42857142725034663711e-01, -1.11111104054623557880e-01,
    9.09088713343650656196e-02, -7.69187620504482999495e-02, 6.66107313738753120669e-02, -5.83357013379057348645e-02,
    4.97687799461593236017e-02, -3.65315727442169155270e-02, 1.62858201153657823623e-02,
)  # fmt: skip
_EIGHTH = math.tan(math.pi / 8)


@register_jitable(forceinline=True)
def sine(angle: float) -> float:
    """Of an angle, rad."""
    return _wave(angle, 0.0)


@register_jitable(forceinline=True)
def cosine(angle: float) -> float:
    """Of an angle, rad."""
    return _wave(angle, 1.0)


@register_jitable(forceinline=True)
def slope_angle(rise: float, run: float) -> float:
    """atan2(rise, run), rad, for rise ≥ 0; 0 where both are 0."""
    width = abs(run)
    large = rise if rise > width else width
    small = width if rise > width else rise
    # atan(small / large) = π/4 + atan((small - large) / (small + large))
    wide = small > _EIGHTH * large
    over = small - large if wide else small
    under = small + large if wide else large
    x = over / (under if under != 0.0 else 1.0)
    z = x * x
    angle = x - x * _series(z)
    angle = math.pi / 4 + angle if wide else angle
    angle = math.pi / 2 - angle if rise > width else angle
    return math.pi - angle if run < 0.0 else angle


@register_jitable(forceinline=True)
def _series(z: float) -> float:
    a = _ARCTANGENT
    value = a[9] + z * a[10]
    value = a[7] + z * (a[8] + z * value)
    value = a[5] + z * (a[6] + z * value)
    value = a[3] + z * (a[4] + z * value)
    value = a[1] + z * (a[2] + z * value)
    return z * (a[0] + z * value)


@register_jitable(forceinline=True)
def _wave(angle: float, quarters: float) -> float:
    """sin(angle + quarters π/2)."""
    turns = np.floor(angle * PER_QUARTER + 0.5)
    x = ((angle - turns * QUARTER[0]) - turns * QUARTER[1]) - turns * QUARTER[2]
    z = x * x
    s, c = SINE, COSINE
    sine = x + x * z * (s[0] + z * (s[1] + z * (s[2] + z * (s[3] + z * (s[4] + z * s[5])))))
    cosine = 1.0 - 0.5 * z + z * z * (c[0] + z * (c[1] + z * (c[2] + z * (c[3] + z * (c[4] + z * c[5])))))
    quadrant = turns + quarters
    quadrant = quadrant - 4.0 * np.floor(0.25 * quadrant)
    value = cosine if quadrant == 1.0 or quadrant == 3.0 else sine
    return -value if quadrant >= 2.0 else value
