"""Images on disk: decoded once into a memory-mapped file, so that a scene may be larger than the memory.

A store is a folder of the cache with two files. `pixels` holds the bytes of all images, one after another. The record
`store.json` holds a digest of the source files, and a checksum of each stored image. An interrupted build continues
after the recorded images. When a store is opened, all images are compared with their checksums; the first damaged image
and all later images are decoded again.

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

VERSION = 2  # version of the file format
RECORD_EVERY = 2.0  # seconds between two updates of the record
RANDOM, WILL_NEED = 1, 3  # advice values of madvise, on Linux and macOS

# A function from an image's index to its pixels [h, w, channels].
Make = Callable[[int], NDArray[np.uint8]]

# The mapped files that this process uses.
_mapped: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()


def stored(name: str, sources: Sequence[Any], made_of: Any, shape: Sequence[int], make: Make, threads: int) -> Tensor:
    """Returns the images of a store, which is built if it does not exist.

    Args:
        name: name of the scene, with which the folder's name begins.
        sources: JSON values that identify the images, such as their paths; different lists have different stores.
        made_of: JSON value that changes with the images, such as the files' sizes and times; a change rebuilds the
            store.
        shape: shape of the images, [c, h, w, channels].
        make: function that decodes an image.
        threads: number of decoding threads.

    Returns:
        uint8 [c, h, w, channels], read-only.
    """
    folder = cache_folder() / "images" / f"{name[:100]}-{_digest([sources, list(shape)])[:12]}"
    image_bytes = int(np.prod(shape[1:]))
    size = image_bytes * shape[0]
    wanted = {"version": VERSION, "shape": list(shape), "made_of": _digest(made_of)}
    try:
        private_folder(folder.parent)
        private_folder(folder)
        waits = "%s: waiting for another process that decodes these images"
        with locked(folder, lambda: log.warning(waits, folder)):
            sums = _recorded(folder, wanted, shape[0])
            # Other processes may have mapped the old file; they keep it after unlink.
            if not sums:
                (folder / "store.json").unlink(missing_ok=True)
                (folder / "pixels").unlink(missing_ok=True)
            flags = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)  # POSIX and Windows flags
            file = os.open(folder / "pixels", os.O_RDWR | os.O_CREAT | flags, 0o600)
            try:
                _allocate(file, size)
                mapped = mmap.mmap(file, size, access=mmap.ACCESS_READ)
                sums = _undamaged(folder, mapped, sums, image_bytes, threads)
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
        warnings.simplefilter("ignore")  # torch warns that the array is read-only
        return torch.from_numpy(np.frombuffer(mapped, np.uint8).reshape(tuple(shape)))


def check_mapped() -> None:
    """Raises SceneError if a mapped file was truncated: reading the missing part would end the process by SIGBUS."""
    for mapped in _mapped:
        if mapped.size() < len(mapped):
            raise SceneError(
                f"images on disk: their file in {cache_folder() / 'images'} was cut short while it was read"
            )


def _recorded(folder: Path, wanted: dict[str, Any], count: int) -> list[int]:
    """Returns the checksums of the stored images; if the store holds other images, reports this and returns []."""
    try:
        record = read_json(folder / "store.json")
    except FileNotFoundError:
        return []
    except ValueError:
        record = None
    sums = record.pop("checksums", None) if isinstance(record, dict) else None
    if record != wanted or not isinstance(sums, list) or len(sums) > count:
        log.warning("%s: the images of the scene have changed; the store is rebuilt", folder)
        return []
    return sums


def _allocate(file: int, size: int) -> None:
    if hasattr(os, "posix_fallocate"):  # fails on a full disk, before the file is mapped
        os.posix_fallocate(file, 0, size)
    else:
        os.truncate(file, size)


def _undamaged(folder: Path, mapped: mmap.mmap, sums: list[int], image_bytes: int, threads: int) -> list[int]:
    """Returns the checksums of the images before the first damaged image, and reports the damage."""
    view = memoryview(mapped)

    def is_damaged(number: int) -> bool:
        return zlib.crc32(view[number * image_bytes : (number + 1) * image_bytes]) != sums[number]

    with ThreadPoolExecutor(threads) as pool:
        for number, damaged in enumerate(pool.map(is_damaged, range(len(sums)))):
            if damaged:
                log.warning("%s: image %d is damaged; it and all later images are decoded again", folder, number)
                return sums[:number]
    return sums


def _build(
    folder: Path, file: int, wanted: dict[str, Any], sums: list[int], shape: Sequence[int], make: Make, threads: int
) -> None:
    from rich import get_console  # a slow import
    from rich.progress import Progress

    image_bytes = int(np.prod(shape[1:]))
    console = get_console()
    bar = Progress(console=console, transient=True, disable=not console.is_terminal)
    recorded = time.monotonic()
    with bar, ThreadPoolExecutor(threads) as pool:
        task = bar.add_task(f"images into {folder}", total=shape[0], completed=len(sums))
        while len(sums) < shape[0]:
            numbers = range(len(sums), min(len(sums) + 4 * threads, shape[0]))
            for number, image in zip(numbers, pool.map(make, numbers)):
                data = np.ascontiguousarray(image).data.cast("B")
                _write(file, data, number * image_bytes)
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
    """A prefetcher for the pages of a mapped tensor.

    Without prefetching, pages that are not in memory are read one by one, on first access, although a disk serves many
    requests at a time.

    Args:
        images: uint8 [c, h, w, channels], contiguous, mapped from a file.
    """

    def __init__(self, images: Tensor) -> None:
        self.start, self.channels = images.data_ptr(), images.shape[-1]
        self.advise = getattr(ctypes.CDLL(None), "madvise", None) if os.name == "posix" else None
        if self.advise is not None:
            self.advise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
            first = self.start // mmap.PAGESIZE * mmap.PAGESIZE
            # without this advice, each touched page is read with 31 neighbours, which displace other pages
            self.advise(first, self.start + images.numel() - first, RANDOM)

    def fetch(self, index: Tensor) -> None:
        """Starts reading the pages of pixels ``index`` [b], flat indices over all images."""
        check_mapped()
        if self.advise is None:
            return
        for page in torch.unique((self.start + index * self.channels) // mmap.PAGESIZE).tolist():
            self.advise(page * mmap.PAGESIZE, mmap.PAGESIZE, WILL_NEED)
