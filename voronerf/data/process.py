"""From a video or a folder of images to a scene: COLMAP finds the cameras, by pycolmap or by its program."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

from voronerf.data.colmap import read_model
from voronerf.data.folders import listed_images
from voronerf.data.images import read_header
from voronerf.data.scene import SceneError

#: Of a video. A playlist would name other files.
CONTAINERS = "mov,matroska,avi,mpegts,mpeg"
#: More images than this are matched with their neighbours in the order of their names alone, as frames of a video are.
MOST_PAIRED = 200
LEAST_IMAGES = 3


def process(
    source: Path, out: Path, *, frames: int = 150, fisheye: bool = False, say: Callable[[str], None] = print
) -> None:
    """Makes a scene: `out/images`, and a COLMAP model in `out/sparse/0`. `out` appears when it is complete.

    The images of a video, and images of one size, share a camera of the model OPENCV or OPENCV_FISHEYE; else each has
    its own. The largest of several models is kept.

    Args:
        source: a video, or a folder of PNG or JPEG images.
        out: the folder to make, which must not exist or be empty.
        frames: of a video, evenly spread.
        fisheye: the lens is a fisheye.
        say: takes a line about each step.

    Raises:
        SceneError: the source is neither, or COLMAP finds no model.
        ImportError: COLMAP is not installed.
        OSError: a file cannot be written.
    """
    run = _pycolmap() or _program()
    if run is None:
        raise ImportError("voronerf process needs COLMAP: pip install pycolmap, or install the program colmap")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SceneError(f"{out}: must not exist yet, or be an empty folder")
    if not source.exists():
        raise SceneError(f"{source}: there is no such video or folder")
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as name:
        work = Path(name)
        images = work / "scene" / "images"
        images.mkdir(parents=True)
        if source.is_dir():
            for path in listed_images(source):
                shutil.copyfile(path, images / path.name)
        else:
            _take_frames(source, images, frames)
        files = listed_images(images)
        if len(files) < LEAST_IMAGES:
            raise SceneError(f"{source}: must have at least {LEAST_IMAGES} images, got {len(files)}")
        shared = len({read_header(path, 1).size for path in files}) == 1
        in_order = not source.is_dir() or len(files) > MOST_PAIRED
        say(f"{len(files)} images with {'one camera' if shared else 'a camera each'}; COLMAP looks for the cameras")
        models = work / "models"
        models.mkdir()
        run(images, work / "database.db", models, "OPENCV_FISHEYE" if fisheye else "OPENCV", shared, in_order)
        found = {path: len(read_model(path).images) for path in models.iterdir() if (path / "images.bin").is_file()}
        if not found:
            raise SceneError(f"{source}: COLMAP finds no model: the images must overlap, be sharp and differ in place")
        best = max(found, key=lambda path: found[path])
        (work / "scene" / "sparse").mkdir()
        os.replace(best, work / "scene" / "sparse" / "0")
        with contextlib.suppress(OSError):
            out.rmdir()
        os.replace(work / "scene", out)
        say(f"wrote {out}: cameras of {found[best]} of {len(files)} images; voronerf train --data {out}")


def _take_frames(video: Path, folder: Path, count: int) -> None:
    """Writes frames of a video as JPEG; ffmpeg turns those of a phone upright."""
    import imageio_ffmpeg

    read = ["-protocol_whitelist", "file", "-format_whitelist", CONTAINERS, "-i", f"file:{video}"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-nostdin", *read]
    told = subprocess.run(command, capture_output=True, text=True, errors="replace").stderr
    length = re.search(r"Duration: (\d+):(\d+):(\d+\.\d+)", told)
    seconds = sum(float(part) * unit for part, unit in zip(length.groups(), (3600, 60, 1))) if length else 0.0
    if not seconds or " Video: " not in told:
        raise SceneError(f"{video}: is no video in a container that is read ({CONTAINERS})")
    options = ["-map", "0:v:0", "-vf", f"fps={count / seconds:.9g}", "-frames:v", str(count), "-q:v", "2"]
    made = subprocess.run(
        [*command, *options, str(folder / "%05d.jpg")], capture_output=True, text=True, errors="replace"
    )
    if made.returncode:
        reason = (made.stderr.strip().splitlines() or ["no reason"])[-1]
        raise SceneError(f"{video}: ffmpeg cannot read it: {reason:.200}")


Run = Callable[[Path, Path, Path, str, bool, bool], None]


def _pycolmap() -> Run | None:
    """COLMAP by its Python package, or None where that is missing."""
    try:
        import pycolmap
    except ImportError:
        return None

    def run(images: Path, database: Path, models: Path, model: str, shared: bool, in_order: bool) -> None:
        pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
        mode = pycolmap.CameraMode.SINGLE if shared else pycolmap.CameraMode.PER_IMAGE
        options = pycolmap.ImageReaderOptions(camera_model=model)
        try:
            pycolmap.extract_features(database, images, camera_mode=mode, reader_options=options)
            (pycolmap.match_sequential if in_order else pycolmap.match_exhaustive)(database)
            pycolmap.incremental_mapping(database, images, models)
        except (RuntimeError, ValueError) as error:
            raise SceneError(f"pycolmap: {' '.join(str(error).split())[:300]}") from None

    return run


def _program() -> Run | None:
    """COLMAP by its program, or None where that is missing."""
    program = shutil.which("colmap")
    if program is None:
        return None

    def run(images: Path, database: Path, models: Path, model: str, shared: bool, in_order: bool) -> None:
        camera = ["--ImageReader.camera_model", model, "--ImageReader.single_camera", str(int(shared))]
        places = ["--database_path", str(database), "--image_path", str(images)]
        for step in (
            ["feature_extractor", *places, *camera],
            ["sequential_matcher" if in_order else "exhaustive_matcher", *places[:2]],
            ["mapper", *places, "--output_path", str(models)],
        ):
            done = subprocess.run([program, *step], capture_output=True, text=True, errors="replace")
            if done.returncode:
                reason = (done.stderr.strip().splitlines() or ["no reason"])[-1]
                raise SceneError(f"{program} {step[0]} failed: {reason:.300}")

    return run
