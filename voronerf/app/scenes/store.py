"""Images on disk: decoded once into a file that is mapped into memory, so that a scene need not fit into it.

A store is a folder of the cache with `pixels`, the bytes of all images one after another, and `store.json`, which says
of which files they are, and the checksum of each image that is there. A build that is ended at any moment goes on where
the record says. Where a store is opened, all of it is read and compared with the checksums: what was damaged is built
again.

c images of h x w pixels.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import mmap
import os
import time
import warnings
import weakref
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from voronerf.app.files import cache_folder, json_text, locked, private_folder, read_json, write_text
from voronerf.app.scenes.errors import SceneError

log = logging.getLogger(__name__)

VERSION = 2  # of the files
RECORD_EVERY = 2.0  # seconds of a build
RANDOM, WILL_NEED = 1, 3  # of madvise, on Linux and macOS

# from the number of an image to its pixels, [h, w, channels]
Make = Callable[[int], NDArray[np.uint8]]

# The files of this process that are mapped and in use.
_mapped: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()


def stored(name: str, sources: Sequence[Any], made_of: Any, shape: Sequence[int], make: Make, threads: int) -> Tensor:
    """The images of a store, which is built where it is not there yet.

    Args:
        name: of the scene, with which that of the folder begins.
        sources: which images they are, such as their paths; another list is another store.
        made_of: what they were made of, such as the sizes and times of the files; where it has changed, the store is
            built again.
        shape: of the images, [c, h, w, channels].
        make: decodes an image.
        threads: that decode at the same time.

    Returns:
        uint8 [c, h, w, channels], which must not be written to.
    """
    folder = cache_folder() / "images" / f"{name[:100]}-{_digest([sources, list(shape)])[:12]}"
    each = int(np.prod(shape[1:]))
    size = each * shape[0]
    wanted = {"version": VERSION, "shape": list(shape), "made_of": _digest(made_of)}
    try:
        private_folder(folder.parent)
        private_folder(folder)
        waits = "%s: another process makes these images, this one waits for it"
        with locked(folder, lambda: log.warning(waits, folder)):
            sums = _recorded(folder, wanted, shape[0])
            # who has mapped a file that holds other images keeps it
            if not sums:
                (folder / "store.json").unlink(missing_ok=True)
                (folder / "pixels").unlink(missing_ok=True)
            flags = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)  # of POSIX, and of Windows
            file = os.open(folder / "pixels", os.O_RDWR | os.O_CREAT | flags, 0o600)
            try:
                _allocate(file, size)
                mapped = mmap.mmap(file, size, access=mmap.ACCESS_READ)
                sums = _undamaged(folder, mapped, sums, each, threads)
                if len(sums) < shape[0]:
                    _build(folder, file, wanted, sums, shape, make, threads)
            finally:
                os.close(file)
    except OSError as error:
        raise SceneError(
            f"{error.filename or folder}: cannot hold the {size / 2**30:.2f} GiB of images: {error.strerror}"
        ) from None
    _mapped.add(mapped)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch, that the array is read-only
        return torch.from_numpy(np.frombuffer(mapped, np.uint8).reshape(tuple(shape)))


def check_mapped() -> None:
    """Raises SceneError where a mapped file has become shorter: who reads what is missing is ended by SIGBUS."""
    for mapped in _mapped:
        if mapped.size() < len(mapped):
            raise SceneError(
                f"images on disk: their file in {cache_folder() / 'images'} was cut short while it was read"
            )


def _recorded(folder: Path, wanted: dict[str, Any], count: int) -> list[int]:
    """The checksums of the images that a store holds already; says where it is of others."""
    try:
        record = read_json(folder / "store.json")
    except FileNotFoundError:
        return []
    except ValueError:
        record = None
    sums = record.pop("checksums", None) if isinstance(record, dict) else None
    if record != wanted or not isinstance(sums, list) or len(sums) > count:
        log.warning("%s: holds other images than those of the scene now, it is built again", folder)
        return []
    return sums


def _allocate(file: int, size: int) -> None:
    if hasattr(os, "posix_fallocate"):  # a full disk is an error now, and none while the file is mapped
        os.posix_fallocate(file, 0, size)
    else:
        os.truncate(file, size)


def _undamaged(folder: Path, mapped: mmap.mmap, sums: list[int], each: int, threads: int) -> list[int]:
    """The checksums up to the first damaged image; says which that is."""
    view = memoryview(mapped)

    def is_damaged(number: int) -> bool:
        return zlib.crc32(view[number * each : (number + 1) * each]) != sums[number]

    with ThreadPoolExecutor(threads) as pool:
        for number, damaged in enumerate(pool.map(is_damaged, range(len(sums)))):
            if damaged:
                log.warning("%s: image %d is damaged, it and those behind it are made again", folder, number)
                return sums[:number]
    return sums


def _build(
    folder: Path, file: int, wanted: dict[str, Any], sums: list[int], shape: Sequence[int], make: Make, threads: int
) -> None:
    from rich import get_console  # here, since importing it takes long
    from rich.progress import Progress

    each = int(np.prod(shape[1:]))
    console = get_console()
    bar = Progress(console=console, transient=True, disable=not console.is_terminal)
    recorded = time.monotonic()
    with bar, ThreadPoolExecutor(threads) as pool:
        task = bar.add_task(f"images into {folder}", total=shape[0], completed=len(sums))
        while len(sums) < shape[0]:
            numbers = range(len(sums), min(len(sums) + 4 * threads, shape[0]))
            for number, image in zip(numbers, pool.map(make, numbers)):
                data = np.ascontiguousarray(image).data.cast("B")
                _write(file, data, number * each)
                sums.append(zlib.crc32(data))
            bar.update(task, completed=len(sums))
            if len(sums) == shape[0] or time.monotonic() - recorded > RECORD_EVERY:
                os.fsync(file)
                write_text(folder / "store.json", json_text({**wanted, "checksums": sums}) + "\n")
                recorded = time.monotonic()


def _write(file: int, data: memoryview, place: int) -> None:
    os.lseek(file, place, os.SEEK_SET)
    while data:
        data = data[os.write(file, data) :]


def _digest(value: Any) -> str:
    return hashlib.sha256(json_text(value).encode()).hexdigest()


class Pages:
    """Has the pages of a mapped tensor read before they are needed, many at a time.

    A page that is not in memory is read when it is touched, one after another. The disk takes many requests at once.

    Args:
        images: uint8 [c, h, w, channels], contiguous, mapped from a file.
    """

    def __init__(self, images: Tensor) -> None:
        self.start, self.channels = images.data_ptr(), images.shape[-1]
        self.advise = getattr(ctypes.CDLL(None), "madvise", None) if os.name == "posix" else None
        if self.advise is not None:
            self.advise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
            first = self.start // mmap.PAGESIZE * mmap.PAGESIZE
            # without it a touched page is read with 31 neighbours, which push others out
            self.advise(first, self.start + images.numel() - first, RANDOM)

    def fetch(self, index: Tensor) -> None:
        """Begins to read the pages of pixels [b], numbered through all images."""
        check_mapped()
        if self.advise is None:
            return
        for page in torch.unique((self.start + index * self.channels) // mmap.PAGESIZE).tolist():
            self.advise(page * mmap.PAGESIZE, mmap.PAGESIZE, WILL_NEED)
