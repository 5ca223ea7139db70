"""What limits bind, at thousands of points: some 50 ns each where the map of `flatness` alone takes three times that.

Points are taken side by side, WIDTH at a time. A panel holds the rows of one quantity each, WIDTH long, one behind the
other in one array: at a fixed distance from each other, so that the compiler knows that they do not overlap, and
works on several points with one instruction.
"""

import zlib
from collections.abc import Callable
from pathlib import Path as FilePath

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.flatness import Body, compiled_body, flat_state, profile_within
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trigonometry import cosine, sine

# What `dense_rows` gives, by row: squares of norms, components, and thrusts of motors 1 to 4.
SPEED, ACCELERATION, BODY_RATE, ANGULAR_ACCELERATION = range(4)
# squared: m²/s², m²/s⁴, rad²/s², rad²/s⁴
AXIS_HEIGHT, AXIS_WIDTH = 4, 5
# of the unit thrust axis: its z, and the square of what it has besides
SPECIFIC_THRUST = 6
# m/s²
MOTOR_THRUST = 7
# N, and the three rows behind
ROWS = 11

WIDTH = 16
_X, _NODE, _RESULT = 12, 13, 20
# rows of a panel: behind γ' to γ'''' the place in the interval, the seven numbers of the profile where that begins, and
# what comes of them
_SIZE = (_RESULT + ROWS) * WIDTH


def dense_rows(
    airframe: Airframe, derivatives: NDArray, profile: SpeedProfile, places: NDArray, interval: NDArray
) -> NDArray:
    """(ROWS, N) at N points of a path, whose `derivatives` γ' to γ'''', (4, 3, N), are known.

    `places`, (N,), is s less that of the grid point at which each point's `interval`, (N,), begins.
    """
    count = len(places)
    if count < WIDTH:  # less than a panel: the first point again and again
        more = np.r_[:count, np.zeros(WIDTH - count, dtype=int)]
        return dense_rows(airframe, derivatives[:, :, more], profile, places[more], interval[more])[:, :count]
    out = np.empty((ROWS, count))
    _at_points(
        out, compiled_body(airframe), np.ascontiguousarray(derivatives, dtype=float).reshape(12, -1), places, interval,
        profile.h, profile.dh, profile.ddh, profile.dddh, profile.yaw, profile.dyaw, profile.ddyaw,
    )  # fmt: skip
    return out


def _compile(sources: int) -> Callable[..., int]:
    """The loop, which returns `sources`: a checksum of what it calls, as numba's cache does not look there."""

    @njit(cache=True, error_model="numpy")
    def at_points(
        out: NDArray, body: Body, derivatives: NDArray, places: NDArray, interval: NDArray,
        h: NDArray, dh: NDArray, ddh: NDArray, dddh: NDArray, yaw: NDArray, dyaw: NDArray, ddyaw: NDArray,
    ) -> int:  # fmt: skip
        panel = np.empty(_SIZE)
        for start in range(0, len(places), WIDTH):
            begin = min(start, len(places) - WIDTH)
            for row in range(12):
                for n in range(WIDTH):
                    panel[row * WIDTH + n] = derivatives[row, begin + n]
            for n in range(WIDTH):
                i = interval[begin + n]
                panel[_X * WIDTH + n] = places[begin + n]
                panel[(_NODE + 0) * WIDTH + n] = h[i]
                panel[(_NODE + 1) * WIDTH + n] = dh[i]
                panel[(_NODE + 2) * WIDTH + n] = ddh[i]
                panel[(_NODE + 3) * WIDTH + n] = dddh[i]
                panel[(_NODE + 4) * WIDTH + n] = yaw[i]
                panel[(_NODE + 5) * WIDTH + n] = dyaw[i]
                panel[(_NODE + 6) * WIDTH + n] = ddyaw[i]
            _flatten(panel, body)
            for row in range(ROWS):
                for n in range(WIDTH):
                    out[row, begin + n] = panel[(_RESULT + row) * WIDTH + n]
        return sources

    return at_points


@register_jitable
def _flatten(panel: NDArray, body: Body) -> None:
    """Fill the rows of results from those of the path and the profile, at every place of the panel."""
    for n in range(WIDTH):
        speed, turn = profile_within(
            panel[_X * WIDTH + n],
            *_vector(panel, _NODE, n),
            panel[(_NODE + 3) * WIDTH + n],
            *_vector(panel, _NODE + 4, n),
        )
        flat = flat_state(
            body,
            (_vector(panel, 0, n), _vector(panel, 3, n), _vector(panel, 6, n), _vector(panel, 9, n)),
            speed,
            turn,
            cosine,
            sine,
        )
        axis = flat.thrust_axis
        panel[(_RESULT + SPEED) * WIDTH + n] = _squared(flat.velocity)
        panel[(_RESULT + ACCELERATION) * WIDTH + n] = _squared(flat.acceleration)
        panel[(_RESULT + BODY_RATE) * WIDTH + n] = _squared(flat.body_rate)
        panel[(_RESULT + ANGULAR_ACCELERATION) * WIDTH + n] = _squared(flat.angular_acceleration)
        panel[(_RESULT + AXIS_HEIGHT) * WIDTH + n] = axis[2]
        panel[(_RESULT + AXIS_WIDTH) * WIDTH + n] = axis[0] * axis[0] + axis[1] * axis[1]
        panel[(_RESULT + SPECIFIC_THRUST) * WIDTH + n] = flat.specific_thrust
        panel[(_RESULT + MOTOR_THRUST) * WIDTH + n] = flat.motor_thrust[0]
        panel[(_RESULT + MOTOR_THRUST + 1) * WIDTH + n] = flat.motor_thrust[1]
        panel[(_RESULT + MOTOR_THRUST + 2) * WIDTH + n] = flat.motor_thrust[2]
        panel[(_RESULT + MOTOR_THRUST + 3) * WIDTH + n] = flat.motor_thrust[3]


@register_jitable(forceinline=True)
def _vector(panel: NDArray, row: int, n: int) -> tuple[float, float, float]:
    return panel[row * WIDTH + n], panel[(row + 1) * WIDTH + n], panel[(row + 2) * WIDTH + n]


@register_jitable(forceinline=True)
def _squared(vector: tuple[float, float, float]) -> float:
    return vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]


_CALLED = [FilePath(__file__).with_name(name).read_bytes() for name in ("flatness.py", "trigonometry.py")]
_at_points = _compile(zlib.crc32(b"".join(_CALLED)))
