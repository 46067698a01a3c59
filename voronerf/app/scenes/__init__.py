"""Scenes: loaders of Blender synthetic scenes and of photographs, and scenes computed from formulas."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from voronerf.app.scenes.blender import load_blender
from voronerf.app.scenes.builtin import builtin_scene, city_scene
from voronerf.app.scenes.builtin.city import city_of
from voronerf.app.scenes.colmap import find_models, load_colmap
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folders import CONVERTED, SUFFIXES
from voronerf.app.scenes.gather import POLYCAM, VIDEOS
from voronerf.app.scenes.llff import FILE, load_llff
from voronerf.app.scenes.photographs import Reading
from voronerf.app.scenes.regions import region_of
from voronerf.app.scenes.scene import KINDS, Scene, Split
from voronerf.app.scenes.transforms import load_transforms
from voronerf.app.wording import similar_path

__all__ = ["Scene", "SceneError", "Split", "builtin_scene", "city_scene", "load_scene"]

BUILTIN_SIZE = 100
BUILTIN, CITY = "builtin", "builtin-city"  # optional suffix: builtin:SIZE, builtin-city:BLOCKS
CACHED = 100  # least side, in pixels, of a built-in scene that is cached
MOST_PIXELS = 1600  # largest side of the built-in scene

#: Suffixes of files that are not scenes, and the ends of error messages about them, in which {} is the file.
ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".zst", ".7z", ".rar")
SHAPES = (".ply", ".splat", ".spz", ".sog", ".pcd", ".las", ".laz", ".e57", ".obj", ".glb", ".gltf", ".fbx", ".stl")
REMEDIES = {
    **dict.fromkeys(VIDEOS, "; voronerf process {} DIR makes one from a video"),
    **dict.fromkeys(ARCHIVES, "; unpack the archive first"),
    **dict.fromkeys(SHAPES, "; points, splats and meshes have no photographs to learn from"),
    **dict.fromkeys((*SUFFIXES, *CONVERTED), "; a scene needs several pictures: voronerf process FOLDER DIR makes one"),
    ".json": "; only transforms.json and transforms_train.json name a scene",
}


class Format(NamedTuple):
    """A scene format: the file that identifies it, its loader, and a search function if one file cannot identify it."""

    sign: str
    load: Callable[[Path, Reading], Scene]
    find: Callable[[Path], object] | None = None

    def is_used_by(self, folder: Path) -> bool:
        """Returns whether a folder holds a scene in this format."""
        return (folder / self.sign).is_file() if self.find is None else self.find(folder) is not None


#: The scene formats by name, in the order in which "auto" tries them.
FORMATS = {
    "blender": Format("transforms_train.json", load_blender),
    "colmap": Format("a COLMAP model in sparse/0", load_colmap, find_models),
    "transforms": Format("transforms.json", load_transforms),
    "llff": Format(FILE, load_llff),
}


def _computed(size: int) -> Scene:
    """Returns the built-in scene; caches images of at least `CACHED` pixels a side, which take seconds to compute."""
    if size < CACHED:
        return builtin_scene(size)
    try:
        return builtin_scene(size, images="cached")
    except (SceneError, OSError):  # the cache cannot be written
        return builtin_scene(size)


def is_builtin(source: str | Path | None) -> bool:
    """Returns whether a source names a built-in scene rather than a folder."""
    return str(source).partition(":")[0] in (BUILTIN, CITY)


def _formats_of(folder: Path) -> list[str]:
    """Returns the names of the formats in which a folder holds a scene."""
    return [name for name, item in FORMATS.items() if item.is_used_by(folder)]


def needs_cameras(source: str | Path) -> bool:
    """Returns whether a source is a video, or a folder of pictures or videos without cameras, for `voronerf process`.

    The pictures may lie in subfolders, unless a subfolder is a scene or a run.
    """
    path = Path(source)
    if path.is_file():
        return path.suffix.lower() in VIDEOS
    if is_builtin(source) or not path.is_dir() or _formats_of(path.resolve().parent):
        return False
    places = [path, *(inner for inner in path.iterdir() if inner.is_dir())]
    if any(_formats_of(place) or (place / "config.json").is_file() for place in places):
        return False
    files = (file for place in (*places, *path.glob(f"*/{POLYCAM}")) for file in place.iterdir())
    return any(file.suffix.lower() in (*SUFFIXES, *CONVERTED, *VIDEOS) for file in files)


def load_scene(
    source: str | Path,
    *,
    downscale: int | None = None,
    allow_outside: bool = False,
    format: str = "auto",
    kind: str = "auto",
    normalise: bool = True,
    images: str = "auto",
    keep_far: bool = False,
    region: Sequence[float] | None = None,
) -> Scene:
    """Loads a scene.

    Args:
        source: a folder, or the name of a built-in scene: "builtin", "builtin:400" with 400 pixels a side,
            "builtin-city" with one block, or "builtin-city:4x4" with 16. The folder has `transforms_train.json`
            (Blender synthetic), `transforms.json` (instant-ngp, nerfstudio), a COLMAP model in `sparse/0`, or LLFF's
            `poses_bounds.npy`. The path of such a file, or of a COLMAP model's folder, also names the scene.
        downscale: factor by which images are reduced, >= 1. None is 1 or, for photographs, the smallest factor that
            leaves at most 512 pixels a side. The image side of a built-in scene, 100 pixels by default, is divided by
            this factor.
        allow_outside: also read images that lie outside of the folder, which a scene may name by `..`, an absolute path
            or a link.
        format: the format of a folder, one of `FORMATS` such as "colmap"; "auto" is the first format that the folder
            has.
        kind: the kind of photographs: "object" (on white), "forward" (the cameras look the same way), "inside-out" or
            "unbounded"; "auto" decides by transparent pixels and by the cameras.
        normalise: move, turn and scale photographs so that the origin is in the middle, z is up and the farthest camera
            is at distance 1; otherwise the coordinates of the files are kept.
        images: the storage of a folder's images: "memory"; "disk", a file of the cache (VORONERF_CACHE, or `voronerf`
            in the user's caches) that is mapped into memory; or "auto", which is "disk" if the images do not fit into
            memory.
        keep_far: keep photographs whose cameras lie far from all other cameras. By default these photographs are left
            out, since one such camera would determine the scale of the scene.
        region: x y z of the lowest and of the highest corner. Only pixels whose rays meet the box are used; the
            rest of the scene becomes a background. None is the whole scene.

    Raises:
        SceneError: the data cannot be used; the message is one line with the file and the fault.

    Examples:
        >>> from voronerf.app.scenes import load_scene
        >>> scene = load_scene("builtin", downscale=20)  # or a folder
        >>> scene.name, len(scene.train), len(scene.test), scene.train.images.shape[1:]
        ('builtin', 100, 25, torch.Size([5, 5, 4]))
    """
    if downscale is not None and downscale < 1:
        raise SceneError(f"{source}: downscale must be >= 1, got {downscale}")
    for name, value, choices in (("format", format, FORMATS), ("kind", kind, KINDS)):
        if value != "auto" and value not in choices:
            raise SceneError(f"{source}: {name} must be auto, {' or '.join(choices)}, got {value!r:.60}")
    if images not in ("auto", "memory", "disk"):
        raise SceneError(f"{source}: images must be auto, memory or disk, got {images!r:.60}")
    if is_builtin(source):
        if format != "auto" or kind not in ("auto", "object"):
            raise SceneError(f"{source}: format must be auto and kind auto or object, got {format} and {kind}")
        scene = _builtin(str(source), downscale or 1, images)
    else:
        reading = Reading(downscale, allow_outside, kind, normalise, images, keep_far)
        scene = _read(source, format, reading)
    if region is None:
        return scene
    return region_of(scene, torch.tensor(region, dtype=torch.float32, device="cpu").view(2, 3))


def _builtin(source: str, downscale: int, images: str) -> Scene:
    name, _, part = source.partition(":")
    if name == BUILTIN and part and not (re.fullmatch(r"[1-9]\d{0,3}", part) and int(part) <= MOST_PIXELS):
        raise SceneError(f"builtin: the size must be 1 to {MOST_PIXELS} pixels, got {part!r:.60}")
    full = int(part) if name == BUILTIN and part else BUILTIN_SIZE
    if downscale > full:
        raise SceneError(f"{source}: downscaling by {downscale} leaves no pixel of {full} x {full}")
    if name == CITY:
        return city_of(full // downscale, part or "1x1", images)
    if images == "disk":
        raise SceneError(f"{source}: images must be auto or memory for a built-in scene other than a city, got disk")
    return _computed(full // downscale)


def _read(source: str | Path, format: str, reading: Reading) -> Scene:
    """Reads a folder, or the folder of a file."""
    if re.match("(?i)[a-z][a-z0-9+.-]+://", str(source)):
        raise SceneError(f"{source}: is not a folder; download the scene, unpack it and give its folder")
    folder = Path(source)
    if folder.is_file() and folder.name in (signs := {item.sign: name for name, item in FORMATS.items()}):
        folder, format = folder.parent, signs[folder.name] if format == "auto" else format
    if not folder.exists():
        siblings = (path for path in folder.parent.glob("*") if path.is_dir())
        raise SceneError(f"{folder}: there is no such folder{similar_path(folder, (Path(BUILTIN), *siblings))}")
    if not folder.is_dir():
        around = next((outer for outer in [*folder.parents][:2] if _formats_of(outer)), None)
        hint = REMEDIES.get(folder.suffix.lower(), "").replace("{}", shlex.quote(str(folder)))
        raise SceneError(f"{folder}: is not a folder{hint}{f'; did you mean {around}?' if around else ''}")
    formats = _formats_of(folder)
    models = find_models(folder)
    place = models.paths[0].relative_to(models.folder).parts if models else ()
    if "transforms" in formats and place[:1] in (("colmap",), ("distorted",), ("dense",), ("output",)):
        formats.remove("colmap")  # nerfstudio makes transforms.json, with further entries, from colmap/sparse/0
        formats.append("colmap")
    if not formats:
        message = f"{folder}: is not a scene: it has none of {', '.join(item.sign for item in FORMATS.values())}"
        if _formats_of(folder.resolve().parent):
            message += f"; did you mean {folder.parent}?"
        elif needs_cameras(folder):
            photographs = inner if (inner := folder / "images").is_dir() else folder
            message += f"; voronerf process {photographs} DIR finds the cameras of its images"
        raise SceneError(message)
    if format != "auto" and format not in formats:
        raise SceneError(f"{folder}: format must be one that the folder has, {' or '.join(formats)}, got {format}")
    chosen = formats[0] if format == "auto" else format
    scene = FORMATS[chosen].load(folder, reading)
    others = tuple(f"--format {name} would read {FORMATS[name].sign}" for name in formats if name != chosen)
    return replace(scene, notes=(*scene.notes, *others))
