"""Save a rerun recording to a file, or open it in the viewer's window."""

import contextlib
import os
import socket
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
import rerun_cli

from cfplan.errors import InputError

APPLICATION = "cfplan"
Draw = Callable[[rr.RecordingStream], None]


def save(file: Path, blueprint: rrb.Blueprint, draw: Draw, *, overwrite: bool = False) -> None:
    """Write what `draw` sends, with its blueprint; whole or not at all. Raises InputError where the file cannot be."""
    refuse_existing(file, overwrite=overwrite)
    with whole_file(file) as unfinished:
        unfinished.touch()
        with rr.RecordingStream(APPLICATION) as stream:
            stream.save(unfinished)
            lay_out(stream, blueprint)
            draw(stream)
            stream.flush()
            stream.disconnect()


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
    """Send this blueprint; else the viewer takes the one that its window had last."""
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


def refuse_existing(file: Path, *, overwrite: bool) -> None:
    """Check that the file may be written. Raises InputError where it exists and is not to be overwritten."""
    if file.exists() and not overwrite:
        raise InputError("the file exists already", where=str(file), hint="name another file, or add --force")


@contextlib.contextmanager
def whole_file(file: Path) -> Iterator[Path]:
    """Yield a temporary name; rename it to the file's when the block ends well. Raises InputError for OSError."""
    unfinished = file.with_name(file.name + ".part")
    try:
        yield unfinished
        unfinished.replace(file)
    except OSError as error:
        raise InputError(
            f"cannot be written ({error.strerror or error})",
            where=str(file),
            hint="choose a folder that can be written",
        ) from error
    finally:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)


def viewer_program() -> Path:
    """Return rerun's viewer; not the `rerun` found by name, which is absent where the environment is not activated."""
    return Path(rerun_cli.__file__).with_name("rerun.exe" if sys.platform == "win32" else "rerun")
