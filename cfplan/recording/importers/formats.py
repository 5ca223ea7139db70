"""Read logs of all known formats, recognised by a file's content, not by its name."""

from pathlib import Path
from types import ModuleType

from cfplan.errors import InputError
from cfplan.recording.importers import named_csv, ros_bag, tlog, usd_log, vicon_csv
from cfplan.recording.importers.mocap_log import MocapLog
from cfplan.recording.importers.vicon_csv import Rotations
from cfplan.recording.plausible import check_places, check_times

_HEAD = 4096  # bytes of a file that identify its format

# Each defines FORMAT, its name; HEAD, which matches a file's first bytes; read(file); and EXTRA, if it needs one.
IMPORTERS = (usd_log, ros_bag, tlog, vicon_csv, named_csv)


def read_log(file: Path, *, rotations: Rotations | None = None) -> MocapLog:
    """Read the log in a file or in a bag's folder; `rotations` is for a Vicon CSV whose header does not say.

    Raises:
        InputError: the log is missing, empty, of unknown format, damaged, or without any pose; or a package is missing.
    """
    file = Path(file)
    importer = find_importer(file)
    try:
        log: MocapLog = vicon_csv.read(file, rotations) if importer is vicon_csv else importer.read(file)
    except ImportError as error:
        message = f"a {importer.FORMAT} needs the package {str(error.name).partition('.')[0]}"
        raise InputError(message, where=str(file), hint=f"pip install 'cfplan[{importer.EXTRA}]'") from error
    except OSError as error:
        message = f"cannot be read ({error.strerror or error})"
        raise InputError(message, where=str(file), hint="check its permissions, or copy it again") from error
    for subject in log.subjects:
        check_times(subject.time, repr(subject.name), where=str(file))
        check_places(subject.position, repr(subject.name), where=str(file))
    if not any(subject.seen.any() for subject in log.subjects):
        hint = "; ".join(log.notes) or "the subjects were never seen, or their positions are not numbers"
        raise InputError("the log holds no pose", where=str(file), hint=hint)
    return log


def find_importer(file: Path) -> ModuleType:
    """Return the importer that recognises the file. Raises InputError if it is absent, empty, or of unknown format."""
    if file.is_dir() and (ros_bag.is_bag(file) or ros_bag.files_in(file)):
        return ros_bag
    head = b"" if file.is_dir() else _first_bytes(file)
    for importer in IMPORTERS:
        if importer.HEAD.match(head):
            return importer
    if head.startswith(b"RRF"):
        hint = "open it with `rerun FILE`; `rerun rrd merge FILE -o NEW` repairs one that is cut off"
        raise InputError("a rerun recording, not a log", where=str(file), hint=hint)
    known = ", ".join(importer.FORMAT for importer in IMPORTERS)
    raise InputError("unknown format", where=str(file), hint=f"known: a cfplan record, {known}")


def _first_bytes(file: Path) -> bytes:
    if file.is_fifo():
        raise InputError("a pipe, not a file", where=str(file), hint="write what comes from it to a file first")
    try:
        with file.open("rb") as stream:
            head = stream.read(_HEAD)
    except FileNotFoundError:
        hint = "check the name; it is relative to the working folder"
        raise InputError("no such file", where=str(file), hint=hint) from None
    except (OSError, ValueError) as error:
        message = f"cannot be read ({getattr(error, 'strerror', None) or error})"
        raise InputError(message, where=str(file), hint="check its permissions") from error
    if not head:
        raise InputError("the file is empty", where=str(file), hint="copy it again, or record it again")
    return head
