"""Gathers the images of a video or of somebody's folder as COLMAP reads them: PNG and JPEG, each once."""

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

from PIL import ExifTags, Image, ImageOps

from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folders import CONVERTED, HEIF, SUFFIXES, listed_images
from voronerf.app.scenes.images import UNREADABLE, drawn, read_header, read_image
from voronerf.app.scenes.soundness import some_of

#: Formats of a video. A playlist would name other files.
CONTAINERS = "mov,matroska,avi,mpegts,mpeg"
#: Formats of images, decided by the content of a file, and those that are copied. MPO is JPEG with a second picture.
FORMATS = ("PNG", "JPEG", "WebP", "TIFF", "BMP")
COPIED = ("PNG", "JPEG", "MPO")
#: The tags of EXIF by which COLMAP knows a focal length.
CAMERA = (ExifTags.Base.Make, ExifTags.Base.Model)
LENS = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm)
#: Suffixes of images. Of files that differ in these alone the first is taken, as of a photograph and its cut-out.
KINDS = (*reversed(SUFFIXES), *CONVERTED)
#: Files and folders of systems that are no captures, beside hidden ones.
IGNORED = ("thumbs.db", "desktop.ini", "__macosx", "@eadir")
#: Folders of masks, depths and smaller copies, which programs keep beside photographs.
BESIDE = re.compile(r"(?i)masks?|depths?|images_\d+")
LEAST_IMAGES = 3

Progress = Callable[[str, int, int], None]


def gather(
    source: Path, images: Path, masks: Path, frames: int, *, say: Callable[[str], None], progress: Progress
) -> None:
    """Copies the images of a folder and their masks, or takes frames of a video.

    Args:
        source: a video, or a folder, as of :func:`voronerf.app.scenes.process.process`.
        images: the folder to fill, which is empty.
        masks: the folder to make if there are masks.
        frames: of a video.
        say: takes a line about what is left out.
        progress: takes the name "images", how many are done and how many there are.
    """
    folder, files = _list_images(source, say) if source.is_dir() else (source, [])
    progress("images", 0, len(files))
    copied = _copy_images(folder, files, images, say, progress)
    if not source.is_dir():
        _take_frames(source, images, frames, say)
    if repeats := _remove_repeats(images):
        say(f"{folder}: {len(repeats)} images are left out that repeat others to the byte: {some_of(repeats)}")
    count = len(listed_images(images))
    if count < LEAST_IMAGES:
        raise SceneError(f"{folder}: must have at least {LEAST_IMAGES} images, got {count}")
    _copy_masks(folder, {copy: path for copy, path in copied.items() if copy.exists()}, masks, say)


def emptied(folder: Path) -> Path:
    """A new folder in the place of what an earlier process left."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def _files(folder: Path) -> Iterator[Path]:
    """The files of a folder and of the folders in it.

    Hidden ones are left out, what programs keep beside photographs, and scenes of :func:`process`.
    """

    def counts(path: Path) -> bool:
        return not path.name.startswith(".") and path.name.lower() not in IGNORED

    for place, folders, files in os.walk(folder):
        inside = [path for name in folders if counts(path := Path(place, name)) and not BESIDE.fullmatch(name)]
        folders[:] = [path.name for path in inside if not (path / "colmap" / "settings.json").is_file()]
        yield from (path for name in files if counts(path := Path(place, name)))


def _list_images(folder: Path, say: Callable[[str], None]) -> tuple[Path, list[Path]]:
    """Returns the folder of the images and their files, and says what is left out.

    They are those of the folder or, if it has none, of its folder `images` or of all its folders.
    """
    files = sorted(_files(folder))
    images = [path for path in files if path.suffix.lower() in KINDS]
    deeper = [path for path in images if path.parent != folder]
    if len(deeper) < len(images):
        if deeper:
            say(f"{folder}: {len(deeper)} images in its folders are left out, since it has images itself")
        files, images = ([path for path in paths if path.parent == folder] for paths in (files, images))
    elif own := next((path for path in folder.iterdir() if path.is_dir() and path.name.lower() == "images"), None):
        if more := sum(own not in path.parents for path in images):
            say(f"{folder}: {more} images in other folders than {own.name} are left out")
        return _list_images(own, say)
    elif len(places := Counter(str(path.parent.relative_to(folder)) for path in deeper)) > 1:
        say(f"{folder}: the images are those of {some_of([f'{name} ({count})' for name, count in places.items()])}")
    if others := Counter(path.suffix.lower() or path.name for path in files if path.suffix.lower() not in KINDS):
        listed = [f"{count} {kind}" for kind, count in others.most_common()]
        say(f"{folder}: other files than {', '.join(FORMATS)} and HEIC are left out: {some_of(listed)}")
    phone = [path for path in images if path.suffix.lower() in HEIF]
    if phone and importlib.util.find_spec("pillow_heif") is None:
        say(f"{folder}: {len(phone)} HEIC images are left out; pip install pillow-heif reads them")
        images = [path for path in images if path.suffix.lower() not in HEIF]
    images.sort(key=lambda path: KINDS.index(path.suffix.lower()))
    first = {path.with_suffix(""): path for path in reversed(images)}
    if same := [str(path.relative_to(folder)) for path in images if first[path.with_suffix("")] != path]:
        say(f"{folder}: {len(same)} images are left out that are there in another format, too: {some_of(same)}")
    return folder, sorted(first.values())


def _copy_images(
    folder: Path, files: Sequence[Path], part: Path, say: Callable[[str], None], progress: Progress
) -> dict[Path, Path]:
    """Copies images to a folder, and returns them by their copies.

    COLMAP's lists of pairs separate names by spaces: names have `_` in their place, and in that of `/`.
    """
    copied: dict[Path, Path] = {}
    deep = []
    for path in files:
        copy, reduced = _copy_image(path, part / "_".join("_".join(path.relative_to(folder).parts).split()))
        if copy in copied:
            raise SceneError(f"{path}: {copied[copy]} has this name, too, with _ in the place of spaces and /")
        copied[copy] = path
        deep += [path.name] * reduced
        progress("images", len(copied), len(files))
    if deep:
        say(f"{folder}: of {len(deep)} images with 16 bits a channel the upper 8 are kept: {some_of(deep)}")
    return copied


def _opened(path: Path) -> Image.Image:
    """Opens an image of any of the formats that are read."""
    if path.suffix.lower() not in HEIF:
        return Image.open(path, formats=FORMATS)
    import pillow_heif

    image: Image.Image = pillow_heif.open_heif(path).to_pillow()  # upright, and says so
    return image


def _copy_image(path: Path, copy: Path) -> tuple[Path, bool]:
    """Copies a PNG or JPEG image; writes another one upright, with what it says of its lens.

    HEIC and lossy WebP become JPEG, unless they are transparent, and others PNG.

    Returns:
        the copy, whose suffix may be another one, and whether the image has 16 bits a channel, of which 8 are kept.
    """
    try:
        with _opened(path) as image:
            deep = re.search(r";16[BLN]", str(getattr(image, "tile", ""))) is not None
            if image.format in COPIED and not deep:
                read_image(path, min(8, *read_header(path).size))  # COLMAP would take one that is cut off
                shutil.copyfile(path, copy)
                return copy, deep
            if image.mode[0] in "IF":
                raise SceneError(f"{path}: has grey values of more than 8 bits; write it with 8 bits a channel")
            lossy = image.format is None or (image.format == "WEBP" and b"VP8L" not in path.read_bytes())
            copy = copy.with_suffix(".jpg" if lossy and not image.has_transparency_data else ".png")
            said = image.getexif()
            lens, written = said.get_ifd(ExifTags.IFD.Exif), Image.Exif()
            written[ExifTags.IFD.Exif] = {tag: lens[tag] for tag in LENS if tag in lens}
            written.update({tag: said[tag] for tag in CAMERA if tag in said})
            shown = ImageOps.exif_transpose(image).convert("RGBA" if image.has_transparency_data else "RGB")
            shown.save(copy, quality=95, compress_level=1, exif=written)
    except SceneError:
        raise
    except Image.UnidentifiedImageError:
        raise SceneError(f"{path}: is not an image in {', '.join(FORMATS)} format") from None
    except (*UNREADABLE, RuntimeError) as error:
        raise SceneError(f"{path}: cannot be read: {error}") from None
    return copy, deep


def _remove_repeats(folder: Path) -> list[str]:
    """Removes images that repeat others to the byte, such as `a (1).jpg` beside `a.jpg`, and returns their names.

    One of them might be trained, and the other one held out. The shortest name stays.
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


def _copy_masks(folder: Path, copied: dict[Path, Path], masks: Path, say: Callable[[str], None]) -> None:
    """Writes the masks of images, which lie in `masks` in or beside their folder, by COLMAP's names of their copies."""
    places = [place for place in (folder / "masks", folder / ".." / "masks") if place.is_dir()]
    found = 0
    for copy, path in copied.items():
        name, header = path.relative_to(folder), read_header(copy)
        size = header.size
        named = [place / each for place in places for each in (f"{name}.png", name.with_suffix(".png"))]
        named += [path.parent / "masks" / each for each in (f"{path.name}.png", f"{path.stem}.png")]
        mask = next((file for file in named if file.is_file()), None)
        if mask is None:
            continue
        try:
            with Image.open(mask, formats=FORMATS) as image:
                kept = drawn(image, size, header.turns)
        except UNREADABLE as error:
            raise SceneError(f"{mask}: cannot be read: {error}") from None
        if kept.shape != size[::-1]:
            high, wide = kept.shape
            raise SceneError(f"{mask}: is {wide} x {high} pixels, {path.name} is {size[0]} x {size[1]}")
        masks.mkdir(exist_ok=True)
        Image.fromarray(kept).save(masks / f"{copy.name}.png")
        found += 1
    if found:
        say(f"{found} of {len(copied)} images have a mask: nothing is learnt where it is black")
    elif places and copied:
        say(f"{places[0]}: has no mask of an image; that of 0.jpg is 0.jpg.png or 0.png")


def _take_frames(video: Path, folder: Path, count: int, say: Callable[[str], None]) -> None:
    """Writes frames of a video as JPEG, evenly spread, each once; ffmpeg turns those of a phone upright.

    Packets are counted first, which takes no time, since durations may be missing or wrong. A video that was cut
    without encoding has more of them than frames, and is read again.
    """
    import imageio_ffmpeg

    # Filters that are made again where the size of the frames changes would count from 0.
    read = ["-protocol_whitelist", "file", "-format_whitelist", CONTAINERS, "-reinit_filter", "0"]
    read += ["-i", f"file:{video}"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-nostdin", *read]
    each = ["-fps_mode", "passthrough"]

    def run(options: Sequence[str]) -> subprocess.CompletedProcess[str]:
        return subprocess.run([*command, *options], capture_output=True, text=True, errors="replace")

    def take(total: int) -> int:
        """Writes the frames of a video that is said to have `total`, and returns how many it has."""
        rate = f"{min(count, total)}/{total}"
        chosen = f"select='gt(floor((n+1)*{rate}+0.5),floor(n*{rate}+0.5))'"
        # By frames' numbers, since times that stand still or go back end ffmpeg.
        graph = f"[0:V:0]settb=1,setpts=N,split[all][each];[each]{chosen},scale[chosen]"
        counted = ["-map", "[all]", *each, "-progress", "-", "-f", "null", "-"]
        written = ["-map", "[chosen]", *each, "-enc_time_base", "1", "-q:v", "2", str(emptied(folder) / "%05d.jpg")]
        made = run(["-filter_complex", graph, *counted, *written])
        frames = re.findall(r"^frame=(\d+)$", made.stdout, re.MULTILINE)
        if made.returncode or not frames:
            reason = (made.stderr.strip().splitlines() or ["no reason"])[-1]
            raise SceneError(f"{video}: ffmpeg cannot read it: {reason:.200}")
        return int(frames[-1])

    copied = run(["-map", "0:V:0", "-c", "copy", "-f", "framecrc", "-"])
    packets = sum(not line.startswith("#") for line in copied.stdout.splitlines())
    if not packets:
        reason = (copied.stderr.strip().splitlines() or ["no reason"])[-1]
        raise SceneError(f"{video}: is no video in a container that is read ({CONTAINERS}): {reason:.200}")
    frames = take(packets)
    if len(listed_images(folder)) != min(count, frames):
        take(frames)
    if frames < count:
        say(f"{video}: all of its frames are taken, {frames} in place of --frames {count}")
