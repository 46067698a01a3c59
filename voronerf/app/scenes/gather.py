"""Gathers images of a folder or frames of videos for COLMAP, as PNG and JPEG files without duplicates."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import math
import os
import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folders import CONVERTED, HEIF, SUFFIXES, listed_images
from voronerf.app.scenes.images import (
    COLOURS,
    DYNAMIC_MASK,
    UNREADABLE,
    Header,
    check_grey,
    drawn,
    is_deep,
    read_header,
    read_image,
)
from voronerf.app.scenes.names import COPIES, OTHER_PICTURES
from voronerf.app.scenes.soundness import some_of

#: Container formats of videos. Playlists are excluded, since they name other files.
CONTAINERS = "mov,matroska,avi,mpegts,mpeg"
VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".ts", ".mpg", ".3gp")
#: The transfer functions of HDR video, by ffmpeg's names. If a video in BT.2020 states none, it is HLG if the
#: ninth decile of its brightness is above `BRIGHT`, between the whites of PQ (58 %) and HLG (75 %, ITU-R BT.2408).
HDR = {"arib-std-b67": "HLG", "smpte2084": "PQ"}
BRIGHT = 0.63
#: The filters from HDR to sRGB: white is at 203 cd/m2 (BT.2408); up to 0.8 of it, colours are kept.
TONE_MAPPING = (
    "zscale=t=linear:npl=203:agamma=false,format=gbrpf32le,zscale=p=bt709,"
    "tonemap=mobius:param=0.8:peak=5:desat=0,zscale=t=iec61966-2-1"
)
#: Primaries, by ffmpeg's names, with more colours than sRGB has, and the transfer functions that they come with.
WIDE = ("bt2020", "smpte431", "smpte432")
CURVES = (*HDR, "smpte170m", "iec61966-2-1", "bt2020-10", "bt2020-12")
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
#: The folder of Polycam's images without distortion, beside the distorted ones in `images`.
POLYCAM = "corrected_images"
LEAST_IMAGES = 3

Progress = Callable[[str, int, int], None]


def gather(
    source: Path | Sequence[Path],
    images: Path,
    masks: Path,
    frames: int,
    *,
    say: Callable[[str], None],
    progress: Progress,
) -> dict[str, str]:
    """Copies the images of a folder and their masks, or extracts frames of videos.

    Args:
        source: a folder or videos, as in :func:`voronerf.app.scenes.process.process`.
        images: the empty folder for the images.
        masks: the folder for the masks, which is made only if there are masks.
        frames: the number of frames to extract from the videos.
        say: called with a line for the user, such as about files that are left out.
        progress: called with the name "images", the number of copied images, and the number of all images.

    Returns:
        The place of each image by its name: its folder inside ``source``, or its video.
    """
    clips = [source] if isinstance(source, Path) else list(source)
    folder, places, copied = clips[0], dict[str, str](), dict[Path, Path]()
    if folder.is_dir():
        files = sorted(files_of(folder))
        if any(path.suffix.lower() in KINDS for path in files):
            clips = []
            folder, files = _list_images(folder, say)
            progress("images", 0, len(files))
            copied = _copy_images(folder, files, images, say, progress)
            places = {copy.name: path.parent.relative_to(folder).as_posix() for copy, path in copied.items()}
        else:
            if clips := [path for path in files if path.suffix.lower() in VIDEOS]:
                names = [path.relative_to(folder).as_posix() for path in clips]
                say(f"{folder}: has no images; frames are taken from {some_of(names)}")
    if clips:
        progress("images", 0, 0)
        places = _take_frames(clips, images, frames, say)
    if repeats := _remove_repeats(images):
        say(f"{folder}: {len(repeats)} byte-identical copies of images are left out: {some_of(repeats)}")
    names = [path.name for path in listed_images(images)]
    if len(names) < LEAST_IMAGES:
        raise SceneError(f"{folder}: must have at least {LEAST_IMAGES} images, got {len(names)}")
    _copy_masks(folder, {copy: path for copy, path in copied.items() if copy.exists()}, masks, say)
    return {name: places[name] for name in names}


def emptied(folder: Path) -> Path:
    """Makes a new folder in place of an existing one, and returns it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def files_of(folder: Path) -> Iterator[Path]:
    """Yields the files of a folder and its subfolders; for the path of a file, that file.

    It skips hidden files, system files, masks, folders of masks, depths and smaller copies, and scenes made by
    :func:`process`. Of Polycam's raw folders, it takes only the images without distortion.
    """

    def counts(path: Path) -> bool:
        return not path.name.startswith((".", DYNAMIC_MASK)) and path.name.lower() not in IGNORED

    def is_beside(name: str) -> bool:
        return bool(OTHER_PICTURES.fullmatch(name) or COPIES.fullmatch(name))

    if folder.is_file():
        yield folder
    for place, folders, files in os.walk(folder):
        inside = [path for name in folders if counts(path := Path(place, name)) and not is_beside(name)]
        folders[:] = [path.name for path in inside if not (path / "colmap" / "settings.json").is_file()]
        if POLYCAM in folders and any(Path(place, POLYCAM).iterdir()):
            folders[:] = [name for name in folders if name.lower() != "images"]
        yield from (path for name in sorted(files) if counts(path := Path(place, name)) and path.is_file())


def _list_images(folder: Path, say: Callable[[str], None]) -> tuple[Path, list[Path]]:
    """Returns the folder of the images and the image files, and reports the files that are left out.

    The images are in ``folder`` itself or, if it has none, in its subfolder `images`, or in all its subfolders.
    """
    files = sorted(files_of(folder))
    images = [path for path in files if path.suffix.lower() in KINDS]
    deeper = [path for path in images if path.parent != folder]
    wanted = POLYCAM if any((folder / POLYCAM).glob("*")) else "images"
    if len(deeper) < len(images):
        if deeper:
            say(f"{folder}: {len(deeper)} images in subfolders are left out, since the folder itself has images")
        files, images = ([path for path in paths if path.parent == folder] for paths in (files, images))
    elif inner := next((path for path in folder.iterdir() if path.is_dir() and path.name.lower() == wanted), None):
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

    In the copies' names, `_` replaces `/`, spaces and a first `#`: in COLMAP's lists of pairs, spaces separate names,
    and lines that begin with `#` are comments.
    """
    copied: dict[Path, Path] = {}
    deep = []
    for path in files:
        name = "_".join("_".join(path.relative_to(folder).parts).split())
        copy, reduced = _copy_image(path, part / re.sub("^#", "_", name))
        if copy in copied:
            raise SceneError(f"{path}: {copied[copy]} has the same name, once _ replaces spaces, # and /")
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
            deep = is_deep(image)
            if image.format in COPIED and not deep:
                read_image(path, min(8, *read_header(path).size))  # refuses truncated files, which COLMAP accepts
                suffixes = (".png",) if image.format == "PNG" else (".jpg", ".jpeg")
                copy = copy if copy.suffix.lower() in suffixes else copy.with_suffix(suffixes[0])
                shutil.copyfile(path, copy)
                return copy, deep
            check_grey(image, path)
            lossy = image.format is None or (image.format == "WEBP" and b"VP8L" not in path.read_bytes())
            copy = copy.with_suffix(".jpg" if lossy and not image.has_transparency_data else ".png")
            written, (camera, lens) = Image.Exif(), _lens_tags(image)
            written[ExifTags.IFD.Exif] = lens
            written.update(camera)
            mode = "RGBA" if image.has_transparency_data else "RGB"
            profile = image.info.get("icc_profile") if image.mode in COLOURS else None
            upright = ImageOps.exif_transpose(image).convert(mode)
            upright.save(copy, quality=95, compress_level=1, exif=written, icc_profile=profile)
    except SceneError:
        raise
    except Image.UnidentifiedImageError:
        raise SceneError(f"{path}: is not an image in {', '.join(FORMATS)} format") from None
    except (*UNREADABLE, RuntimeError) as error:
        raise SceneError(f"{path}: cannot be copied: {error}") from None
    return copy, deep


def _lens_tags(image: Image.Image) -> tuple[dict[int, str], dict[int, Any]]:
    """Returns the EXIF tags of the make and model, and of the focal lengths, of an image; broken tags are left out."""
    camera, lens = dict[int, str](), dict[int, Any]()
    with contextlib.suppress(*UNREADABLE):
        exif = image.getexif()
        camera = {tag: exif[tag] for tag in CAMERA if isinstance(exif.get(tag), str)}
        values = exif.get_ifd(ExifTags.IFD.Exif)
        for tag in LENS:
            with contextlib.suppress(TypeError, ValueError, ArithmeticError):
                if 0 < float(values.get(tag, 0)) < math.inf:
                    lens[tag] = values[tag]
    return camera, lens


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
            return drawn(image, header.size, header.turns, inverted=path.name.startswith(DYNAMIC_MASK))
    except SceneError:
        raise
    except UNREADABLE as error:
        raise SceneError(f"{path}: cannot be read: {error}") from None


def _copy_masks(folder: Path, copied: dict[Path, Path], masks: Path, say: Callable[[str], None]) -> None:
    """Writes the masks of copied images to ``masks``, under the names that COLMAP expects: `0.jpg.png` for `0.jpg`.

    The masks lie in a folder `masks`, in or beside the folder of the images, or beside an image in a subfolder. The
    masks of instant-ngp, `dynamic_mask_0.png` for `0.jpg`, lie beside the images.

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
        named.append(path.with_name(f"{DYNAMIC_MASK}{path.stem}.png"))
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


class Video(NamedTuple):
    """The first video stream of a file.

    Attributes:
        path: the file.
        packets: the number of packets, an estimate of the number of frames: counting packets is fast, and the duration
            in the file may be missing or wrong.
        interlaced: whether the frames are interlaced.
        filters: ffmpeg's filters that give a frame square pixels and JPEG's colours.
        notes: phrases about the filters for the user.
    """

    path: Path
    packets: int
    interlaced: bool
    filters: list[str]
    notes: list[str]


def _run_ffmpeg(video: Path, options: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Runs ffmpeg on a video, whose frames it turns upright."""
    import imageio_ffmpeg

    # Without -reinit_filter 0, ffmpeg would restart the filters, and their frame count, where the frame size changes.
    read = ["-protocol_whitelist", "file", "-format_whitelist", CONTAINERS, "-reinit_filter", "0"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-nostdin", *read, "-i", f"file:{video}"]
    return subprocess.run([*command, *options], capture_output=True, text=True, errors="replace")


def _reason(errors: str) -> str:
    """Returns the first line of ffmpeg's errors, which causes the later ones, without its prefix ``[component]``."""
    return re.sub(r"^\[.*?\] ", "", (errors.strip().splitlines() or ["no reason"])[0])[:200]


def _open_video(path: Path) -> Video:
    """Counts the packets of a video, and chooses filters by the properties of its first frame."""
    stream = ["-map", "0:V:0"]
    copied = _run_ffmpeg(path, ["-v", "error", *stream, "-c", "copy", "-f", "framecrc", "-"])
    packets = sum(not line.startswith("#") for line in copied.stdout.splitlines())
    if not packets:
        reason = _reason(copied.stderr)
        if "matches no streams" in copied.stderr:
            reason = "it has no moving pictures"
        elif "moov atom not found" in copied.stderr:
            reason += ", as in a recording or a download that was cut off"
        raise SceneError(f"{path}: must be a video in a supported container ({CONTAINERS}): {reason}")
    printed = ["-vf", "showinfo,signalstats,metadata=print", "-frames:v", "1", "-f", "null", "-"]
    output = _run_ffmpeg(path, [*stream, *printed]).stderr
    shown = " ".join(re.findall(r"^\[Parsed_showinfo.*?\] (.*)", output, re.MULTILINE)[:8])
    frame = dict(reversed(re.findall(r"(\w+):\s*([^\s\[]+)", shown)))
    if not {"s", "sar", "i", "fmt"} <= frame.keys():
        raise SceneError(f"{path}: ffmpeg cannot decode its first frame")
    high = re.search(r"signalstats.YHIGH=(\d+)", output)
    depth = re.search(r"p(1\d)", frame["fmt"])
    bright = int(high[1]) / 2 ** int(depth[1] if depth else 8) if high else 0.0
    interlaced = frame["i"] in "TB"
    filters, notes = _colour_filters(frame, bright)
    return Video(
        path, packets, interlaced, filters, ["is interlaced: one of two lines is interpolated"] * interlaced + notes
    )


def _colour_filters(frame: Mapping[str, str], bright: float) -> tuple[list[str], list[str]]:
    """Returns filters that give a frame square pixels and JPEG's colours, and phrases about them for the user.

    JPEG's colours are sRGB, stored by the matrix of BT.601.

    Args:
        frame: properties of the frame by the names of ffmpeg's filter showinfo.
        bright: the ninth decile of the frame's brightness, from 0 to 1.
    """
    matrix, primaries, transfer = (frame.get(f"color_{name}", "unknown") for name in ("space", "primaries", "trc"))
    width, height = (int(side) for side in frame["s"].split("x"))
    filters, notes = [], []
    if matrix.startswith("bt2020") and transfer == "unknown":
        transfer = "arib-std-b67" if bright > BRIGHT else "smpte2084"
        notes.append(f"has no tag of its transfer function: {HDR[transfer]} is assumed, by its brightness")
    if primaries == "unknown" and (transfer in HDR or matrix.startswith("bt2020")):
        primaries = "bt2020"
    if matrix == "unknown" and (transfer in HDR or primaries == "bt2020"):
        matrix = "bt2020nc"
    elif matrix == "unknown" and (width >= 1280 or height > 576):  # the rule of players
        matrix = "bt709"
        notes.append("has no colour tags: those of HD video (bt709) are assumed")
    if transfer in HDR or primaries in WIDE:
        matrix = "smpte170m" if matrix == "unknown" else matrix
        tags = f"color_primaries={primaries}:color_trc={transfer if transfer in CURVES else 'bt709'}"
        if not re.search("444|rgb|gbr", frame["fmt"]):
            filters.append("format=yuv444p16le")  # zscale refuses odd sizes of smaller colour planes
        filters += [f"setparams=colorspace={matrix}:{tags}", TONE_MAPPING if transfer in HDR else "zscale=p=bt709"]
        filters += ["zscale=m=bt709:r=limited", "format=yuv444p"]
        mapped = (
            f"is HDR ({HDR[transfer]}) and is tone-mapped"
            if transfer in HDR
            else f"has colours of {primaries}, which are converted"
        )
        notes.append(f"{mapped} to sRGB")
    elif matrix != "unknown":
        filters.append(f"setparams=colorspace={matrix}")
    scale = ["out_color_matrix=bt601"] * (matrix != "unknown")
    across, down = (int(side) for side in frame["sar"].split("/"))
    if across and down and across != down:
        width, height = (width * across // down, height) if across > down else (width, height * down // across)
        scale.append(f"w={width}:h={height}")
        notes.append(f"has pixels of {across} to {down}: its frames become {width} x {height}")
    return [*filters, "=".join(("scale", ":".join(scale))).rstrip("=")], notes


def _take_frames(source: Path | Sequence[Path], folder: Path, count: int, say: Callable[[str], None]) -> dict[str, str]:
    """Writes evenly spaced frames of a video or videos as JPEG to a folder, none of them twice.

    Returns the video of each frame by the frame's name.

    Each video has its share of ``count`` frames by its length, but at least one. If there are several videos, the
    frames' names begin with a video's number.
    """
    paths = [source] if isinstance(source, Path) else source
    videos = [_open_video(path) for path in paths]
    ends = np.cumsum([0, *(video.packets for video in videos)])
    shares = np.diff(np.rint(count * ends / ends[-1])).astype(int).clip(1).tolist()
    emptied(folder)
    taken = 0
    for number, (video, share) in enumerate(zip(videos, shares), 1):
        prefix = f"{number:0{len(str(len(videos)))}}_" * (len(videos) > 1)
        if video.notes:
            say(f"{video.path}: {'; '.join(video.notes)}")
        taken += _write_frames(video, folder, share, prefix)
    if taken < count:
        say(f"{some_of(list(map(str, paths)))}: all {taken} frames are taken, fewer than --frames {count}")
    numbers = {path.name: int(path.stem.rpartition("_")[0] or 1) for path in listed_images(folder)}
    return {name: f"video {number}, {paths[number - 1].name}" for name, number in numbers.items()}


def _write_frames(video: Video, folder: Path, count: int, prefix: str) -> int:
    """Writes evenly spaced frames of a video, and returns their number.

    A video that was cut without re-encoding has more packets than frames, and is read a second time.
    """
    passed = ["-fps_mode", "passthrough"]
    deinterlaced = "bwdif=send_frame:deint=interlaced," * video.interlaced
    pattern = str(folder.absolute() / prefix).replace("%", "%%") + ("" if prefix else os.sep) + "%05d.jpg"

    def take(total: int) -> int:
        """Writes frames, assuming that the video has `total` frames, and returns the actual number."""
        rate = f"{min(count, total)}/{total}"
        chosen = f"select='gt(floor((n+1)*{rate}+0.5),floor(n*{rate}+0.5))'"
        # Frame numbers replace time stamps, since ffmpeg stops at repeated or decreasing ones.
        graph = f"[0:V:0]{deinterlaced}settb=1,setpts=N,split[all][each];"
        graph += f"[each]{','.join([chosen, *video.filters])}[chosen]"
        counted = ["-map", "[all]", *passed, "-progress", "-", "-f", "null", "-"]
        written = ["-map", "[chosen]", *passed, "-enc_time_base", "1", "-q:v", "2", pattern]
        done = _run_ffmpeg(video.path, ["-v", "error", "-filter_complex", graph, *counted, *written])
        frames = re.findall(r"^frame=(\d+)$", done.stdout, re.MULTILINE)
        if done.returncode or not frames:
            raise SceneError(f"{video.path}: ffmpeg cannot write its frames to {folder}: {_reason(done.stderr)}")
        return int(frames[-1])

    frames = take(video.packets)
    written = sorted(folder.glob(f"{prefix}*.jpg"))
    if len(written) != min(count, frames):
        for path in written:
            path.unlink()
        take(frames)
    return min(count, frames)


def cameras_of(images: Sequence[Path], places: Mapping[str, str]) -> dict[str, str]:
    """Returns a label of the camera of each image by its name: images with the same label share a camera.

    A label has the size of the image and the make, model and focal lengths in its EXIF tags or, if these tell no focal
    length, its place in ``places``, see :func:`gather`.
    """
    labels = {}
    for path in images:
        with Image.open(path, formats=COPIED) as image:
            camera, lens = _lens_tags(image)
            told = [text.strip("\0 ") for text in camera.values()] + [f"{value} mm" for value in lens.values()]
            place = places.get(path.name, ".")
            where = [" ".join(told)] if lens else [f"in {place!s:.60}"] * (place != ".")
            labels[path.name] = ", ".join(["{} x {}".format(*image.size), *where])
    return labels
