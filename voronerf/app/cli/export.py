"""``voronerf export``: a trained run as files for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from voronerf.app.cli.display import busy, say, tracked
from voronerf.app.cli.opening import AS_IN_TRAINING, Crop, Opening, check_counts, crop_box
from voronerf.app.export import cells as cell_files
from voronerf.app.export import mesh as mesh_files
from voronerf.app.export import points as point_files
from voronerf.app.export.space import check_export
from voronerf.app.train.callbacks import counted
from voronerf.app.train.config import ConfigError
from voronerf.app.web import page as pages


def export(
    run: Path,
    /,
    points: Path | None = None,
    mesh: Path | None = None,
    cells: Path | None = None,
    web: Path | None = None,
    count: int = 200_000,
    resolution: int | None = None,
    faces: int = mesh_files.FACES,
    crop: Crop = None,
    coordinates: Literal["scene", "files"] = "scene",
    opening: Opening = AS_IN_TRAINING,
) -> int:
    """Write a trained run as points, a mesh, the cells of its diagram, or a page that draws it.

    Args:
        run: The run directory.
        points: Coloured points with normals on the surface, .ply.
        mesh: The surface as a coloured mesh, .ply, .glb or .obj.
        cells: The cells of the diagram, clipped to the box, as objects with a colour each, .glb.
        web: A page that draws the scene in any browser with WebGPU, one file that loads nothing from elsewhere, .html.
        count: Greatest number of points.
        resolution: Grid cubes of the mesh along the longest side of the box; default 256, or fewer if memory is short.
        faces: Greatest number of triangles of the mesh.
        crop: The exported box, x y z of the lowest and of the highest corner, or "saved" for the viewer's crop. Default
            the scene's box. For a scene without a box, the mesh covers the region that the cameras look at; points and
            cells cover the box around the sphere of the contraction.
        coordinates: Coordinates of points, meshes and cells: of the rendered scene, or of the scene's files (in metres
            if the capture is; for a transforms.json, before its applied_transform).
        opening: The settings with which the run is opened.
    """
    check_counts(count=count)
    outputs = {
        points: point_files.SUFFIXES,
        mesh: mesh_files.SUFFIXES,
        cells: cell_files.SUFFIXES,
    }
    files = [file.resolve() for file in (points, mesh, cells, web) if file is not None]
    if not files:
        raise ConfigError("export needs a file: --points, --mesh, --cells or --web")
    if twice := [file for file in files if files.count(file) > 1]:
        raise ConfigError(f"--points, --mesh, --cells and --web must name different files, got {twice[0]} twice")
    for file, suffixes in outputs.items():
        if file is not None:
            check_export(file, suffixes)
    if web is not None:
        pages.check_page(web)
    opened = opening.open_without_images(run)
    box, to_files = crop_box(opened, crop), coordinates == "files"
    if points is not None:
        with busy("points"):
            cloud = point_files.export_points(opened, points, count=count, box=box, to_files=to_files)
        say(f"wrote {points}: {len(cloud.vertices):,} points")
    if mesh is not None:
        surface = mesh_files.export_mesh(
            opened, mesh, resolution=resolution, faces=faces, box=box, to_files=to_files, track=tracked, say=say
        )
        # An edge with only one triangle is a boundary.
        end = "open" if np.bincount(surface.edges_unique_inverse).min() == 1 else "closed"
        extent = " x ".join(f"{side:.3g}" for side in surface.extents)
        say(f"wrote {mesh}: {len(surface.vertices):,} vertices, {len(surface.faces):,} triangles, {end}, {extent}")
    if cells is not None:
        with busy("cells"):
            scene = cell_files.export_cells(opened, cells, box=box, to_files=to_files)
        say(f"wrote {cells}: {len(scene.geometry)} of {counted(opened.diagram.num_cells, 'cell')}")
    if web is not None:
        with busy("page"):
            packed, size = pages.export_web(opened if box is None else opened.cropped(box), web)
        say(f"wrote {web}: {size / 1e6:.2f} MB, {packed.summary}")
    return 0
