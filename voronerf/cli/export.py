"""``voronerf export``: what a trained run looks like, as files for other programs."""

from __future__ import annotations

from pathlib import Path

import torch

from voronerf.cli.commands import given_path, say, tracked, write_flight
from voronerf.cli.opening import AS_IN_TRAINING, Opening, check_counts
from voronerf.evaluation.video import check_video
from voronerf.export import cells as cell_files
from voronerf.export import mesh as mesh_files
from voronerf.export import points as point_files
from voronerf.export.space import check_export
from voronerf.training.config import ConfigError


def export(
    run: Path,
    /,
    points: Path | None = None,
    mesh: Path | None = None,
    cells: Path | None = None,
    video: Path | None = None,
    count: int = 200_000,
    resolution: int | None = None,
    density: float | None = None,
    box: tuple[float, float, float, float, float, float] | None = None,
    path: Path | None = None,
    spiral: bool = False,
    opening: Opening = AS_IN_TRAINING,
) -> int:
    """Write a trained run as points, a mesh, the cells of its diagram, or a video, for other programs.

    Args:
        run: The run directory.
        points: Coloured points with normals on the surface, .ply.
        mesh: The surface as a coloured mesh, .ply, .glb or .obj.
        cells: The cells of the diagram, clipped to the box, an object of its own colour each, .glb.
        video: A turntable, or the video of --spiral or --path, .mp4.
        count: Points at the most.
        resolution: Cubes of the mesh along the longest side of the box; default 256, or what fits into the memory.
        density: Density of the mesh's surface per scene unit; default that of which a thirtieth of the
            longest side of the box lets half of the light pass.
        box: What is exported, x y z of the lowest and of the highest corner; default the scene's box, or that around
            the sphere of a contraction.
        path: Camera path in nerfstudio's format, for the video.
        spiral: Go where the training cameras are, in the video; default for a forward-facing scene.
        opening: How the run is opened.
    """
    check_counts(count=count)
    outputs = {
        points: point_files.SUFFIXES,
        mesh: mesh_files.SUFFIXES,
        cells: cell_files.SUFFIXES,
    }
    if not any((points, mesh, cells, video)):
        raise ConfigError("export needs --points FILE.ply, --mesh FILE.glb, --cells FILE.glb or --video FILE.mp4")
    for file, suffixes in outputs.items():
        if file is not None:
            check_export(file, suffixes)
    if video is not None:
        check_video(video)
    given = given_path(path, spiral)
    opened = opening.open_without_images(run)
    corners = None if box is None else torch.tensor(box).view(2, 3)
    if points is not None:
        cloud = point_files.export_points(opened, points, count=count, box=corners)
        say(f"wrote {points}: {len(cloud.vertices):,} points")
    if mesh is not None:
        surface = mesh_files.export_mesh(
            opened, mesh, resolution=resolution, density=density, box=corners, track=tracked
        )
        closed = "watertight" if surface.is_watertight else "open"
        say(f"wrote {mesh}: {len(surface.vertices):,} vertices, {len(surface.faces):,} triangles, {closed}")
    if cells is not None:
        scene = cell_files.export_cells(opened, cells, box=corners)
        say(f"wrote {cells}: {len(scene.geometry)} of {opened.diagram.num_cells} cells")
    if video is not None:
        write_flight(opened, video, given=given, spiral=spiral)
    return 0
