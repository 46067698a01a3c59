"""Reads image files as uint8 tensors and reduces them on the way, in little more memory than the scene will take."""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from voronerf.checks import available_memory
from voronerf.data.scene import SceneError

#: Decided by the content of a file. Pillow would read others too, some of them by starting another program.
FORMATS = ("PNG", "JPEG")
UNREADABLE = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, Image.DecompressionBombError)
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_DEPTH = 24  # offset of the bits a channel
#: Share of the free memory that a scene may need; the rest is for the networks.
SHARE = 0.75
#: Bytes for each pixel while a view is rendered and scored, most of them for SSIM.
VIEW = 550
#: Bytes for the number of each pixel that is trained, where that is not all of them.
NUMBER = 8
#: Images are decoded by up to four threads while those in hand take at most this many bytes.
THREADS, IN_HAND = 4, 2**26
#: Pixels that are converted and averaged at a time.
BAND = 2**20


class Header(NamedTuple):
    """What an image file says of itself: (width, height), an alpha channel, bytes of memory to decode it."""

    size: tuple[int, int]
    alpha: bool
    decoded: int


def area_average(image: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Averages blocks of `factor` x `factor` pixels; columns and rows that fill no block are dropped.

    With alpha, premultiplied colours are averaged, which equals averaging the image composited on any background. The
    result is straight colour and alpha. Rounding both to 8 bits changes the composited colour by at most one level.

    Args:
        image: [h, w, 3] or [h, w, 4].
        factor: >= 1.

    Returns:
        [h // factor, w // factor, 3 or 4].
    """
    if factor == 1:
        return image
    height, width = image.shape[0] // factor, image.shape[1] // factor
    values = image[: height * factor, : width * factor].astype(np.float32)
    if image.shape[2] == 4:
        values[..., :3] *= values[..., 3:]
    values = values.reshape(height, factor, width, factor, image.shape[2]).mean(axis=(1, 3))
    if image.shape[2] == 4:
        values[..., :3] /= np.maximum(values[..., 3:], 1e-6)
    return np.rint(values).clip(0, 255).astype(np.uint8)


def read_header(path: Path, factor: int) -> Header:
    """Reads the header of an image file, without its pixels.

    Args:
        path: the file.
        factor: of the reduction, >= 1.

    Raises:
        SceneError: the file is neither PNG nor JPEG, has more than 8 bits a channel or too few pixels.
    """
    with _opened(path) as file:
        size, alpha = file.size, _has_alpha(file)
        if factor > min(size):
            raise SceneError(f"{path}: downscaling by {factor} leaves no pixel of {size[0]} x {size[1]}")
        _reduce_while_decoding(file, factor)
        # Pillow keeps colours in four bytes a pixel.
        return Header(size, alpha, file.width * file.height * (1 if len(file.getbands()) == 1 else 4))


def read_image(path: Path, factor: int) -> NDArray[np.uint8]:
    """Decodes one image file.

    Orientation tags are ignored: poses and intrinsics belong to the pixels as stored. JPEG files are reduced by up to 8
    while they are decoded, from the low frequencies of each block of 8 x 8 pixels, which saves time and memory.

    Args:
        path: the file.
        factor: of the reduction, from 1 to the number of pixels of the shorter side.

    Returns:
        [h, w, 3], or [h, w, 4] with an alpha channel.

    Raises:
        SceneError: the file is no image that can be read, or is truncated.
    """
    with _opened(path) as file:
        width, height = (side // factor for side in file.size)
        mode = "RGBA" if _has_alpha(file) else "RGB"
        rest = _reduce_while_decoding(file, factor)
        pixels = np.empty((height, width, len(mode)), dtype=np.uint8)
        rows = max(1, BAND // (width * rest**2))
        for top in range(0, height, rows):
            bottom = min(top + rows, height)
            band = file.crop((0, top * rest, width * rest, bottom * rest)).convert(mode)
            pixels[top:bottom] = area_average(np.asarray(band), rest)
        return pixels


def read_images(paths: Sequence[Path], factor: int) -> tuple[Tensor, Tensor]:
    """Decodes images; memory holds the result and one image, or several small ones.

    Args:
        paths: at least one file.
        factor: of the reduction, >= 1.

    Returns:
        (uint8 [c, h, w, 3], or [c, h, w, 4] where any image has an alpha channel, with the smaller ones in the upper
        left corner and zeros around them; int64 [c, 2], (width, height) of the files).

    Raises:
        SceneError: as `read_header` and `read_image`, or more than fit into memory.
    """
    headers = [read_header(path, factor) for path in paths]
    sizes = torch.tensor([header.size for header in headers])
    size = sizes.amax(0).tolist()
    differ = bool((sizes != sizes[:1]).any())
    channels = 4 if any(header.alpha for header in headers) else 3
    shape = (len(paths), size[1] // factor, size[0] // factor, channels)
    decoded = max(header.decoded for header in headers)
    pixels = shape[1] * shape[2]
    each = pixels * (channels + (NUMBER if channels == 4 or differ else 0))
    needed, free = len(paths) * each + max(decoded, pixels * VIEW), available_memory()
    if needed > SHARE * free:
        raise SceneError(
            f"{paths[0]}: {len(paths)} images of {'up to ' * differ}{size[0]} x {size[1]} need {needed / 2**30:.2f} "
            f"GiB with --downscale {factor}, more than {SHARE:.0%} of the {free / 2**30:.2f} GiB that are free; use a "
            "larger --downscale, fewer or smaller images"
        )
    images = np.zeros(shape, dtype=np.uint8)

    def fill(index: int) -> None:
        pixels = read_image(paths[index], factor)
        place = images[index, : pixels.shape[0], : pixels.shape[1]]
        place[..., 3:] = 255
        place[..., : pixels.shape[2]] = pixels

    with ThreadPoolExecutor(max(1, min(THREADS, IN_HAND // decoded))) as pool:
        list(pool.map(fill, range(len(paths))))
    return torch.from_numpy(images), sizes


def read_masks(masks: Sequence[Path | None], paths: Sequence[Path], sizes: Tensor, factor: int) -> Tensor | None:
    """Decodes the masks of images: black pixels do not count, nor does a block that has one.

    Args:
        masks: the file of each image, or None where all of it counts.
        paths: of the images.
        sizes: int64 [c, 2], (width, height) of the images, and of their masks.
        factor: of the reduction.

    Returns:
        bool [c, h, w], False around smaller images; None if no image has a mask.

    Raises:
        SceneError: as `read_image`, a mask of another size than its image, or one that leaves nothing.
    """
    if not any(masks):
        return None
    width, height = (sizes.amax(0) // factor).tolist()
    found = torch.zeros(len(masks), height, width, dtype=torch.bool)
    for place, mask, path, size in zip(found, masks, paths, sizes.tolist()):
        width, height = (side // factor for side in size)
        place[:height, :width] = True
        if mask is None:
            continue
        with _opened(mask) as file:
            if list(file.size) != size:
                raise SceneError(
                    f"{mask}: is {file.size[0]} x {file.size[1]} pixels, {path.name} is {size[0]} x {size[1]}"
                )
            kept = np.asarray(file.convert("L"))[: height * factor, : width * factor] > 0
        place[:height, :width] = torch.from_numpy(kept.reshape(height, factor, width, factor).all(axis=(1, 3)))
        if not bool(place.any()):
            raise SceneError(f"{mask}: must leave a pixel, or with --downscale a block of pixels, of {path.name}")
    return found


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """An image file whose pixels are not decoded yet."""
    try:
        with open(path, "rb") as stream:
            start = stream.read(PNG_DEPTH + 1)
            stream.seek(0)
            # Pillow rounds most of these to 8 bits without a word.
            if start.startswith(PNG_SIGNATURE) and start[PNG_DEPTH:] == b"\x10":
                raise SceneError(f"{path}: has more than 8 bits a channel, which is not supported")
            with Image.open(stream, formats=FORMATS) as file:
                yield file
    except SceneError:
        raise
    except UNREADABLE as error:
        unknown = isinstance(error, Image.UnidentifiedImageError)
        reason = f"is not an image in {' or '.join(FORMATS)} format" if unknown else f"cannot be read: {error}"
        raise SceneError(f"{path}: {reason}") from None


def _has_alpha(file: Image.Image) -> bool:
    return "A" in file.getbands() or "transparency" in file.info


def _reduce_while_decoding(file: Image.Image, factor: int) -> int:
    """Lets a JPEG file be decoded in a part of its size; returns the factor that is left."""
    if file.format != "JPEG" or factor % 2:
        return factor
    size = file.size
    step = next(step for step in (8, 4, 2) if factor % step == 0)
    file.draft("RGB", (size[0] // step, size[1] // step))
    return factor if file.size == size else factor // step
