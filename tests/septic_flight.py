"""A straight septic flight from rest to rest, encoded."""

import numpy as np

from cfplan.flight.setpoints.packets import FullStateSetpoints, encode

RATE = 100  # Hz


def septic_payloads(distance: float, duration: float, height: float, turn: float = 0.0) -> np.ndarray:
    """Return (N, 29) uint8: `distance` m along x, in `duration` s at `height` m, while yaw turns by `turn` rad."""
    u = np.linspace(0.0, 1.0, round(duration * RATE) + 1)
    share = 35 * u**4 - 84 * u**5 + 70 * u**6 - 20 * u**7
    along = distance * share
    speed = distance * (140 * u**3 - 420 * u**4 + 420 * u**5 - 140 * u**6) / duration
    slope = distance * (420 * u**2 - 1680 * u**3 + 2100 * u**4 - 840 * u**5) / duration**2
    yaw = turn * share
    zero = np.zeros_like(u)
    return encode(
        FullStateSetpoints(
            position=np.stack([along - distance / 2, zero, zero + height], axis=1),
            velocity=np.stack([speed, zero, zero], axis=1),
            acceleration=np.stack([slope, zero, zero], axis=1),
            quaternion=np.stack([zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)], axis=1),
            body_rate=np.zeros((len(u), 3)),
        )
    )
