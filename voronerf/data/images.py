"""Reads image files as uint8 tensors and reduces them on the way."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from voronerf.data.scene import SceneError

UNREADABLE = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, Image.DecompressionBombError)
DEEP_MODES = ("I", "F", "I;16", "I;16B", "I;16L", "I;16N")
THREADS = 4


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


def read_image(path: Path, factor: int) -> tuple[NDArray[np.uint8], tuple[int, int]]:
    """Decodes one image file.

    Orientation tags are ignored: poses and intrinsics belong to the pixels as stored. JPEG files are reduced by up to 8
    while they are decoded, since the format stores the average of each block.

    Args:
        path: the file.
        factor: of the reduction, >= 1.

    Returns:
        (pixels [h, w, 3 or 4], (width, height) of the file before the reduction).

    Raises:
        SceneError: the file is not an image, is truncated, has more than 8 bits a channel or too few pixels.
    """
    try:
        with Image.open(path) as file:
            size = file.size
            if file.mode in DEEP_MODES:
                raise SceneError(f"{path}: has more than 8 bits a channel, which is not supported")
            if factor > min(size):
                raise SceneError(f"{path}: downscaling by {factor} leaves no pixel of {size[0]} x {size[1]}")
            rest = factor
            if file.format == "JPEG" and factor % 2 == 0:
                step = next(step for step in (8, 4, 2) if factor % step == 0)
                file.draft("RGB", (size[0] // step, size[1] // step))
                rest = factor if file.size == size else factor // step
            alpha = "A" in file.getbands() or "transparency" in file.info
            pixels = np.asarray(file.convert("RGBA" if alpha else "RGB"))
    except SceneError:
        raise
    except UNREADABLE as error:
        reason = "is not an image" if isinstance(error, Image.UnidentifiedImageError) else f"cannot be read: {error}"
        raise SceneError(f"{path}: {reason}") from None
    pixels = area_average(pixels, rest)
    return pixels[: size[1] // factor, : size[0] // factor], size


def read_images(paths: Sequence[Path], factor: int) -> tuple[Tensor, tuple[int, int]]:
    """Decodes images of one size, in parallel.

    Args:
        paths: at least one file.
        factor: of the reduction, >= 1.

    Returns:
        (uint8 [c, h, w, 3], or [c, h, w, 4] where any image has an alpha channel; (width, height) of the files).

    Raises:
        SceneError: as `read_image`, or images of different sizes.
    """
    with ThreadPoolExecutor(THREADS) as pool:
        decoded = list(pool.map(lambda path: read_image(path, factor), paths))
    size = decoded[0][1]
    for path, (_, other) in zip(paths, decoded):
        if other != size:
            raise SceneError(
                f"{path}: is {other[0]} x {other[1]} pixels but {paths[0]} is {size[0]} x {size[1]}; "
                "all images of a scene must have the same size"
            )
    channels = max(pixels.shape[2] for pixels, _ in decoded)
    height, width = decoded[0][0].shape[:2]
    images = np.full((len(decoded), height, width, channels), 255, dtype=np.uint8)
    for target, (pixels, _) in zip(images, decoded):
        target[..., : pixels.shape[2]] = pixels
    return torch.from_numpy(images), size
