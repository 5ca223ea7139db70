"""Lock on the radio: one radio serves one pilot, as a second one would take the first one's packets."""

import fcntl
import re
import tempfile
from pathlib import Path
from typing import IO

from cfplan.errors import LinkError

_EXCLUSIVE = ("radio://", "usb://", "udp://")


def lock_radio(uri: str) -> IO[str] | None:
    """Lock the radio of a URI until the returned file is closed or this process ends.

    Returns None for a vehicle that no other process can reach, or if no lock can be written. Raises LinkError if
    another pilot holds the lock.
    """
    if not uri.startswith(_EXCLUSIVE):
        return None
    path = Path(tempfile.gettempdir()) / f"cfplan-{_locked_name(uri)}.lock"
    try:
        file = path.open("a")
    except OSError:  # another user's lock, or a full disk: the driver will report the error
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise LinkError(
            "another cfplan process uses this link", where=uri, hint="wait until it has landed, or use a second radio"
        ) from error
    return file


def _locked_name(uri: str) -> str:
    """Return the lock's name: a radio serves one link, on any channel and address; otherwise the whole URI counts."""
    radio = re.match(r"radio://([^/?]*)", uri)
    return f"radio-{radio[1]}" if radio else re.sub(r"[^A-Za-z0-9.]+", "-", uri)
