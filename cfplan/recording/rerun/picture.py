"""Make pictures of the rerun view without a screen, by rerun's viewer on any Vulkan driver."""

import contextlib
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rerun.blueprint as rrb

from cfplan.errors import InputError
from cfplan.files.atomic import atomic_output, check_new_file
from cfplan.recording.rerun.layout import TIMELINE
from cfplan.recording.rerun.viewer import Draw, free_port, save, viewer_program

SIZE = (1920, 1080)  # points, of the window that is never shown
_START_TIMEOUT = 30.0  # s
_LOAD_TIMEOUT = 60.0  # s
_SETTLE_TIME = 5.0  # s until plots have found their ranges and the viewer's greeting is gone
_NO_DRIVER_WORDS = ("No graphics adapter", "Failed to get render context", "Vulkan")


@dataclass(frozen=True, slots=True)
class View:
    """One view of the window."""

    name: str
    reports: tuple[str, ...]  # failures to draw
    identity: str


def write_png(
    file: Path, blueprint: rrb.Blueprint, draw: Draw, moment: float, *, overwrite: bool = False
) -> tuple[str, ...]:
    """Write the whole view at a moment, s on the timeline, and return the viewer's complaints.

    Raises InputError if the file cannot be written or there is no graphics driver.
    """
    check_new_file(file, overwrite=overwrite)
    with tempfile.TemporaryDirectory(prefix="cfplan-") as folder:
        recording = Path(folder) / "view.rrd"
        save(recording, blueprint, draw)
        with HeadlessViewer.opened(recording) as viewer:
            viewer.go_to(moment)
            picture = viewer.picture()
            complaints = viewer.complaints()
    with atomic_output(file) as unfinished:
        unfinished.write_bytes(picture)
    return complaints


class HeadlessViewer:
    """A viewer without a window."""

    def __init__(self, client: Any):
        self._client = client

    @classmethod
    @contextlib.contextmanager
    def opened(cls, recording: Path, size: tuple[int, int] = SIZE) -> "Iterator[HeadlessViewer]":
        """Open a viewer with a recording loaded. Raises InputError where there is no driver, or loading fails."""
        port = free_port()
        with tempfile.TemporaryDirectory(prefix="cfplan-") as folder, (Path(folder) / "output").open("wb+") as output:
            process = subprocess.Popen(
                [
                    viewer_program(), "--headless", "--hide-welcome-screen", "--bind", "127.0.0.1", "--port", str(port),
                    "--window-size", f"{size[0]}x{size[1]}",
                ],
                env={"XDG_RUNTIME_DIR": folder, **os.environ, "RERUN_ANALYTICS": "false"},
                stdin=subprocess.DEVNULL, stdout=output, stderr=output,
            )  # fmt: skip
            try:
                viewer = cls(_client(port, process))
                viewer._open(recording)
                yield viewer
            except ConnectionError:
                raise _explained(process, Path(output.name)) from None
            finally:
                process.kill()
                process.wait()

    def _open(self, recording: Path) -> None:
        self._client.open(str(recording))
        end = time.monotonic() + _LOAD_TIMEOUT
        while self._client.get_state().loading:
            if time.monotonic() > end:
                raise InputError(
                    "the viewer does not finish loading it",
                    where=str(recording),
                    hint="draw a shorter flight, or wait until the computer is idle",
                )
            time.sleep(0.1)

    def go_to(self, moment: float) -> None:
        """Set the time cursor, s."""
        self._client.set_time(TIMELINE, duration=moment)
        time.sleep(_SETTLE_TIME)

    def views(self) -> tuple[View, ...]:
        """Return all views of the window, those behind others in tabs too."""
        return tuple(
            View(view.name or "", tuple(str(report) for report in view.reports), str(view.view_id))
            for view in self._client.get_state().views
        )

    def picture(self, view: View | None = None) -> bytes:
        """Return a PNG of one view, or of the whole window."""
        return self._client.take_screenshot(view.identity if view is not None else None)

    def complaints(self) -> tuple[str, ...]:
        """Return failures to draw, and every other error."""
        complaints = [f"{view.name}: {report}" for view in self.views() for report in view.reports]
        complaints += [entry.message for entry in self._client.get_logs() if entry.level.upper() == "ERROR"]
        return tuple(complaints)


def _client(port: int, process: subprocess.Popen) -> Any:
    """Connect once the viewer listens. Raises ConnectionError where it does not, or ends instead."""
    from rerun.experimental import ViewerClient

    end = time.monotonic() + _START_TIMEOUT
    while True:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
            return client
        except ConnectionError:
            if process.poll() is not None or time.monotonic() > end:
                raise
            time.sleep(0.1)


def _explained(process: subprocess.Popen, output: Path) -> InputError:
    """Explain why the viewer ended: it listens before it knows whether it can draw."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(5.0)
    text = output.read_text(errors="replace")
    if any(words in text for words in _NO_DRIVER_WORDS):
        return InputError(
            "there is no Vulkan driver to draw with",
            hint="install a software one (Debian: apt install mesa-vulkan-drivers), or --save and look at it elsewhere",
        )
    lines = [line.strip() for line in text.splitlines() if line.strip()] or ["it printed nothing"]
    return InputError(f"the viewer ended: {lines[-1][:200]}", hint="--save writes what it should have shown")
