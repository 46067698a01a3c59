"""Exports the surface of a trained run as coloured points with normals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from voronerf.app.export.space import VIEWS, box_of, check_export, placed, spread_around, views_of, write_geometry
from voronerf.app.run import Run
from voronerf.app.train.config import ConfigError

SUFFIXES = (".ply",)
#: Number of points from which a normal is computed.
NEIGHBOURS = 16


def export_points(
    run: Run, path: Path | str, *, count: int = 200_000, box: Tensor | None = None, to_files: bool = False
) -> Any:
    """Writes the surface points of the training views as .ply; returns them as a ``trimesh.Trimesh`` without faces.

    Each point has the colour of its pixel, and a normal towards its camera: the direction of least spread of its
    nearest neighbours.

    Args:
        run: The run.
        path: File to write, .ply.
        count: Greatest number of points; a random subset if the views have more.
        box: [2, 3], the exported region; default the scene's box, or the box around the sphere of the contraction.
        to_files: Write coordinates of the scene's files instead of scene coordinates.

    Raises:
        ConfigError: `count` is below 1, there is no box, or the views show nothing in it.
        ImportError: trimesh or scipy is missing.
        ValueError: The suffix is not .ply.
        OSError: The file cannot be written.

    Examples:
        >>> from voronerf.app import Run
        >>> from voronerf.app.export import export_points
        >>> def middle(run: Run) -> list:
        ...     return export_points(run, "scene.ply", count=10_000).vertices.mean(0).tolist()
    """
    path = Path(path)
    check_export(path, SUFFIXES)
    points = placed(run, _surface(run, count, box), to_files)
    write_geometry(path, points, vertex_normal=True)
    return points


def _surface(run: Run, count: int, box: Tensor | None) -> Any:
    import trimesh

    if count < 1:
        raise ConfigError(f"--count must be at least 1, got {count}")
    cameras = run.scene.train.cameras
    # Seven in eight pixels may show the background of an object, hence the factor 8.
    side = int((8 * count / min(VIEWS, len(cameras)) * max(cameras.width / cameras.height, 1)) ** 0.5) + 1
    cameras = cameras.downscaled(max(max(cameras.width, cameras.height) // side, 1))
    low, high = box_of(run, box)
    points, colours, towards = [], [], []
    for view in views_of(run, cameras):
        mask = ((view.surface >= low) & (view.surface <= high)).all(-1)
        points.append(view.surface[mask])
        colours.append(view.colour[mask])
        towards.append(view.camera.origins.cpu() - view.surface[mask])
    positions = torch.cat(points)
    if len(positions) == 0:
        raise ConfigError(f"{run.path}: the training views show no surface in the box")
    order = torch.randperm(len(positions), generator=torch.Generator().manual_seed(0), device="cpu")
    chosen = order[:count]
    positions, colour, toward = positions[chosen], torch.cat(colours)[chosen], torch.cat(towards)[chosen]
    normals = spread_around(positions, NEIGHBOURS)[0][..., 0]
    normals = torch.where((normals * toward).sum(-1, keepdim=True) < 0, -normals, normals)
    return trimesh.Trimesh(
        positions.numpy(),
        vertex_normals=normals.numpy(),
        vertex_colors=(colour.clamp(0, 1) * 255).round().to(torch.uint8).numpy(),
        process=False,
    )
