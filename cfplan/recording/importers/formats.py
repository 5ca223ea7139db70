"""The log formats that can be read, recognised by a file's content, not by its name."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cfplan.errors import InputError
from cfplan.recording.importers import named_csv, ros_bag, tlog, usd_log, vicon_csv
from cfplan.recording.importers.mocap_log import MocapLog
from cfplan.recording.importers.vicon_csv import Rotations
from cfplan.recording.plausible import check_places, check_times

_HEAD = 4096  # bytes by which a format is recognised


@dataclass(frozen=True, slots=True)
class Importer:
    """One format."""

    name: str
    recognises: Callable[[Path, bytes], bool]  # from the place and its first bytes; none where the place is a folder
    read: Callable[[Path], MocapLog]


IMPORTERS = (
    Importer("Crazyflie microSD log", usd_log.recognises, usd_log.read),
    Importer("ROS bag", ros_bag.recognises, ros_bag.read),
    Importer("MAVLink .tlog", tlog.recognises, tlog.read),
    Importer(named_csv.FORMAT, named_csv.recognises, named_csv.read),
    Importer("Vicon CSV", vicon_csv.recognises, vicon_csv.read),
)


def read_log(file: Path, *, rotations: Rotations | None = None) -> MocapLog:
    """Read the log in a file or in a bag's folder; `rotations`: of a Vicon CSV whose header does not say.

    Raises:
        InputError: not there, empty, of no known format, damaged, or without any pose.
    """
    file = Path(file)
    importer = find_importer(file)
    if importer is None and _is_rerun(file):
        raise InputError(
            "a rerun recording, not a log",
            where=str(file),
            hint="open it with `rerun FILE`; `rerun rrd merge FILE -o NEW` repairs one that is cut off",
        )
    if importer is None:
        known = ", ".join(importer.name for importer in IMPORTERS)
        raise InputError("unknown format", where=str(file), hint=f"known: a cfplan record, {known}")
    try:
        log = vicon_csv.read(file, rotations) if importer.read is vicon_csv.read else importer.read(file)
    except OSError as error:
        raise InputError(
            f"cannot be read ({error.strerror or error})",
            where=str(file),
            hint="check its permissions, or copy it again",
        ) from error
    for subject in log.subjects:
        check_times(subject.time, repr(subject.name), where=str(file))
        check_places(subject.position, repr(subject.name), where=str(file))
    if not any(subject.seen.any() for subject in log.subjects):
        raise InputError(
            "the log holds no pose",
            where=str(file),
            hint="; ".join(log.notes) or "the subjects were never seen, or their positions are not numbers",
        )
    return log


def _is_rerun(file: Path) -> bool:
    if file.is_dir():
        return False
    with file.open("rb") as stream:
        return stream.read(3) == b"RRF"


def find_importer(file: Path) -> Importer | None:
    """Return the importer that recognises the file, or None. Raises InputError where it is absent or empty."""
    head = b""
    if file.is_fifo():
        raise InputError("a pipe, not a file", where=str(file), hint="write what comes from it to a file first")
    if not file.is_dir():
        try:
            with file.open("rb") as stream:
                head = stream.read(_HEAD)
        except FileNotFoundError:
            raise InputError(
                "no such file", where=str(file), hint="check the name; it is relative to the working folder"
            ) from None
        except (OSError, ValueError) as error:
            raise InputError(
                f"cannot be read ({getattr(error, 'strerror', None) or error})",
                where=str(file),
                hint="check its permissions",
            ) from error
        if not head:
            raise InputError("the file is empty", where=str(file), hint="copy it again, or record it again")
    return next((importer for importer in IMPORTERS if importer.recognises(file, head)), None)
