"""A driver that uses the vendors' own clients, by the `motioncapture` package.

They report neither frame number nor latency, and they hang: Vicon's client holds the interpreter while it looks for a
server, spins when the server goes away, and hides a subject whose segment has another name. Therefore this driver runs
only in a process that can be killed, and checks in advance what it can.
"""

import math
from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING

from cfplan.errors import InputError, LinkError
from cfplan.flight.clock import monotonic
from cfplan.flight.mocap.datastream_client import DataStreamClient, address_of, open_connection
from cfplan.flight.mocap.frames import Frame, Scene, TrackedBody
from cfplan.flight.mocap.uri import MocapUri

if TYPE_CHECKING:
    import motioncapture

_SCENE_TIMEOUT = 0.5  # s to read the subjects
_NAMES = {"vicon-sdk": "vicon", "optitrack-sdk": "optitrack_closed_source"}  # the package's names where they differ


class SdkDriver:
    """A `Driver` around a vendor's client."""

    def __init__(self, uri: MocapUri):
        self._uri = uri
        self._client: motioncapture.MotionCapture | None = None
        self._scene: Scene | None = None
        self._names: set[str] = set()

    def connect(self) -> None:
        """Connect. Raises InputError if the package is missing, LinkError if nothing answers. May hang."""
        try:
            import motioncapture

            import_module("numpy")  # the package imports it with its first pose, which would then be late
        except ImportError as why:
            raise InputError(
                "the package motioncapture is not installed",
                where=str(self._uri),
                hint="pip install 'cfplan[mocap]'" + ("; or use vicon://, which does not need it" * self._is_vicon),
            ) from why
        address = address_of(self._uri.host, self._uri.port, str(self._uri))  # not every client resolves names
        if self._is_vicon:
            self._scene = self._read_scene()
        elif self._uri.system == "qualisys":
            open_connection(
                self._uri.host, self._uri.port, str(self._uri), "is Qualisys Track Manager running there, in real time?"
            ).close()
        try:
            self._client = motioncapture.connect(
                _NAMES.get(self._uri.system, self._uri.system), self._settings(address)
            )
        except RuntimeError as why:
            if "Unknown motion capture type" in str(why):
                raise InputError(
                    f"the installed package motioncapture is built without {self._uri.system}",
                    where=str(self._uri),
                    hint="build libmotioncapture from source with the maker's SDK, or let the system send by vrpn://",
                ) from why
            raise LinkError(str(why), where=str(self._uri), hint="is the system running there?") from why

    def wait(self) -> Frame:
        """Wait for the next frame and return it. May hang."""
        if self._client is None:
            raise LinkError("the stream is closed", where=str(self._uri), hint="connect again")
        try:
            self._client.waitForNextFrame()
            received = monotonic()
            seen = self._client.rigidBodies
        except RuntimeError as why:
            raise LinkError(str(why), where=str(self._uri), hint="is the system still running there?") from why
        bodies = tuple(_body(name, body) for name, body in seen.items())
        known = {subject.name for subject in self._scene.subjects} if self._scene else self._names
        self._names |= seen.keys()
        return Frame(received, bodies, tuple(sorted(known - seen.keys())))

    def scene(self) -> Scene | None:
        """Return Vicon's subjects; None for other systems, which list only bodies seen so far."""
        return self._scene

    def close(self) -> None:
        """Drop the client: the package cannot disconnect, only the end of the process does."""
        self._client = None

    @property
    def _is_vicon(self) -> bool:
        return self._uri.system == "vicon-sdk"

    def _settings(self, host: str) -> dict[str, str]:
        port = str(self._uri.port)
        return {
            # The misspelling is the package's; it turns the cloud of unlabelled markers off.
            "vicon-sdk": {"hostname": f"{host}:{port}", "enable_pointclout": "0"},
            "qualisys": {"hostname": host, "port": port, "enable_pointclout": "0"},
            "optitrack": {"hostname": host, "port_command": port},
            "optitrack-sdk": {"hostname": host, "port_command": port},
            "nokov": {"hostname": host},
            "motionanalysis": {"hostname": host},
            "vrpn": {"hostname": f"{host}:{port}"},
        }[self._uri.system]

    def _read_scene(self) -> Scene | None:
        """Return the subjects and their segments, which Vicon's own client does not list."""
        client = DataStreamClient(self._uri.host, self._uri.port, str(self._uri))
        try:
            client.connect()
            end = monotonic() + _SCENE_TIMEOUT
            with suppress(LinkError):  # a dialect that only the vendor's client understands
                while monotonic() < end and client.scene() is None:
                    client.wait()
            return client.scene()
        finally:
            client.close()


def _body(name: str, body: "motioncapture.RigidBody") -> TrackedBody:
    x, y, z = (float(value) for value in body.position)
    turn = body.rotation
    quaternion = (float(turn.x), float(turn.y), float(turn.z), float(turn.w))
    norm = math.sqrt(math.fsum(value * value for value in quaternion))  # near 1 in single precision
    if abs(norm - 1.0) < 1e-3:
        quaternion = (turn.x / norm, turn.y / norm, turn.z / norm, turn.w / norm)
    return TrackedBody(name, (x, y, z), quaternion)
