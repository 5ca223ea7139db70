"""Run a small flight that calls every compiled function that flights need, which compiles those not cached yet.

`python -m cfplan.preparation.small_flight SAFETY_FILE PART` runs one part of it; parts are independent.
"""

import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType

import numpy as np

from cfplan.errors import CfplanError
from cfplan.flight.setpoints.commitment import Commitment, warm_up
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.geometry.path_file import PathFile, load_path_file
from cfplan.geometry.yaw import YawMode
from cfplan.learning.model_files import find_model
from cfplan.planning.path.choice import chosen_path
from cfplan.planning.plan import plan
from cfplan.preparation.on_board_flight import prepare_on_board_flight
from cfplan.preparation.plan_flight import FlightOptions
from cfplan.preparation.prepare_flight import prepare_flight
from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.glitches import glitch_at_sampled_setpoints
from cfplan.simulation.link_loss import link_loss_near_walls, link_loss_within_stops
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.vehicle import VirtualCrazyflie
from cfplan.simulation.virtual_crazyflie.virtual_firmware import VirtualFirmware

NODES = 12  # grid intervals; few enough that limits are exceeded between nodes
PLACES = ((-0.2, -0.2, -0.1), (0.2, 0.0, 0.0), (0.2, 0.2, 0.1))  # m from the middle of the space
SMALL_PATH = "name: small flight\nwaypoints:\n"


def _plan(path_file: Path, limits: Limits) -> None:
    """Choose a path, and plan along it with every planner that flights use."""
    chosen, _ = chosen_path(load_path_file(path_file), limits)
    chosen.path.check()
    with suppress(CfplanError):  # there may be no model for this vehicle
        model = find_model(limits.airframe, limits.plan)
        nodes = 1 + (model.window if model else NODES)  # more than the network's window, so windows overlap
        _plan_along(chosen, limits, "learned", nodes, YawMode.FIXED)
    for yaw in YawMode:
        _plan_along(chosen, limits, "expert", NODES, yaw)


def _plan_along(path_file: PathFile, limits: Limits, planner: str, nodes: int, yaw: YawMode) -> None:
    plan(path_file.path, limits.airframe, limits, planner=planner, nodes=nodes, yaw=yaw)


def _prepare(path_file: Path, limits: Limits) -> None:
    """Prepare a flight, and make the checks of planning in the air."""
    path_file.write_text(path_file.read_text() + "shape: min-snap\n")  # choosing a path would compile much more
    prepared = prepare_flight(path_file, limits, FlightOptions(planner="minsnap"))
    prepare_on_board_flight(path_file, limits, FlightOptions(planner="minsnap"))
    encoded = prepared.encoded
    begin, first = encoded.payloads[:2], np.array([0])
    lost = link_loss_near_walls(begin, limits, 0.0)
    stop = encode_stops(encoded.motion, RATE, rows=first, gains=encoded.gains, space=encoded.space)
    end = np.arange(stop.shape[1])[None] == stop.shape[1] - 1
    for coarsely in (True, False):
        link_loss_within_stops(stop, lost.snapshots[:, first], limits, end, coarsely=coarsely)
    glitch_at_sampled_setpoints(begin, limits)
    at_rest = encode_stops(encoded.motion, RATE, rows=np.array([-1, -1]) % len(encoded.payloads))
    warm_up(Commitment(0, encoded.payloads[-2:], at_rest), limits)


def _simulate(_path_file: Path, limits: Limits) -> None:
    """Let the virtual vehicle stand on the floor, and read all of its log variables."""
    VirtualCrazyflie(limits.airframe, VehicleSettings(make_firmware=VirtualFirmware)).advance(30)
    for value in VirtualFirmware(limits.airframe).log_variables().values():
        value()


PARTS: Mapping[str, Callable[[Path, Limits], None]] = MappingProxyType(
    {"planning": _plan, "preparing": _prepare, "simulating": _simulate}
)


def fly(safety_file: Path, part: str) -> None:
    """Run a part of the small flight under these limits, in the middle of their space."""
    limits = load_limits(safety_file)
    limits = replace(limits, space=replace(limits.space, obstacles=()))  # the middle may be occupied
    middle = (np.array(limits.space.low) + limits.space.high) / 2
    with TemporaryDirectory() as folder:
        path_file = Path(folder, "small.yaml")
        rows = (f"  - {(middle + place).tolist()}\n" for place in PLACES)
        path_file.write_text(SMALL_PATH + "".join(rows))
        PARTS[part](path_file, limits)


if __name__ == "__main__":
    fly(Path(sys.argv[1]), sys.argv[2])
