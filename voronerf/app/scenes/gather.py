"""Gathers images of a folder or frames of a video for COLMAP, as PNG and JPEG files without duplicates."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folders import CONVERTED, HEIF, SUFFIXES, listed_images
from voronerf.app.scenes.images import UNREADABLE, Header, drawn, read_header, read_image
from voronerf.app.scenes.soundness import some_of

#: Container formats of videos. Playlists are excluded, since they name other files.
CONTAINERS = "mov,matroska,avi,mpegts,mpeg"
#: Image formats, recognised by the content of a file, and the formats that are copied unchanged. MPO is JPEG with two
#: pictures.
FORMATS = ("PNG", "JPEG", "WebP", "TIFF", "BMP")
COPIED = ("PNG", "JPEG", "MPO")
#: The EXIF tags from which COLMAP gets a focal length.
CAMERA = (ExifTags.Base.Make, ExifTags.Base.Model)
LENS = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm)
#: Image suffixes in order of preference. If files differ in suffix alone, such as a photograph and its cut-out, only
#: the first is taken.
KINDS = (*reversed(SUFFIXES), *CONVERTED)
#: Files and folders of operating systems, which are ignored like hidden ones.
IGNORED = ("thumbs.db", "desktop.ini", "__macosx", "@eadir")
#: Folders of masks, depths and smaller copies that programs keep beside photographs.
BESIDE = re.compile(r"(?i)masks?|depths?|images_\d+")
LEAST_IMAGES = 3

Progress = Callable[[str, int, int], None]


def gather(
    source: Path, images: Path, masks: Path, frames: int, *, say: Callable[[str], None], progress: Progress
) -> None:
    """Copies the images of a folder and their masks, or extracts frames of a video.

    Args:
        source: a video, or a folder, as in :func:`voronerf.app.scenes.process.process`.
        images: the empty folder for the images.
        masks: the folder for the masks, which is made only if there are masks.
        frames: the number of frames to extract from a video.
        say: called with a line for the user, such as about files that are left out.
        progress: called with the name "images", the number of copied images, and the number of all images.
    """
    folder, files = _list_images(source, say) if source.is_dir() else (source, [])
    progress("images", 0, len(files))
    copied = _copy_images(folder, files, images, say, progress)
    if not source.is_dir():
        _take_frames(source, images, frames, say)
    if repeats := _remove_repeats(images):
        say(f"{folder}: {len(repeats)} byte-identical copies of images are left out: {some_of(repeats)}")
    count = len(listed_images(images))
    if count < LEAST_IMAGES:
        raise SceneError(f"{folder}: must have at least {LEAST_IMAGES} images, got {count}")
    _copy_masks(folder, {copy: path for copy, path in copied.items() if copy.exists()}, masks, say)


def emptied(folder: Path) -> Path:
    """Makes a new folder in place of an existing one, and returns it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def _files(folder: Path) -> Iterator[Path]:
    """Yields the files of a folder and its subfolders.

    It skips hidden files, system files, folders of masks, depths and smaller copies, and scenes made by
    :func:`process`.
    """

    def counts(path: Path) -> bool:
        return not path.name.startswith(".") and path.name.lower() not in IGNORED

    for place, folders, files in os.walk(folder):
        inside = [path for name in folders if counts(path := Path(place, name)) and not BESIDE.fullmatch(name)]
        folders[:] = [path.name for path in inside if not (path / "colmap" / "settings.json").is_file()]
        yield from (path for name in files if counts(path := Path(place, name)))


def _list_images(folder: Path, say: Callable[[str], None]) -> tuple[Path, list[Path]]:
    """Returns the folder of the images and the image files, and reports the files that are left out.

    The images are in ``folder`` itself or, if it has none, in its subfolder `images`, or in all its subfolders.
    """
    files = sorted(_files(folder))
    images = [path for path in files if path.suffix.lower() in KINDS]
    deeper = [path for path in images if path.parent != folder]
    if len(deeper) < len(images):
        if deeper:
            say(f"{folder}: {len(deeper)} images in subfolders are left out, since the folder itself has images")
        files, images = ([path for path in paths if path.parent == folder] for paths in (files, images))
    elif inner := next((path for path in folder.iterdir() if path.is_dir() and path.name.lower() == "images"), None):
        if skipped := sum(inner not in path.parents for path in images):
            say(f"{folder}: {skipped} images outside of {inner.name} are left out")
        return _list_images(inner, say)
    elif len(places := Counter(str(path.parent.relative_to(folder)) for path in deeper)) > 1:
        say(f"{folder}: the images come from {some_of([f'{name} ({count})' for name, count in places.items()])}")
    if others := Counter(path.suffix.lower() or path.name for path in files if path.suffix.lower() not in KINDS):
        listed = [f"{count} {kind}" for kind, count in others.most_common()]
        say(f"{folder}: other files than {', '.join(FORMATS)} and HEIC are left out: {some_of(listed)}")
    phone = [path for path in images if path.suffix.lower() in HEIF]
    if phone and importlib.util.find_spec("pillow_heif") is None:
        say(f"{folder}: {len(phone)} HEIC images are left out; pip install pillow-heif reads them")
        images = [path for path in images if path.suffix.lower() not in HEIF]
    images.sort(key=lambda path: KINDS.index(path.suffix.lower()))
    first = {path.with_suffix(""): path for path in reversed(images)}
    if repeats := [str(path.relative_to(folder)) for path in images if first[path.with_suffix("")] != path]:
        say(
            f"{folder}: {len(repeats)} images are left out, since they also exist in another format: {some_of(repeats)}"
        )
    return folder, sorted(first.values())


def _copy_images(
    folder: Path, files: Sequence[Path], part: Path, say: Callable[[str], None], progress: Progress
) -> dict[Path, Path]:
    """Copies images to a folder, and returns the original of each copy.

    In the copies' names, `_` replaces `/` and spaces, since COLMAP's lists of pairs separate names by spaces.
    """
    copied: dict[Path, Path] = {}
    deep = []
    for path in files:
        copy, reduced = _copy_image(path, part / "_".join("_".join(path.relative_to(folder).parts).split()))
        if copy in copied:
            raise SceneError(f"{path}: {copied[copy]} has the same name, once _ replaces spaces and /")
        copied[copy] = path
        deep += [path.name] * reduced
        progress("images", len(copied), len(files))
    if deep:
        say(f"{folder}: {len(deep)} images have 16 bits a channel, of which the upper 8 are kept: {some_of(deep)}")
    return copied


def _opened(path: Path) -> Image.Image:
    """Opens an image of any supported format."""
    if path.suffix.lower() not in HEIF:
        return Image.open(path, formats=FORMATS)
    import pillow_heif

    image: Image.Image = pillow_heif.open_heif(path).to_pillow()  # upright, with a matching tag
    return image


def _copy_image(path: Path, copy: Path) -> tuple[Path, bool]:
    """Copies a PNG or JPEG image; converts other images, upright and with the EXIF tags of their camera and lens.

    HEIC and lossy WebP become JPEG unless they are transparent; other images become PNG.

    Returns:
        The path of the copy, whose suffix may differ, and whether 16 bits a channel were reduced to 8.
    """
    try:
        with _opened(path) as image:
            deep = re.search(r";16[BLN]", str(getattr(image, "tile", ""))) is not None
            if image.format in COPIED and not deep:
                read_image(path, min(8, *read_header(path).size))  # refuses truncated files, which COLMAP accepts
                shutil.copyfile(path, copy)
                return copy, deep
            if image.mode[0] in "IF":
                raise SceneError(f"{path}: has grey values of more than 8 bits; write it with 8 bits a channel")
            lossy = image.format is None or (image.format == "WEBP" and b"VP8L" not in path.read_bytes())
            copy = copy.with_suffix(".jpg" if lossy and not image.has_transparency_data else ".png")
            exif = image.getexif()
            lens, written = exif.get_ifd(ExifTags.IFD.Exif), Image.Exif()
            written[ExifTags.IFD.Exif] = {tag: lens[tag] for tag in LENS if tag in lens}
            written.update({tag: exif[tag] for tag in CAMERA if tag in exif})
            upright = ImageOps.exif_transpose(image).convert("RGBA" if image.has_transparency_data else "RGB")
            upright.save(copy, quality=95, compress_level=1, exif=written)
    except SceneError:
        raise
    except Image.UnidentifiedImageError:
        raise SceneError(f"{path}: is not an image in {', '.join(FORMATS)} format") from None
    except (*UNREADABLE, RuntimeError) as error:
        raise SceneError(f"{path}: cannot be read: {error}") from None
    return copy, deep


def _remove_repeats(folder: Path) -> list[str]:
    """Removes byte-identical copies of images, such as `a (1).jpg` beside `a.jpg`, and returns their names.

    Otherwise one copy might be trained and another one held out. The image with the shortest name stays.
    """
    seen: set[bytes] = set()
    repeats = []
    for path in sorted(listed_images(folder), key=lambda path: len(path.name)):
        content = hashlib.sha256(path.read_bytes()).digest()
        if content in seen:
            path.unlink()
            repeats.append(path.name)
        seen.add(content)
    return repeats


def read_mask(path: Path, name: str, header: Header) -> NDArray[np.bool_]:
    """Reads the mask of an image: bool [h, w], oriented like the stored image, False where the mask is black.

    Args:
        path: the mask file.
        name: the name of the image, for errors.
        header: the header of the image.
    """
    try:
        with Image.open(path, formats=FORMATS) as image:
            upright = header.size[::-1] if header.turns % 2 else header.size
            if image.size not in (header.size, upright):
                size, actual = (" x ".join(map(str, sides)) for sides in (header.size, image.size))
                raise SceneError(f"{path}: is {actual} pixels, {name} is {size}")
            return drawn(image, header.size, header.turns)
    except SceneError:
        raise
    except UNREADABLE as error:
        raise SceneError(f"{path}: cannot be read: {error}") from None


def _copy_masks(folder: Path, copied: dict[Path, Path], masks: Path, say: Callable[[str], None]) -> None:
    """Writes the masks of copied images to ``masks``, under the names that COLMAP expects: `0.jpg.png` for `0.jpg`.

    The masks lie in a folder `masks`, in or beside the folder of the images, or beside an image in a subfolder.

    Args:
        folder: the folder of the images.
        copied: the original of each copy.
        masks: the folder to write.
        say: called with a line for the user.
    """
    places = [place for place in (folder / "masks", folder / ".." / "masks") if place.is_dir()]
    count = 0
    for copy, path in copied.items():
        name, header = path.relative_to(folder), read_header(copy)
        named = [place / end for place in places for end in (f"{name}.png", name.with_suffix(".png"))]
        named += [path.parent / "masks" / end for end in (f"{path.name}.png", f"{path.stem}.png")]
        mask = next((file for file in named if file.is_file()), None)
        if mask is None:
            continue
        kept = read_mask(mask, path.name, header)
        masks.mkdir(exist_ok=True)
        Image.fromarray(kept).save(masks / f"{copy.name}.png")
        count += 1
    if count:
        say(f"{count} of {len(copied)} images have a mask: nothing is learnt where it is black")
    elif places and copied:
        say(f"{places[0]}: has no mask of any image; the mask of 0.jpg must be 0.jpg.png or 0.png")


def _take_frames(video: Path, folder: Path, count: int, say: Callable[[str], None]) -> None:
    """Writes evenly spaced frames of a video as JPEG, none of them twice; ffmpeg turns frames of phones upright.

    The number of frames is estimated by the number of packets: counting packets is fast, and the duration in the file
    may be missing or wrong. A video that was cut without re-encoding has more packets than frames, and is read a second
    time.
    """
    import imageio_ffmpeg

    # Without -reinit_filter 0, ffmpeg would restart the filters, and their frame count, where the frame size changes.
    read = ["-protocol_whitelist", "file", "-format_whitelist", CONTAINERS, "-reinit_filter", "0"]
    read += ["-i", f"file:{video}"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-nostdin", *read]
    passed = ["-fps_mode", "passthrough"]

    def run(options: Sequence[str]) -> subprocess.CompletedProcess[str]:
        return subprocess.run([*command, *options], capture_output=True, text=True, errors="replace")

    def take(total: int) -> int:
        """Writes frames, assuming that the video has `total` frames, and returns the actual number."""
        rate = f"{min(count, total)}/{total}"
        chosen = f"select='gt(floor((n+1)*{rate}+0.5),floor(n*{rate}+0.5))'"
        # Frame numbers replace time stamps, since ffmpeg stops at repeated or decreasing ones.
        graph = f"[0:V:0]settb=1,setpts=N,split[all][each];[each]{chosen},scale[chosen]"
        counted = ["-map", "[all]", *passed, "-progress", "-", "-f", "null", "-"]
        written = ["-map", "[chosen]", *passed, "-enc_time_base", "1", "-q:v", "2", str(emptied(folder) / "%05d.jpg")]
        done = run(["-filter_complex", graph, *counted, *written])
        frames = re.findall(r"^frame=(\d+)$", done.stdout, re.MULTILINE)
        if done.returncode or not frames:
            reason = (done.stderr.strip().splitlines() or ["no reason"])[-1]
            raise SceneError(f"{video}: ffmpeg cannot read it: {reason:.200}")
        return int(frames[-1])

    copied = run(["-map", "0:V:0", "-c", "copy", "-f", "framecrc", "-"])
    packets = sum(not line.startswith("#") for line in copied.stdout.splitlines())
    if not packets:
        reason = (copied.stderr.strip().splitlines() or ["no reason"])[-1]
        raise SceneError(f"{video}: must be a video in a supported container ({CONTAINERS}): {reason:.200}")
    frames = take(packets)
    if len(listed_images(folder)) != min(count, frames):
        take(frames)
    if frames < count:
        say(f"{video}: all {frames} frames are taken, fewer than --frames {count}")
