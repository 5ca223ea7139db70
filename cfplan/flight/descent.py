"""A landing by setpoints, for a vehicle whose on-board commander does not take over."""

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.packets import FullStateSetpoints, encode
from cfplan.flight.telemetry import Triple


def encode_descent(position: Triple, yaw: float, floor: float, duration: float, rate: float) -> NDArray:
    """(N, 29) uint8 at `rate`, Hz: straight down from a hover at `position`, m, to `floor`, m, in `duration`, s."""
    share = np.linspace(0.0, 1.0, max(round(duration * rate), 1) + 1)
    fall = floor - position[2]
    zero = np.zeros_like(share)
    height = position[2] + fall * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    speed = fall / duration * 30.0 * share**2 * (1.0 - share) ** 2
    change = fall / duration**2 * 60.0 * share * (1.0 - share) * (1.0 - 2.0 * share)
    return encode(
        FullStateSetpoints(
            position=np.stack([zero + position[0], zero + position[1], height], axis=1),
            velocity=np.stack([zero, zero, speed], axis=1),
            acceleration=np.stack([zero, zero, change], axis=1),
            quaternion=np.stack([zero, zero, zero + np.sin(yaw / 2), zero + np.cos(yaw / 2)], axis=1),
            body_rate=np.zeros((len(share), 3)),
        )
    )
