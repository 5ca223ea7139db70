"""Flights of flights/ along paths of least snap, for tests whose figures were measured along those."""

from pathlib import Path

FLIGHTS = Path(__file__).parents[1] / "flights"


def along_least_snap(name: str, folder: Path) -> Path:
    """Write a flight's path file into a folder, with the path of least snap for times like the straight lengths."""
    file = folder / f"{name}.yaml"
    file.write_text(f"{(FLIGHTS / file.name).read_text()}\nshape: min-snap\ntimes: length\n")
    return file
