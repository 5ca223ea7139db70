"""How anything drawn in rerun reaches people: as a file, or in the viewer's window."""

import os
import sys
from collections.abc import Callable
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
import rerun_cli

from cfplan.errors import InputError

APPLICATION = "cfplan"
Draw = Callable[[rr.RecordingStream], None]


def save(file: Path, blueprint: rrb.Blueprint, draw: Draw, *, overwrite: bool = False) -> None:
    """Write what `draw` sends, with its blueprint; whole or not at all. Raises InputError where the file cannot be."""
    if file.exists() and not overwrite:
        raise InputError("there is a file already", where=str(file), hint="name another file, or add --force")
    unfinished = file.with_name(file.name + ".part")
    try:
        unfinished.touch()
        with rr.RecordingStream(APPLICATION) as stream:
            stream.save(unfinished, default_blueprint=blueprint)
            draw(stream)
            stream.flush()
            stream.disconnect()
        unfinished.replace(file)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise InputError(
            f"cannot be written ({error.strerror or error})",
            where=str(file),
            hint="choose a folder that can be written",
        ) from error


def open_viewer(blueprint: rrb.Blueprint, draw: Draw) -> None:
    """Open the viewer on what `draw` sends; it stays open by itself. Raises InputError where there is no screen."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError("there is no screen to open the viewer on", hint="save the recording: --save flight.rrd")
    with rr.RecordingStream(APPLICATION) as stream:
        # not the `rerun` found by name: that is absent where the environment is not activated
        viewer = Path(rerun_cli.__file__).with_name("rerun.exe" if sys.platform == "win32" else "rerun")
        rr.spawn(hide_welcome_screen=True, executable_path=str(viewer), default_blueprint=blueprint, recording=stream)
        draw(stream)
        stream.flush()
