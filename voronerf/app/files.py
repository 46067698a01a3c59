"""Atomic writes, locks and JSON files."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import stat
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any


def write_bytes(path: Path, data: bytes) -> None:
    """Writes a file atomically: at any time, and after a crash, it has either the old or the new content.

    Raises:
        OSError: When the disk is full or the folder cannot be written; the error names the file, and the old content
            stays.
    """
    # A short name, since the file's name may have the maximum length; it is unique for each thread.
    partial = path.with_name(f".{os.getpid()}-{threading.get_native_id()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            partial.unlink(missing_ok=True)
            with open(partial, "xb") as file:  # mode x follows no existing link
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            rename(partial, path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None


def rename(old: Path, new: Path) -> None:
    """Renames a file, replacing any existing one, so that a power failure does not undo the change."""
    os.replace(old, new)
    if os.name == "posix":  # other systems cannot open a folder
        folder = os.open(new.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


@contextlib.contextmanager
def locked(folder: Path, busy: Callable[[], None]) -> Iterator[None]:
    """Locks a folder against other processes; has no effect on Windows and on file systems without locks.

    Args:
        folder: An existing folder.
        busy: Function that is called if another process holds the lock. Unless this function raises an error, the lock
            is awaited.
    """
    if sys.platform == "win32":
        yield
        return
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            busy()
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        except OSError:
            pass  # the file system has no locks
        yield
    finally:
        os.close(descriptor)


def leads_outside(path: Path, folder: Path) -> bool:
    """Returns whether a path leads out of a folder, by its text (``..``, another root) or through a link."""
    return any(not Path(full(path)).is_relative_to(full(folder)) for full in (os.path.abspath, os.path.realpath))


def cache_folder() -> Path:
    """Returns the cache folder: VORONERF_CACHE, or `voronerf` in the user's folder for caches.

    A user without a home folder, as in some containers, gets a private folder beside the system's temporary files.

    Raises:
        OSError: When the private folder belongs to another user or cannot be made.
    """
    caches = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    folder = os.path.expanduser(os.environ.get("VORONERF_CACHE") or os.path.join(caches, "voronerf"))
    if folder.startswith("~"):  # nothing tells the home folder
        user = os.getuid() if hasattr(os, "getuid") else "user"
        return private_folder(Path(tempfile.gettempdir(), f"voronerf-{user}"))
    return Path(folder)


def private_folder(path: Path) -> Path:
    """Makes a folder that only its user may enter, with its parents, and returns it.

    Raises:
        OSError: When the folder cannot be made, belongs to another user, or is a link, which another user may have
            made.
    """
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = path.lstat()
    if hasattr(os, "getuid") and (status.st_uid != os.getuid() or not stat.S_ISDIR(status.st_mode)):
        raise PermissionError(errno.EPERM, "must be a folder of your own; set VORONERF_CACHE to another", str(path))
    return path


def remove_partial(folder: Path) -> None:
    """Removes partial files of interrupted processes below a folder."""
    for partial in folder.rglob(".*.partial"):
        partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically, by :func:`write_bytes`."""
    write_bytes(path, text.encode())


def json_text(value: Any, *, indent: int | None = None) -> str:
    """Returns a value as JSON; infinity and NaN become null.

    An object with such numbers gets a further entry, for example ``"not_finite": {"psnr": "inf"}``.
    """
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        not_finite = {key: str(x) for key, x in value.items() if isinstance(x, float) and not math.isfinite(x)}
        return {key: _finite(x) for key, x in value.items()} | ({"not_finite": not_finite} if not_finite else {})
    if isinstance(value, (list, tuple)):
        return [_finite(x) for x in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


#: The largest size of a JSON file in bytes; parsing takes about twenty times this memory. A frame of a capture has
#: about a kilobyte.
JSON_LIMIT = 2**25


def read_json(path: Path, kind: type = object) -> Any:
    """Returns the contents of a JSON file.

    Args:
        path: The file.
        kind: The type of the contents, dict or list; default any.

    Raises:
        ValueError: When the file is too large or not JSON, or its contents have another type; the message names the
            file.
        OSError: When the file cannot be read.
    """
    text = _read_text(path)
    try:
        value = parse_json(text)
    except ValueError as error:
        raise ValueError(f"{path}: is not JSON: {error}") from None
    if not isinstance(value, kind):
        raise ValueError(f"{path}: must be {'an object' if kind is dict else 'a list'}, got {value!r:.60}")
    return value


def _read_text(path: Path) -> str:
    """Returns the text of a JSON file, or of a file with JSON lines."""
    with open(path, "rb") as file:
        data = file.read(JSON_LIMIT + 1)
    if len(data) > JSON_LIMIT:
        size = path.stat().st_size
        raise ValueError(f"{path}: must be at most {JSON_LIMIT / 2**20:g} MiB of JSON, got {size / 2**20:.1f}")
    if is_utf16(data):
        raise ValueError(f"{path}: is not JSON in UTF-8 but UTF-16 text; save it as UTF-8")
    try:
        return data.decode("utf-8-sig")
    except ValueError as error:
        raise ValueError(f"{path}: is not JSON: {error}") from None


def is_utf16(start: bytes) -> bool:
    """Returns whether a text that begins with these bytes is UTF-16, as editors on Windows may write it."""
    return start[:2] in (b"\xff\xfe", b"\xfe\xff") or (len(start) > 1 and start[:2].count(0) == 1)


def parse_json(text: str) -> Any:
    """Returns the value of JSON text.

    Raises:
        ValueError: When the text is not JSON, or is nested too deeply for Python.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """Returns the objects of a file with one JSON object per line; [] if there is no file.

    Raises:
        ValueError: When the file is too large, or a line is not a JSON object; the message names the file and the line.
    """
    if not path.is_file():
        return []
    values = []
    for number, line in enumerate(_read_text(path).splitlines(), 1):
        try:
            value = parse_json(line)
        except ValueError as error:
            raise ValueError(f"{path}: line {number} is not JSON: {error}") from None
        if not isinstance(value, dict):
            raise ValueError(f"{path}: line {number} must be an object, got {value!r:.60}")
        values.append(value)
    return values
