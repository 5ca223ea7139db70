"""Teleoperate by keys: each moves the place that the vehicle flies to, and it turns towards that without a stop.

    python examples/teleoperate.py
    python examples/teleoperate.py --uri radio://0/80/2M/E7E7E7E7E7 --mocap vicon://192.168.1.2/cf1

Arrows, or w a s d, move it along x and y, r and f up and down; x stops, q lands. Space lands and Esc cuts the motors,
as in every flight. The place stays within reach of the vehicle, so that it stops soon once no key is held. A place that
cannot be flown to is refused in words: then it is where the vehicle is going to rest anyway.
"""

import argparse
import math
from collections.abc import Callable, Iterable

import cfplan

STEP = 0.1  # m for each key
REACH = 1.2  # m from where the vehicle is asked to be now, that the place may be ahead
LOOK_PERIOD = 0.2  # s
MOVES = {
    "up": (1, 0, 0), "down": (-1, 0, 0), "left": (0, 1, 0), "right": (0, -1, 0),
    "w": (1, 0, 0), "s": (-1, 0, 0), "a": (0, 1, 0), "d": (0, -1, 0), "r": (0, 0, 1), "f": (0, 0, -1),
}  # fmt: skip


def fly(vehicle: cfplan.SteeredVehicle, keys: Callable[[], Iterable[str]]) -> int:
    """Fly as the keys say until one of them is q; return how many requests were flown."""
    vehicle.take_off(1.0)
    place, asked, accepted = vehicle.target, vehicle.target, 0
    while True:
        for key in keys():
            if key == "q":
                vehicle.land()
                return accepted
            if key == "x":
                vehicle.request(cfplan.Wish.STOP)
                place = asked = vehicle.target
            elif key in MOVES:
                place = within_reach(vehicle.target, [p + STEP * m for p, m in zip(place, MOVES[key], strict=True)])
        if place != asked:
            vehicle.request(cfplan.Wish.REPLACE, [place])
            asked = place
        vehicle.sleep(LOOK_PERIOD)
        for answer in vehicle.answers():
            if answer.verdict is cfplan.PathVerdict.ACCEPTED:
                accepted += 1
            elif answer.verdict is not cfplan.PathVerdict.SUPERSEDED:
                print(answer.reason)
                place = asked = vehicle.target


def within_reach(here: tuple[float, ...], place: list[float]) -> tuple[float, float, float]:
    """Return the place, or the farthest on the way there that is within reach."""
    share = min(1.0, REACH / max(math.dist(here, place), 1e-9))
    x, y, z = (h + share * (p - h) for h, p in zip(here, place, strict=True))
    return x, y, z


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--uri", default="sim://0")
    options.add_argument("--mocap")
    given = options.parse_args()
    with cfplan.connect(given.uri, mocap=given.mocap, name="teleoperated") as vehicle:
        accepted = fly(vehicle, vehicle.keys)
    print(f"{accepted} requests were flown; record: {vehicle.record}")
