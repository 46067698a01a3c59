"""Reads image files as uint8 tensors and reduces them, in little more memory than the resulting tensor takes."""

from __future__ import annotations

import contextlib
import functools
import io
import itertools
import math
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms
from PIL.JpegImagePlugin import JpegImageFile
from torch import Tensor

from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.store import stored
from voronerf.ops._core.checks import available_memory

#: The image formats that are read, recognised by a file's content. Pillow reads further formats, some by starting
#: another program.
FORMATS = ("PNG", "JPEG")
UNREADABLE = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, Image.DecompressionBombError)
#: Pillow's modes of images to which a colour profile applies.
COLOURS = ("RGB", "RGBA", "P")
#: Quarter turns anticlockwise that make an image upright, by its orientation tag. Mirrored images stay mirrored.
TURNS = {3: 2, 6: 3, 8: 1}
#: The largest difference of colours in a profile that counts as sRGB.
ROUNDED = 2
#: If alpha is used as a mask, pixels with an alpha below this are masked, since their colour is partly background.
OPAQUE = 250
#: The beginning of the names of instant-ngp's masks, in which only black pixels are kept. The mask of 0.jpg is
#: dynamic_mask_0.png beside it.
DYNAMIC_MASK = "dynamic_mask_"
#: The largest fraction of the free memory for a scene; the rest is for the networks.
SHARE = 0.75
#: Bytes per pixel for rendering and scoring a view, most of them for SSIM.
VIEW = 550
#: The maximum number of decoding threads, and of bytes of the images that they decode at a time.
THREADS, IN_HAND = 4, 2**26
#: The number of pixels that are converted and averaged at a time.
BAND = 2**20


class Header(NamedTuple):
    """The header of an image file.

    Attributes:
        size: (width, height) in pixels, as stored.
        alpha: whether the image has an alpha channel.
        depth: bytes of a decoded pixel in memory.
        jpeg: whether the file is JPEG.
        turns: quarter turns anticlockwise that make the image upright, by the orientation tag.
        deep: whether the image has 16 bits a channel, of which the upper 8 are read.
    """

    size: tuple[int, int]
    alpha: bool = False
    depth: int = 4
    jpeg: bool = False
    turns: int = 0
    deep: bool = False

    def decoded(self, factor: int) -> int:
        """Returns the memory for decoding the image, in bytes."""
        width, height = (-(-side // _reduction(self.jpeg, factor)) for side in self.size)
        return width * height * self.depth


def area_average(image: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Averages blocks of `factor` x `factor` pixels; columns and rows of incomplete blocks are dropped.

    With alpha, premultiplied colours are averaged, which equals averaging the image composited on any background. The
    result has straight alpha. Rounding to 8 bits changes the composited colour by at most one level.

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


def read_header(path: Path) -> Header:
    """Reads the header of an image file, without its pixels."""
    with _opened(path) as file:
        jpeg, turns = isinstance(file, JpegImageFile), 0
        if jpeg:  # for a PNG, Pillow would decode the pixels
            with contextlib.suppress(*UNREADABLE):  # a broken tag counts as missing
                turns = TURNS.get(file.getexif().get(ExifTags.Base.Orientation, 1), 0)
        # Pillow keeps colours in four bytes a pixel.
        depth = 1 if len(file.getbands()) == 1 else 4
        return Header(file.size, _has_alpha(file), depth, jpeg, turns, is_deep(file))


def read_image(path: Path, factor: int) -> NDArray[np.uint8]:
    """Decodes one image file.

    The orientation tag is ignored, since poses and intrinsics refer to the image as stored. JPEG files are reduced by
    up to 8 during decoding, from the low frequencies of each block of 8 x 8 pixels, which saves time and memory.
    Colours are converted to sRGB by the colour profile of the file.

    Returns:
        [h, w, 3], or [h, w, 4] with an alpha channel.
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
        transform = _to_srgb(file.info.get("icc_profile"), mode) if file.mode in COLOURS else None
        return pixels if transform is None else np.array(ImageCms.applyTransform(Image.fromarray(pixels), transform))


def is_deep(file: Image.Image) -> bool:
    """Returns whether an opened file, whose pixels are not decoded yet, has 16 bits a channel."""
    return re.search(r";16[BLN]", str(getattr(file, "tile", ""))) is not None


def check_grey(image: Image.Image, path: Path) -> None:
    """Raises SceneError for grey values of more than 8 bits, whose range is unknown."""
    if image.mode[0] in "IF":
        raise SceneError(f"{path}: has grey values of more than 8 bits; write it with 8 bits a channel")


@functools.lru_cache(maxsize=8)
def _to_srgb(profile: bytes | None, mode: str) -> ImageCms.ImageCmsTransform | None:
    """Returns the transform from a colour profile, such as Display P3, to sRGB; None if there is nothing to convert."""
    if not profile:
        return None
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        transform = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), mode, mode)
    except (ImageCms.PyCMSError, OSError):  # a broken profile counts as missing
        return None
    levels = np.linspace(0, 255, 9).astype(np.uint8)
    colours = np.stack(np.meshgrid(*[levels] * 3), -1).reshape(1, -1, 3)
    colours = np.concatenate((colours, np.full_like(colours[..., :1], 255)), -1)[..., : len(mode)]
    shown = np.asarray(ImageCms.applyTransform(Image.fromarray(colours), transform))
    return transform if np.abs(shown.astype(int) - colours).max() > ROUNDED else None


class Decoded(NamedTuple):
    """The result of `read_images`.

    Attributes:
        images: uint8 [c, h, w, 3], or [c, h, w, 4] if any image has an alpha channel. Smaller images lie in the upper
            left corner, padded with zeros.
        sizes: int64 [c, 2], (width, height) of the files.
        on_disk: whether the images are mapped from a file of the cache, and read-only.
        turns: number of quarter turns anticlockwise by which each image has been turned.
    """

    images: Tensor
    sizes: Tensor
    on_disk: bool
    turns: list[int]


def read_images(
    paths: Sequence[Path],
    factor: int,
    *,
    headers: Sequence[Header | None] = (),
    keep: str = "auto",
    name: str = "images",
    most_channels: int = 4,
    upright: bool = False,
) -> Decoded:
    """Decodes images; in addition to the result, the memory holds only one image, or several small images.

    Args:
        paths: at least one file.
        headers: the headers, with None for each header that has not been read yet.
        factor: downscale factor, >= 1.
        keep: "memory"; "disk", see `voronerf.app.scenes.store`; or "auto": on disk if memory is short.
        name: the name of the scene.
        most_channels: the maximum number of channels; 3 drops alpha.
        upright: turn images upright by their orientation tags.
    """
    found_headers = [header or read_header(path) for path, header in itertools.zip_longest(paths, headers)]
    for path, header in zip(paths, found_headers):
        if factor > min(header.size):
            raise SceneError(f"{path}: downscaling by {factor} leaves no pixel of {header.size[0]} x {header.size[1]}")
    sizes = torch.tensor([header.size for header in found_headers], device="cpu")
    turns = [header.turns if upright else 0 for header in found_headers]
    size = torch.where((sizes.new_tensor(turns) % 2 == 1)[:, None], sizes.flip(1), sizes).amax(0).tolist()
    differ = bool((sizes != sizes[:1]).any())
    channels = min(4 if any(header.alpha for header in found_headers) else 3, most_channels)
    shape = (len(paths), size[1] // factor, size[0] // factor, channels)
    decoded = max(header.decoded(factor) for header in found_headers)
    threads = max(1, min(THREADS, IN_HAND // decoded))
    pixels = shape[1] * shape[2]
    needed, free = len(paths) * pixels * channels + max(decoded, pixels * VIEW), available_memory()

    def make(index: int) -> NDArray[np.uint8]:
        turned = np.rot90(read_image(paths[index], factor), turns[index])
        if turned.shape == shape[1:]:
            return turned
        image = np.zeros(shape[1:], dtype=np.uint8)
        place = image[: turned.shape[0], : turned.shape[1]]
        place[..., 3:] = 255
        place[..., : turned.shape[2]] = turned[..., :channels]
        return image

    if keep == "disk" or (keep == "auto" and needed > SHARE * free):
        sources = [str(path.absolute()) for path in paths]
        return Decoded(stored(name, [sources, factor, turns], _times(paths), shape, make, threads), sizes, True, turns)
    if needed > SHARE * free:
        raise SceneError(
            f"{paths[0]}: {len(paths)} images of {'up to ' * differ}{size[0]} x {size[1]} need {needed / 2**30:.2f} "
            f"GiB with --downscale {factor}, more than {SHARE:.0%} of the {free / 2**30:.2f} GiB that are free; use a "
            "larger --downscale, fewer or smaller images, or --images disk"
        )
    images = np.zeros(shape, dtype=np.uint8)

    def fill(index: int) -> None:
        images[index] = make(index)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(fill, range(len(paths))))
    return Decoded(torch.from_numpy(images), sizes, False, turns)


def _times(paths: Sequence[Path | None]) -> list[tuple[int, int, int] | None]:
    """Returns (size, mtime, ctime) of each file; programs can set mtime, but not ctime."""
    stats = [None if path is None else path.stat() for path in paths]
    return [None if stat is None else (stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns) for stat in stats]


def read_masks(
    masks: Sequence[Path | None],
    paths: Sequence[Path],
    images: Decoded,
    factor: int,
    *,
    name: str = "images",
    alpha: bool = False,
) -> Tensor | None:
    """Decodes the masks of images; a pixel of a reduced mask is True if its whole block is kept.

    Args:
        masks: the mask file of each image, or None for an image without a mask. Black pixels are excluded; in
            files named `DYNAMIC_MASK`..., all other pixels are.
        paths: the image files.
        images: the decoded images, which have the size of their masks or a smaller size. Each mask is rotated like its
            image. If the images are stored on disk, the masks are stored there too.
        factor: downscale factor.
        name: the name of the scene.
        alpha: exclude transparent pixels, too.

    Returns:
        bool [c, h, w], False in the padding of smaller images; None if no image has a mask and ``alpha`` is False.
    """
    if not any(masks) and not alpha:
        return None
    turns, shape = images.turns, (len(masks), *images.images.shape[1:3])

    def make(index: int) -> NDArray[np.uint8]:
        mask, path, size = masks[index], paths[index], images.sizes[index].tolist()
        width, height = (side // factor for side in size)
        kept: Any = np.ones((height, width), dtype=bool)
        if mask is not None:
            with _opened(mask) as file:
                kept = drawn(file, size, turns[index], inverted=mask.name.startswith(DYNAMIC_MASK))
            high, wide = kept.shape
            scale = wide / size[0]  # above 1, the image was reduced after the mask was made
            if scale < 1 or abs(high - scale * size[1]) >= scale:
                raise SceneError(f"{mask}: is {wide} x {high} pixels, {path.name} is {size[0]} x {size[1]}")
            if scale > 1:
                mask_image = Image.fromarray(kept.astype(np.uint8) * 255)
                kept = np.asarray(mask_image.resize(size, Image.Resampling.BOX)) == 255
            kept = kept[: height * factor, : width * factor]
            kept = kept.reshape(height, factor, width, factor).all(axis=(1, 3))
        kept = np.rot90(kept, turns[index])
        if alpha:
            kept = kept & (images.images[index, : kept.shape[0], : kept.shape[1], 3].numpy() >= OPAQUE)
        if not kept.any():
            cause = f"{mask}:" if mask else f"{path}: its alpha"
            raise SceneError(f"{cause} excludes all pixels (with --downscale, all blocks); remove the image")
        place = np.zeros(shape[1:], dtype=np.uint8)
        place[: kept.shape[0], : kept.shape[1]] = kept
        return place

    if images.on_disk:
        files = [*masks, *(paths if alpha else ())]
        sources = [None if file is None else str(file.absolute()) for file in files]
        return stored(f"{name}-masks", [sources, factor, turns], _times(files), shape, make, 1).view(torch.bool)
    return torch.from_numpy(np.stack([make(index) for index in range(len(masks))])).view(torch.bool)


def drawn(mask: Image.Image, size: Sequence[int], turns: int, *, inverted: bool = False) -> NDArray[np.bool_]:
    """Returns bool [h, w], oriented like the stored image: whether a mask's pixel is neither black nor transparent.

    A mask may have been drawn on the upright image. Since JPEG blurs borders, pixels of a JPEG mask that are darker
    than grey count as black.

    Args:
        mask: the opened mask file.
        size: (width, height) of the image as stored, or proportional to it.
        turns: quarter turns anticlockwise that make the image upright.
        inverted: invert the result.
    """
    kept = np.asarray(mask.convert("L")) > (127 if isinstance(mask, JpegImageFile) else 0)
    if mask.has_transparency_data:
        kept = kept & (np.asarray(mask.convert("RGBA"))[..., 3] > 0)
    kept = kept != inverted
    upright = turns % 2 == 1 and (mask.width > mask.height) != (size[0] > size[1])
    return np.rot90(kept, -turns) if upright else kept


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """Opens an image file without decoding its pixels."""
    try:
        with open(path, "rb") as stream, Image.open(stream, formats=FORMATS) as file:
            check_grey(file, path)
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
    """Makes Pillow reduce a JPEG file during decoding, and returns the remaining downscale factor.

    JPEG includes files with a second picture, which Pillow calls MPO.
    """
    size, step = file.size, _reduction(isinstance(file, JpegImageFile), factor)
    if step > 1:
        file.draft("RGB", (size[0] // step, size[1] // step))
    return factor if file.size == size else factor // step


def _reduction(jpeg: bool, factor: int) -> int:
    """Returns the factor by which a file can be reduced during decoding."""
    return math.gcd(factor, 8) if jpeg else 1
