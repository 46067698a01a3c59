"""Images on disk: decoded once into a file that is mapped into memory, so that a scene need not fit into it.

A store is a folder of the cache with `pixels`, the bytes of all images one after another, and `store.json`, which says
of which files they are and how many are there. A build that is ended at any moment goes on where the record says.

c images of h x w pixels.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import logging
import mmap
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from voronerf.data.scene import SceneError
from voronerf.files import cache_folder, json_text, read_json, write_text

log = logging.getLogger(__name__)

VERSION = 1  # of the files
RECORD_EVERY = 2.0  # seconds of a build
RANDOM, WILL_NEED = 1, 3  # of madvise, on Linux and macOS

# from the number of an image to its pixels, [h, w, channels]
Make = Callable[[int], NDArray[np.uint8]]


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

    Raises:
        SceneError: the store cannot be written; names it and the space it needs.
        What `make` raises.
    """
    folder = cache_folder() / "images" / f"{name[:100]}-{_digest([sources, list(shape)])[:12]}"
    pixels, size = folder / "pixels", int(np.prod(shape))
    wanted = {"version": VERSION, "shape": list(shape), "made_of": _digest(made_of)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _locked(folder):
            done = _there(folder, wanted, size)
            if done < shape[0]:
                _build(folder, wanted, done, shape, make, threads)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of torch, that the array is read-only
            return torch.from_numpy(np.memmap(pixels, np.uint8, "r", shape=tuple(shape)))
    except OSError as error:
        raise SceneError(f"{folder}: cannot hold the {size / 2**30:.2f} GiB of images: {error.strerror}") from None


def _there(folder: Path, wanted: dict[str, Any], size: int) -> int:
    """How many images a store holds already; says where it is of others."""
    try:
        record = read_json(folder / "store.json")
        done = int(record.pop("done"))
    except FileNotFoundError:
        return 0
    except (ValueError, KeyError, TypeError, AttributeError):
        record, done = None, 0
    pixels = folder / "pixels"
    if record != wanted or not pixels.is_file() or pixels.stat().st_size != size:
        log.warning("%s: holds other images than those of the scene now, it is built again", folder)
        return 0
    return done


def _build(folder: Path, wanted: dict[str, Any], done: int, shape: Sequence[int], make: Make, threads: int) -> None:
    pixels, each = folder / "pixels", int(np.prod(shape[1:]))
    if done == 0:
        (folder / "store.json").unlink(missing_ok=True)
        pixels.unlink(missing_ok=True)  # who has mapped it keeps it
    from rich.console import Console  # here, since importing it takes long
    from rich.progress import Progress

    file = os.open(pixels, os.O_RDWR | os.O_CREAT, 0o644)
    console = Console(stderr=True)
    bar = Progress(console=console, transient=True, disable=not console.is_terminal)
    try:
        if hasattr(os, "posix_fallocate"):  # a full disk is an error now, and none while the file is mapped
            os.posix_fallocate(file, 0, each * shape[0])
        else:
            os.truncate(file, each * shape[0])
        recorded = time.monotonic()
        with bar, ThreadPoolExecutor(threads) as pool:
            task = bar.add_task(f"images into {folder}", total=shape[0], completed=done)
            while done < shape[0]:
                numbers = range(done, min(done + 4 * threads, shape[0]))
                for number, image in zip(numbers, pool.map(make, numbers)):
                    _write(file, np.ascontiguousarray(image).data.cast("B"), number * each)
                done = numbers.stop
                bar.update(task, completed=done)
                if done == shape[0] or time.monotonic() - recorded > RECORD_EVERY:
                    os.fsync(file)
                    write_text(folder / "store.json", json_text({**wanted, "done": done}) + "\n")
                    recorded = time.monotonic()
    finally:
        os.close(file)


def _write(file: int, data: memoryview, place: int) -> None:
    while data:
        written = os.pwrite(file, data, place)
        data, place = data[written:], place + written


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Waits for another process that builds the store."""
    if sys.platform == "win32":
        yield
        return
    import fcntl

    number = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(number, fcntl.LOCK_EX)
        yield
    finally:
        os.close(number)


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
        if self.advise is None:
            return
        for page in torch.unique((self.start + index * self.channels) // mmap.PAGESIZE).tolist():
            self.advise(page * mmap.PAGESIZE, mmap.PAGESIZE, WILL_NEED)
