"""``voronerf export``: what a trained run looks like, as files for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from voronerf.app.cli.display import busy, say, tracked
from voronerf.app.cli.opening import AS_IN_TRAINING, Crop, Opening, check_counts, crop_box
from voronerf.app.export import cells as cell_files
from voronerf.app.export import mesh as mesh_files
from voronerf.app.export import points as point_files
from voronerf.app.export import splats as splat_files
from voronerf.app.export.space import check_export
from voronerf.app.train.config import ConfigError


def export(
    run: Path,
    /,
    splat: Path | None = None,
    points: Path | None = None,
    mesh: Path | None = None,
    cells: Path | None = None,
    count: int | None = None,
    fit: float = 60.0,
    resolution: int | None = None,
    density: float | None = None,
    crop: Crop = None,
    coordinates: Literal["scene", "files"] = "scene",
    opening: Opening = AS_IN_TRAINING,
) -> int:
    """Write a trained run as Gaussians, points, a mesh, or the cells of its diagram.

    Args:
        run: The run directory.
        splat: 3D Gaussians that are fitted to the run's own pictures, for viewers of splats, .ply.
        points: Coloured points with normals on the surface, .ply.
        mesh: The surface as a coloured mesh, .ply, .glb or .obj.
        cells: The cells of the diagram, clipped to the box, an object of its own colour each, .glb.
        count: Points or Gaussians at the most; default 200,000 points, 100,000 Gaussians.
        fit: Seconds for which the Gaussians are fitted.
        resolution: Cubes of the mesh along the longest side of the box; default 256, or what fits into memory.
        density: Density of the mesh's surface per scene unit; default that of which a thirtieth of the longest side of
            the box lets half of the light pass.
        crop: What is exported, x y z of the lowest and of the highest corner, or "saved" for the viewer's crop; default
            the scene's box, or that around the sphere of a contraction, but splats of everything.
        coordinates: Positions are those of the scene as it is rendered, or those of its files: in metres, if the
            capture is in metres.
        opening: How the run is opened.
    """
    check_counts(count=count)
    outputs = {
        splat: splat_files.SUFFIXES,
        points: point_files.SUFFIXES,
        mesh: mesh_files.SUFFIXES,
        cells: cell_files.SUFFIXES,
    }
    if not any((splat, points, mesh, cells)):
        raise ConfigError("export needs a file: --splat, --points, --mesh or --cells")
    for file, suffixes in outputs.items():
        if file is not None:
            check_export(file, suffixes)
    opened = opening.open_without_images(run)
    box, to_files = crop_box(opened, crop), coordinates == "files"
    if splat is not None:
        splats, scores = splat_files.export_splats(
            opened, splat, count=count or 100_000, seconds=fit, box=box, to_files=to_files, track=tracked
        )
        gain = f"PSNR {scores['after']:.2f} dB against the run's own test views, {scores['before']:.2f} before fitting"
        say(f"wrote {splat}: {len(splats):,} Gaussians, {gain}")
    if points is not None:
        with busy("points"):
            cloud = point_files.export_points(opened, points, count=count or 200_000, box=box, to_files=to_files)
        say(f"wrote {points}: {len(cloud.vertices):,} points")
    if mesh is not None:
        surface = mesh_files.export_mesh(
            opened, mesh, resolution=resolution, density=density, box=box, to_files=to_files, track=tracked
        )
        closed = "watertight" if surface.is_watertight else "open"
        extent = " x ".join(f"{side:.3g}" for side in surface.extents)
        say(f"wrote {mesh}: {len(surface.vertices):,} vertices, {len(surface.faces):,} triangles, {closed}, {extent}")
    if cells is not None:
        with busy("cells"):
            scene = cell_files.export_cells(opened, cells, box=box, to_files=to_files)
        say(f"wrote {cells}: {len(scene.geometry)} of {opened.diagram.num_cells} cells")
    return 0
