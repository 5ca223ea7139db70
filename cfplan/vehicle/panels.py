"""Panels: rows of numbers side by side in one array, for loops that take several points with one instruction.

A panel is (rows · WIDTH,): rows of one quantity each, WIDTH long, one behind the other. So the compiler knows that they
do not overlap. How many places of the rows are in use is known at run time only, else it would write the loops out; it
is a multiple of LANES, as what is left over would be taken one by one.
"""

from numba.extending import register_jitable
from numpy.typing import NDArray

WIDTH = 64
LANES = 8  # that an instruction may take


@register_jitable
def lanes_for(count: int) -> int:
    """Return how many places of a row are in use for so many points, WIDTH at most."""
    return min((count + LANES - 1) // LANES * LANES, WIDTH)


@register_jitable
def take_in(panel: NDArray, row: int, values: NDArray, begin: int, lanes: int) -> None:
    """Write (N, K) values from `begin` on to the panel, a column a row; the last of them repeats."""
    last = len(values) - 1
    for k in range(values.shape[1]):
        for n in range(lanes):
            panel[(row + k) * WIDTH + n] = values[min(begin + n, last), k]


@register_jitable
def give_out(values: NDArray, begin: int, panel: NDArray, row: int) -> None:
    """Write rows of the panel to (N, K) values from `begin` on, a row a column."""
    count = min(len(values) - begin, WIDTH)
    for k in range(values.shape[1]):
        for n in range(count):
            values[begin + n, k] = panel[(row + k) * WIDTH + n]


@register_jitable(forceinline=True)
def pair_in(panel: NDArray, row: int, n: int) -> tuple[float, float]:
    """Return what two rows have at a place."""
    return panel[row * WIDTH + n], panel[(row + 1) * WIDTH + n]


@register_jitable(forceinline=True)
def triple_in(panel: NDArray, row: int, n: int) -> tuple[float, float, float]:
    """Return what three rows have at a place."""
    return panel[row * WIDTH + n], panel[(row + 1) * WIDTH + n], panel[(row + 2) * WIDTH + n]


@register_jitable(forceinline=True)
def quaternion_in(panel: NDArray, row: int, n: int) -> tuple[float, float, float, float]:
    """Return what four rows have at a place."""
    x, y, z = triple_in(panel, row, n)
    return x, y, z, panel[(row + 3) * WIDTH + n]


@register_jitable(forceinline=True)
def write_pair(panel: NDArray, row: int, n: int, x: float, y: float) -> None:
    """Write two rows at a place."""
    panel[row * WIDTH + n], panel[(row + 1) * WIDTH + n] = x, y


@register_jitable(forceinline=True)
def write_triple(panel: NDArray, row: int, n: int, values: tuple[float, float, float]) -> None:
    """Write three rows at a place."""
    panel[row * WIDTH + n], panel[(row + 1) * WIDTH + n], panel[(row + 2) * WIDTH + n] = values


@register_jitable(forceinline=True)
def write_quaternion_in(panel: NDArray, row: int, n: int, values: tuple[float, float, float, float]) -> None:
    """Write four rows at a place."""
    write_triple(panel, row, n, values[:3])
    panel[(row + 3) * WIDTH + n] = values[3]
