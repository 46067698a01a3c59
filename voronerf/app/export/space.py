"""Shared functions of the exports: files, boxes, and the surfaces that training views show.

n points, h x w pixels. Positions are in scene units.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from voronerf.app.evaluate.scores import Track, in_silence
from voronerf.app.export.gltf import follow_conventions
from voronerf.app.files import write_bytes
from voronerf.app.render.paths import evenly_spaced
from voronerf.app.run import Run
from voronerf.app.train.config import ConfigError
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.contraction import Contraction

#: Packages of the extra `export`: the name that is imported, and the name that is installed.
PACKAGES = {
    "trimesh": "trimesh",
    "skimage": "scikit-image",
    "scipy": "scipy",
    "fast_simplification": "fast-simplification",
}
#: Number of views that are rendered to find surfaces.
VIEWS = 64
#: Opacity above which a pixel shows a surface.
SOLID = 0.5
#: Distance from the origin beyond which a pixel of a contracted scene shows no surface.
FARTHEST = 1e6


def check_export(path: Path, suffixes: tuple[str, ...]) -> None:
    """Checks the suffix of a file and the packages of the extra `export`; makes the file's folder."""
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: the file must end in {' or '.join(suffixes)}")
    for module, package in PACKAGES.items():
        try:
            importlib.import_module(module)
        except ImportError:
            raise ImportError(f"an export needs {package}: pip install 'voronerf[export]'") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise ValueError(f"{path}: must be a file, got a folder")


def write_geometry(path: Path, geometry: Any, **options: Any) -> None:
    """Writes a mesh, points or a scene of trimesh in the format of the suffix, atomically.

    The geometry has z up and sRGB colours, which .ply and .obj keep; .glb gets y up and linear colours.
    """
    kind = path.suffix[1:].lower()
    if kind == "glb":
        options["buffer_postprocessor"] = follow_conventions
    data = geometry.export(file_type=kind, **options)
    write_bytes(path, data.encode() if isinstance(data, str) else data)


def placed(run: Run, geometry: Any, to_files: bool) -> Any:
    """Returns a mesh or points of trimesh, moved into the coordinates of the scene's files if ``to_files``."""
    if to_files:
        geometry.apply_transform(torch.linalg.inv(run.scene.transform).numpy())
    return geometry


def box_of(run: Run, box: Tensor | None = None) -> Tensor:
    """Returns the box [2, 3] to export: the argument, the scene's box, or one around the sphere of a contraction."""
    if box is not None:
        run = run.cropped(box)
    if run.scene.box is not None:
        return run.scene.box.float().cpu()
    contraction = run.renderer.contraction
    if not isinstance(contraction, Contraction):
        raise ConfigError("--crop must be given as six numbers or saved: the scene has no bounds")
    return torch.stack((contraction.centre - contraction.radius, contraction.centre + contraction.radius)).cpu()


@dataclass(frozen=True)
class SurfaceView:
    """A rendered view and the surface in it."""

    camera: Cameras  # one camera
    colour: Tensor  # [h, w, 3]
    surface: Tensor  # [h, w, 3], the surface point of each pixel; NaN for a pixel without one

    @cached_property
    def distance(self) -> Tensor:
        """The distances [h, w] of the surface points from the camera; infinite for pixels without a surface."""
        return (self.surface - self.camera.origins[0]).norm(dim=-1).nan_to_num(torch.inf)


def views_of(run: Run, cameras: Cameras, track: Track = in_silence) -> list[SurfaceView]:
    """Renders at most `VIEWS` of the cameras, evenly spread."""
    views, contraction = [], run.renderer.contraction
    for number in track(evenly_spaced(len(cameras), VIEWS), "views"):
        image = run.render(cameras, number)
        surface = image.heaviest.cpu() if contraction is None else contraction.inverse(image.heaviest.cpu())
        mask = (image.opacity.cpu() > SOLID) & (surface.abs().amax(-1) < FARTHEST)
        if (has_ray := cameras.has_ray(number)) is not None:
            mask &= has_ray
        views.append(
            SurfaceView(cameras[[number]], image.colour.cpu(), torch.where(mask[..., None], surface, torch.nan))
        )
    return views


def spread_around(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Finds the principal axes of the nearest neighbours of each point.

    Returns:
        [n, 3, 3], the axes in columns, the axis of least spread first; and [n, count], the distances of the neighbours.
    """
    from scipy.spatial import cKDTree

    distances, numbers = cKDTree(points.numpy()).query(points.numpy(), k=min(count, len(points)))
    neighbours = points[torch.from_numpy(numbers).view(len(points), -1)]
    offsets = neighbours - neighbours.mean(1, keepdim=True)
    return torch.linalg.eigh(offsets.mT @ offsets)[1], torch.from_numpy(distances).float().view(len(points), -1)
