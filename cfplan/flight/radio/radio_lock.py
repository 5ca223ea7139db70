"""One radio, one pilot: a second that opened it would take the first one's packets."""

import fcntl
import re
import tempfile
from pathlib import Path
from typing import IO

from cfplan.errors import LinkError

_EXCLUSIVE = ("radio://", "usb://", "udp://")


def lock_radio(uri: str) -> IO[str] | None:
    """Keep others away until it is closed or this process ends. Raises LinkError where another is there already.

    None for a vehicle that nothing else can reach, or where no lock can be written.
    """
    if not uri.startswith(_EXCLUSIVE):
        return None
    path = Path(tempfile.gettempdir()) / f"cfplan-{_what(uri)}.lock"
    try:
        file = path.open("a")
    except OSError:  # another user's, or no place: the driver will say what is the matter
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise LinkError(
            "another cfplan is flying with it", where=uri, hint="wait until that has landed, or use a second radio"
        ) from error
    return file


def _what(uri: str) -> str:
    """A radio serves one link, whatever channel and address; elsewhere the whole URI counts."""
    radio = re.match(r"radio://([^/?]*)", uri)
    return f"radio-{radio[1]}" if radio else re.sub(r"[^A-Za-z0-9.]+", "-", uri)
