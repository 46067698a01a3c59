"""Files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import stat
import sys
import threading
from collections.abc import Callable, Iterator
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
            partial.unlink(missing_ok=True)
            with open(partial, "xb") as file:  # which follows no link that lies there
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


@contextlib.contextmanager
def locked(folder: Path, busy: Callable[[], None]) -> Iterator[None]:
    """Locks a folder against other processes; without effect on Windows, and on file systems without locks.

    Args:
        folder: Which is there.
        busy: Called where another process holds the lock, which is waited for unless this raises an error.
    """
    if sys.platform == "win32":
        yield
        return
    import fcntl

    number = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            busy()
            fcntl.flock(number, fcntl.LOCK_EX)
        except OSError:
            pass  # no locks here
        yield
    finally:
        os.close(number)


def leads_outside(path: Path, folder: Path) -> bool:
    """Whether a path leaves a folder, as it is written (``..``, another root) or through a link."""
    return any(not Path(of(path)).is_relative_to(of(folder)) for of in (os.path.abspath, os.path.realpath))


def cache_folder() -> Path:
    """The folder of files that can be made again: VORONERF_CACHE, or `voronerf` in the user's folder of caches."""
    return Path(
        os.environ.get("VORONERF_CACHE") or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "voronerf"
    ).expanduser()


def private_folder(path: Path) -> Path:
    """Makes a folder that its user alone may enter, and returns it; the folders above are made too.

    Raises:
        OSError: When it cannot be made, or when what lies there is another user's, or a link that others may have laid.
    """
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    there = path.lstat()
    if hasattr(os, "getuid") and (there.st_uid != os.getuid() or not stat.S_ISDIR(there.st_mode)):
        raise PermissionError(errno.EPERM, "must be a folder of your own; set VORONERF_CACHE to another", str(path))
    return path


def remove_partial(folder: Path) -> None:
    """Removes what processes that died left of files that they wrote below a folder."""
    for partial in folder.rglob(".*.partial"):
        partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """:func:`write_bytes` for text."""
    write_bytes(path, text.encode())


def json_text(value: Any, *, indent: int | None = None) -> str:
    """A value as JSON, which has no infinity and no NaN: they become null, and the object that holds them tells which
    by ``"not_finite": {"psnr": "inf"}``."""
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        odd = {key: str(x) for key, x in value.items() if isinstance(x, float) and not math.isfinite(x)}
        return {key: _finite(x) for key, x in value.items()} | ({"not_finite": odd} if odd else {})
    if isinstance(value, (list, tuple)):
        return [_finite(x) for x in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


#: Bytes of a JSON file; parsed, it takes some twenty times its size. A frame of a capture takes about a kilobyte.
JSON_LIMIT = 2**25


def read_json(path: Path) -> Any:
    """The contents of a JSON file.

    Raises:
        ValueError: When it is too large or no JSON; names the file.
        OSError: When it cannot be read.
    """
    with open(path, "rb") as file:
        data = file.read(JSON_LIMIT + 1)
    if len(data) > JSON_LIMIT:
        size = path.stat().st_size
        raise ValueError(f"{path}: must be at most {JSON_LIMIT / 2**20:g} MiB of JSON, got {size / 2**20:.1f}")
    try:
        return parse_json(data.decode("utf-8-sig"))
    except ValueError as error:
        raise ValueError(f"{path}: is not JSON: {error}") from None


def parse_json(text: str) -> Any:
    """The value of JSON text.

    Raises:
        ValueError: When it is no JSON, or is nested deeper than Python reads.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """The objects of a file with one JSON object a line; [] when there is no file.

    Raises:
        ValueError: When a line is no JSON object; names the file and the line.
    """
    if not path.is_file():
        return []
    values = []
    for number, line in enumerate(path.read_text().splitlines(), 1):
        try:
            value = parse_json(line)
        except ValueError as error:
            raise ValueError(f"{path}: line {number} is not JSON: {error}") from None
        if not isinstance(value, dict):
            raise ValueError(f"{path}: line {number} must be an object, got {value!r:.60}")
        values.append(value)
    return values
