"""Tour the room without an end: new random waypoints are appended before the old ones run out, so it never stops.

    python examples/random_tour.py --seconds 60

A waypoint that cannot be flown to from the motion there is refused, with the reason; another one is tried.
"""

import argparse
import random

import cfplan

LOW, HIGH = (-1.4, -2.5, 0.8), (1.4, 2.5, 1.3)  # m, inside the shipped safety.yaml's walls
IN_TIME = 2.5  # s before the end of what is committed, when more is asked for
TOGETHER = 3  # waypoints


def fly(vehicle: cfplan.SteeredVehicle, seconds: float, seed: int = 0) -> tuple[int, int]:
    """Tour for so many s; return how many requests were accepted and refused."""
    chance = random.Random(seed)
    vehicle.take_off(1.0)
    begun, accepted, refused, ends = vehicle.time, 0, 0, 0.0
    while vehicle.time - begun < seconds:
        places = [[chance.uniform(low, high) for low, high in zip(LOW, HIGH, strict=True)] for _ in range(TOGETHER)]
        try:
            answer = vehicle.extend(places)
        except cfplan.RequestRefusedError as why:
            print(f"another one: {why.what}")
            refused += 1
            continue
        accepted, ends = accepted + 1, answer.ends
        vehicle.sleep(max(ends - IN_TIME - (vehicle.time - begun), 0.0))
    vehicle.finish()
    return accepted, refused


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--uri", default="sim://0")
    options.add_argument("--mocap")
    options.add_argument("--seconds", type=float, default=60.0)
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    with cfplan.connect(given.uri, mocap=given.mocap, name="tour") as vehicle:
        accepted, refused = fly(vehicle, given.seconds, given.seed)
    print(f"{accepted} requests were flown, {refused} refused; record: {vehicle.record}")
