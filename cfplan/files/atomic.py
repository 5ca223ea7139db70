"""Atomic writing: a file appears complete or not at all, and no existing file is overwritten unasked."""

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from cfplan.errors import InputError


def check_new_file(file: Path, *suffixes: str, overwrite: bool) -> None:
    """Raise InputError if the name ends in none of these suffixes, its folder is missing, or the file exists.

    Without suffixes any name will do.
    """
    if suffixes and file.suffix not in suffixes:
        ends = ", ".join(suffixes)
        raise InputError(f"the name must end in {ends}", where=str(file), hint=f"name it {file.stem}{suffixes[0]}")
    if not file.absolute().parent.is_dir():
        raise InputError("no such folder", where=str(file.parent), hint="make it first")
    if file.exists() and not overwrite:
        raise InputError("the file exists already", where=str(file), hint="name another, or add --force")


@contextlib.contextmanager
def atomic_write(file: Path) -> Iterator[Path]:
    """Yield a name beside the file to write to, which replaces the file when the block ends without an error.

    Threads, processes and computers may write the same file at once; the last one to finish determines its content.
    Raises OSError, and what the block raises; nothing is then left behind.
    """
    unfinished = file.with_name(f".{file.name}.{secrets.token_hex(4)}.new")
    try:
        yield unfinished
        with unfinished.open("rb+") as written:
            os.fsync(written)  # else a power failure may leave the name on disk without the content
        unfinished.replace(file)
    finally:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_output(file: Path) -> Iterator[Path]:
    """Yield as atomic_write() does. Raises InputError for OSError, and if the name is that of a device or a pipe."""
    try:
        if file.exists() and not file.is_file():
            raise InputError("not a regular file", where=str(file), hint="name a file; it need not exist yet")
        with atomic_write(file) as unfinished:
            yield unfinished
    except OSError as error:
        raise InputError(
            f"cannot be written ({error.strerror or error})", where=str(file),
            hint="name a file in a folder that can be written, on a disk with space",
        ) from error  # fmt: skip


def write_atomically(file: Path, content: bytes) -> None:
    """Write a file. Raises InputError as atomic_output()."""
    with atomic_output(file) as unfinished:
        unfinished.write_bytes(content)
