"""Files that are written whole or not at all."""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path
from typing import Any


def write_bytes(path: Path, data: bytes) -> None:
    """Writes a file atomically: a reader, or a crash at any moment, leaves the old content or the new, never a part.

    Raises:
        OSError: When the disk is full or the folder cannot be written; it names the file, whose old content is then
            untouched.
    """
    # A short name, since that of the file may be as long as the file system takes; each thread has its own.
    partial = path.with_name(f".{os.getpid()}-{threading.get_native_id()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with open(partial, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            rename(partial, path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None


def rename(old: Path, new: Path) -> None:
    """Renames a file, in the place of another where there is one, so that a power failure does not undo it."""
    os.replace(old, new)
    if os.name == "posix":  # elsewhere a folder cannot be opened
        folder = os.open(new.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def remove_partial(folder: Path) -> None:
    """Removes what processes that died left of files that they wrote below a folder."""
    for partial in folder.rglob(".*.partial"):
        partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """:func:`write_bytes` for text."""
    write_bytes(path, text.encode())


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """The objects of a file with one JSON object a line; [] when there is no file.

    Raises:
        ValueError: When a line is not JSON object; names the file and the line.
    """
    if not path.is_file():
        return []
    values = []
    for number, line in enumerate(path.read_text().splitlines(), 1):
        try:
            value = json.loads(line)
        except json.JSONDecodeError as error:
            raise ValueError(f"{path}: line {number} is not JSON: {error}") from None
        values.append(value)
    return values
