"""Files as they come and go: checked before they are read, written whole or not."""

import io
import os
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ginn_jax.errors import InputError

HEAD = 4096


def files_below(folder: Path, endings: Container[str]) -> list[Path]:
    """The files there and in all folders below that end so, in any case, sorted.

    Hidden ones are left out: they are notes of the system's.
    """
    return sorted(
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in endings
        and not path.name.startswith(".")
        and path.is_file()
    )


def check_file(path: Path, wanted: str) -> None:
    """Raise `InputError` unless `path` is a file with something in it.

    A file that starts with that many zeros is one of no format that is read here: disks
    that filled up leave such files, of any size.
    """
    try:
        if not path.is_file():
            raise InputError(f"{path}: no such file; give {wanted}")
        with open(path, "rb") as file:
            head = file.read(HEAD)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; give {wanted}") from None
    if not head.strip(b"\0"):
        raise InputError(f"{path}: cannot be read (nothing in it); give {wanted}")


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """Where to write what shall be at `path`; it goes there once it is whole.

    What fails or is stopped leaves neither a part of the file nor takes an old one
    away. Raises `InputError` where the disk is full or may not be written to.
    """
    partial = path.with_name(f"{path.stem}.{os.getpid()}.partial")
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise InputError(unwritable(path, error)) from None
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def write_whole(path: Path, write: Callable[[io.BytesIO], Any]) -> None:
    """Let `write` make the file in memory, and `writing` put it where it belongs.

    In memory first: NumPy and others do not hear of a disk that is full.
    """
    write(whole := io.BytesIO())
    with writing(path) as partial:
        partial.write_bytes(whole.getvalue())


def unwritable(path: Path, error: OSError) -> str:
    """Why nothing can be written there, and what to do about it."""
    why = error.strerror or error
    return f"{path} cannot be written ({why}): make room or choose another place"
