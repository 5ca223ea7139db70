"""Files that are looked for in a folder and in those above it."""

from pathlib import Path


def nearest(name: str, *folders: Path) -> Path | None:
    """Return the file of that name in the first of the folders, or above it, that has one; None where none has."""
    for start in folders:
        for folder in (start, *start.parents):
            if (folder / name).is_file():
                return folder / name
    return None
