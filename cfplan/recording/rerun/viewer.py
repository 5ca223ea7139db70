"""Save a rerun recording to a file, or open it in the viewer's window."""

import os
import socket
import sys
from collections.abc import Callable
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
import rerun_cli

from cfplan.errors import InputError
from cfplan.files.atomic import check_new_file, write_atomically

APPLICATION = "cfplan"
Draw = Callable[[rr.RecordingStream], None]


def save(file: Path, blueprint: rrb.Blueprint, draw: Draw, *, overwrite: bool = False) -> None:
    """Write what `draw` sends, with its blueprint, atomically. Raises InputError if the file cannot be written."""
    check_new_file(file, overwrite=overwrite)
    with rr.RecordingStream(APPLICATION) as stream:
        recording = stream.memory_recording()  # stream.save() would not report a full disk
        lay_out(stream, blueprint)
        draw(stream)
        content = recording.drain_as_bytes()
    write_atomically(file, content)


def open_viewer(blueprint: rrb.Blueprint, draw: Draw) -> None:
    """Open the viewer on what `draw` sends; it outlives this command. Raises InputError where there is no screen."""
    require_screen("save the recording: --save flight.rrd, or draw it: --png flight.png")
    with rr.RecordingStream(APPLICATION) as stream:
        rr.spawn(
            hide_welcome_screen=True,
            executable_path=str(viewer_program()),
            recording=stream,
        )
        lay_out(stream, blueprint)
        draw(stream)
        stream.flush()


def lay_out(stream: rr.RecordingStream, blueprint: rrb.Blueprint) -> None:
    """Send this blueprint; otherwise the viewer reuses the last one of its window."""
    stream.send_blueprint(blueprint, make_active=True, make_default=True)


def require_screen(hint: str) -> None:
    """Check that a window can be opened. Raises InputError with this hint where it cannot."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError("there is no screen to open the viewer on", hint=hint)


def free_port() -> int:
    """Return a free port on this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def viewer_program() -> Path:
    """Return rerun's viewer; not the `rerun` found by name, which is absent where the environment is not activated."""
    return Path(rerun_cli.__file__).with_name("rerun.exe" if sys.platform == "win32" else "rerun")
