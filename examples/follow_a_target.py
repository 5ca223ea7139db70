"""Follow a target that moves, as a body in motion capture would: half a metre above it, wherever it goes.

    python examples/follow_a_target.py --seconds 30
    python examples/follow_a_target.py --uri radio://0/80/2M/E7E7E7E7E7 --mocap vicon://192.168.1.2/cf1

Four times a second it looks where the target is and how fast, and asks for the place where that will be in a moment.
The latest request wins, so it need not wait for answers: a plan that comes too late, or leads nowhere, changes nothing.
"""

import argparse
import math

import cfplan

ABOVE = 0.5  # m
LOOK_PERIOD = 0.25  # s
AHEAD = 1.2  # s, about as long as a request takes to be flown


def target(time: float) -> tuple[float, float, float]:
    """Return where the target is at a time, s: here a made-up one on an ellipse; put your own poses in its place."""
    angle = 2.0 * math.pi * time / 20.0
    return 1.2 * math.cos(angle), 2.0 * math.sin(angle), 0.5


def fly(vehicle: cfplan.SteeredVehicle, seconds: float) -> tuple[int, float]:
    """Follow for so many s; return how many requests were accepted, and the mean distance at the end, m."""
    vehicle.take_off(1.0)
    begun, distances = vehicle.time, []
    accepted = 0
    while (now := vehicle.time - begun) < seconds:
        x, y, z = target(now + AHEAD)
        vehicle.request(cfplan.Wish.REPLACE, [(x, y, z + ABOVE)])
        vehicle.sleep(LOOK_PERIOD)
        accepted += sum(answer.verdict is cfplan.PathVerdict.ACCEPTED for answer in vehicle.answers())
        there, here = target(vehicle.time - begun), vehicle.position
        distances.append(math.hypot(here[0] - there[0], here[1] - there[1]))
    late = distances[len(distances) // 2 :]
    vehicle.finish()
    return accepted, sum(late) / len(late)


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--uri", default="sim://0")
    options.add_argument("--mocap")
    options.add_argument("--seconds", type=float, default=30.0)
    given = options.parse_args()
    with cfplan.connect(given.uri, mocap=given.mocap, name="follow") as vehicle:
        accepted, distance = fly(vehicle, given.seconds)
    print(f"{accepted} requests were flown; {distance:.2f} m beside the target in the mean; record: {vehicle.record}")
