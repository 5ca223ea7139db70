"""Connect a program to a vehicle, real or virtual, that it will steer."""

from collections.abc import Callable, Iterable
from pathlib import Path

from cfplan.errors import InputError
from cfplan.files.nearest import nearest
from cfplan.flight.pilot.keys import Order
from cfplan.preparation.steps import OnStep, ignore_steps
from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits
from cfplan.steering.flight_in_progress import FlightInProgress
from cfplan.steering.real_time_steering import RealTimeSteering
from cfplan.steering.recorded_steering import SteeringRecord
from cfplan.steering.starting_vehicle import SIMULATED, check_uris, look_at_hardware
from cfplan.steering.steered_vehicle import SteeredVehicle
from cfplan.steering.stepped_steering import SteppedSteering

RECORDS = Path("records")
SAFETY_FILE = "safety.yaml"


def connect(
    uri: str = "sim://0",
    *,
    mocap: str | None = None,
    safety: Limits | Path | str | None = None,
    records: Path | str | None = RECORDS,
    name: str = "steered",
    stepped: bool = False,
    keys: bool = True,
    on_step: OnStep = ignore_steps,
    on_record: Callable[[SteeringRecord], None] = lambda _: None,
    more_orders: Callable[[], Iterable[Order]] = tuple,
) -> SteeredVehicle:
    """Connect to a vehicle and return it, on the ground; use it in a `with` block, at whose end it lands.

    Args:
        uri: the vehicle, as radio://0/80/2M/E7E7E7E7E7; sim://0 is the virtual Crazyflie.
        mocap: the vehicle in motion capture, as vicon://192.168.1.2/cf1; the virtual one has poses already.
        safety: the limits, or the file with them; else the nearest safety.yaml in or above the working folder.
        records: the folder in which the flight's record is written, as a new folder; None writes none.
        name: of the flight, in its record.
        stepped: fly the virtual vehicle on a clock that runs only while the program waits, in this process: for tests.
        keys: whether keys of the terminal count: space lands, Esc cuts the motors. Ctrl-C lands, twice cuts, anyway.
        on_step: hears of the steps of connecting.
        on_record: is given the record when it begins, so that others may listen.
        more_orders: returns orders to the pilot since its last call, as of a ground station; must not wait.

    Raises a CfplanError, with place and hint, if an argument is wrong, or no vehicle, radio or poses are found.
    """
    check_uris(uri, mocap)
    if stepped and (not uri.startswith(SIMULATED) or mocap is not None):
        raise InputError("only the virtual vehicle flies on a stepped clock", where=uri, hint="leave out stepped")
    limits = find_limits(safety)
    flight: FlightInProgress
    if stepped:
        flight = SteppedSteering(limits, more_orders=more_orders)
    else:
        look_at_hardware(uri, mocap, limits.pose, on_step)
        flight = RealTimeSteering(uri, mocap, limits, on_step, keys=keys, more_orders=more_orders)
    folder = Path(records) if records is not None else None
    return SteeredVehicle(flight, limits, uri=uri, name=name, records=folder, on_record=on_record)


def find_limits(safety: Limits | Path | str | None) -> Limits:
    """Return limits, those of a file, or those of the nearest safety.yaml. Raises InputError if there are none."""
    if isinstance(safety, Limits):
        return safety
    if safety is not None:
        return load_limits(safety)
    found = nearest(SAFETY_FILE, Path.cwd())
    if found is None:
        raise InputError(
            f"no {SAFETY_FILE} in or above this folder",
            where=str(Path.cwd()),
            hint="`cfplan init` writes one; or name one with safety=",
        )
    return load_limits(found)
