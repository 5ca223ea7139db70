"""Race through a gate that moves: laps around the room, replanned whenever the gate has moved.

    python examples/race_a_moving_gate.py --laps 3

The gate slides sideways while the vehicle is on its way. Each time it is expected elsewhere than before, the rest of
the lap is replaced by one through there.
"""

import argparse
import math

import cfplan

LAP = [(1.0, 0.8, 1.0), (0.0, 2.0, 1.2), (-1.0, 0.8, 1.0)]  # m, behind the gate and around
GATE_Y, GATE_HEIGHT = -1.2, 1.0  # m, where the gate slides along x
SWING, PERIOD = 0.5, 12.0  # m, s, of the gate
MOVED = 0.05  # m, from which on the lap is planned anew
NEAR = 1.0  # m from the gate, from which on it is too late for that
SPEED = 1.5  # m/s, about that of the vehicle on its way to the gate
PASSED = 0.3  # m, along y beyond the gate


def gate(time: float) -> tuple[float, float, float]:
    """Return where the middle of the gate is at a time, s; put your own poses in its place."""
    return SWING * math.sin(2.0 * math.pi * time / PERIOD), GATE_Y, GATE_HEIGHT


def expected(vehicle: cfplan.SteeredVehicle, begun: float) -> tuple[float, float, float]:
    """Return where the gate will be when the vehicle comes there, m."""
    now = vehicle.time - begun
    return gate(now + math.dist(vehicle.position, gate(now)) / SPEED)


def fly(vehicle: cfplan.SteeredVehicle, laps: int) -> list[float]:
    """Fly laps; return by how much the vehicle missed the middle of the gate each time, m."""
    vehicle.take_off(1.0)
    begun = vehicle.time
    missed: list[float] = []
    while len(missed) < laps:
        seen = expected(vehicle, begun)
        ask(vehicle, [seen, *LAP])
        while True:
            before = vehicle.position
            vehicle.sleep(0.05)
            here, there = vehicle.position, gate(vehicle.time - begun)
            if (before[1] - GATE_Y) * (here[1] - GATE_Y) <= 0.0 and abs(here[1] - GATE_Y) < PASSED:
                missed.append(math.hypot(here[0] - there[0], here[2] - there[2]))
                break
            then = expected(vehicle, begun)
            if vehicle.resting or (abs(then[0] - seen[0]) > MOVED and math.dist(here, there) > NEAR):
                seen = then
                ask(vehicle, [seen, *LAP])
        vehicle.sleep(1.5)  # to the far side, where the next lap begins
    vehicle.finish()
    return missed


def ask(vehicle: cfplan.SteeredVehicle, waypoints: list[tuple[float, float, float]]) -> None:
    """Ask for another way; where there is none from this motion, the old one is flown on."""
    try:
        vehicle.replace(waypoints)
    except cfplan.RequestRefusedError as why:
        print(f"as before: {why.what}")


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--uri", default="sim://0")
    options.add_argument("--mocap")
    options.add_argument("--laps", type=int, default=3)
    given = options.parse_args()
    with cfplan.connect(given.uri, mocap=given.mocap, name="race") as vehicle:
        missed = fly(vehicle, given.laps)
    print(f"missed the middle of the gate by {', '.join(f'{each:.2f} m' for each in missed)}; record: {vehicle.record}")
