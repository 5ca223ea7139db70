"""Which vehicle to fly, and where its poses come from."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from cfplan.errors import InputError

if TYPE_CHECKING:
    from cfplan.flight.poses import PoseSource
    from cfplan.safety.limits import Limits

SIMULATED = "sim://"
VIRTUAL_VICON = "lab"  # as the computer in a URI of motion capture


def check_mocap(uri: str, mocap_uri: str | None) -> None:
    """Raises InputError where a vehicle has no source of poses; looks for nothing yet."""
    from cfplan.flight.mocap.uri import EXAMPLE, parse_uri

    if mocap_uri is not None:
        mocap = parse_uri(mocap_uri, subject_needed=True)
        if mocap.host == VIRTUAL_VICON and not mocap.system.startswith("vicon") and uri.startswith(SIMULATED):
            raise InputError("the lab has a virtual Vicon only", where=mocap_uri, hint="use vicon:// or vicon-sdk://")
    elif not uri.startswith(SIMULATED):
        raise InputError("where do its poses come from?", where=uri, hint=f"name it with --mocap, as {EXAMPLE}")


@contextmanager
def vehicle(uri: str, mocap_uri: str | None, limits: "Limits") -> "Iterator[tuple[list[type], PoseSource]]":
    """The link drivers and the poses for a URI; for the virtual Crazyflie, its lab too."""
    from cfplan.flight.mocap.source import pose_source
    from cfplan.flight.mocap.uri import parse_uri

    mocap = parse_uri(mocap_uri, subject_needed=True) if mocap_uri is not None else None
    if not uri.startswith(SIMULATED):
        yield [], pose_source(str(mocap), limits.pose)
        return
    from cfplan.simulation.lab import start_lab
    from cfplan.simulation.room import RoomPoseSource, RoomSettings
    from cfplan.simulation.sim_driver import SimDriver, lab_number
    from cfplan.simulation.virtual_cameras import ViconSettings

    number = lab_number(uri)
    if mocap is None:
        with start_lab(limits.airframe, number=number) as lab:
            yield [SimDriver], RoomPoseSource(lab.number)
    elif mocap.host == VIRTUAL_VICON:
        room = RoomSettings(vicon=ViconSettings(subject=mocap.subject))
        with start_lab(limits.airframe, room=room, number=number) as lab:
            there = lab.mocap_uri.replace("vicon:", f"{mocap.system}:", 1)
            yield [SimDriver], pose_source(there, limits.pose)
    else:
        with start_lab(limits.airframe, number=number):
            yield [SimDriver], pose_source(str(mocap), limits.pose)
