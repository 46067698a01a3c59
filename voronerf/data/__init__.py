"""Scenes: loaders of Blender synthetic scenes and of real captures, and three scenes computed from formulas."""

from __future__ import annotations

from pathlib import Path

from voronerf.data.blender import load_blender
from voronerf.data.builtin import builtin_scene, rich_scene, translucent_scene
from voronerf.data.capture import load_capture
from voronerf.data.scene import Scene, SceneError, Split

__all__ = ["Scene", "SceneError", "Split", "builtin_scene", "load_scene", "rich_scene", "translucent_scene"]

BUILTIN_SIZE = 100
BUILTIN = {"builtin": builtin_scene, "builtin-rich": rich_scene, "builtin-translucent": translucent_scene}


def load_scene(source: str | Path, *, downscale: int = 1, allow_outside: bool = False) -> Scene:
    """Loads a scene.

    Args:
        source: "builtin", "builtin-rich" or "builtin-translucent", or a folder with `transforms_train.json` (Blender
            synthetic) or `transforms.json` (capture).
        downscale: factor by which images are reduced, >= 1; built-in scenes have 100 pixels divided by it.
        allow_outside: also read images that lie outside of the folder, which a scene may name by `..`, an absolute path
            or a link.

    Raises:
        SceneError: the data cannot be used; one line that names the file and what is wrong with it.

    Examples:
        >>> from voronerf.data import load_scene
        >>> scene = load_scene("builtin", downscale=20)  # or a folder
        >>> scene.name, len(scene.train), len(scene.test), scene.train.images.shape[1:]
        ('builtin', 100, 25, torch.Size([5, 5, 4]))
    """
    if downscale < 1:
        raise SceneError(f"{source}: downscale must be >= 1, got {downscale}")
    if str(source) in BUILTIN:
        if downscale > BUILTIN_SIZE:
            raise SceneError(f"{source}: downscaling by {downscale} leaves no pixel of {BUILTIN_SIZE} x {BUILTIN_SIZE}")
        return BUILTIN[str(source)](BUILTIN_SIZE // downscale)
    folder = Path(source)
    if not folder.exists():
        raise SceneError(f"{folder}: there is no such folder")
    if (folder / "transforms_train.json").is_file():
        return load_blender(folder, downscale, allow_outside)
    if (folder / "transforms.json").is_file():
        return load_capture(folder, downscale, allow_outside)
    if not folder.is_dir():
        raise SceneError(f"{folder}: is not a folder")
    raise SceneError(f"{folder}: is not a scene, it has neither transforms_train.json (Blender) nor transforms.json")
