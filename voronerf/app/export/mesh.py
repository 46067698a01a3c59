"""The surface of a trained run as a coloured mesh.

The density of the field on a grid gives the surface, by marching cubes. What no camera sees into, the field has not
learnt: behind the first surface it may be empty or full. So space that lies behind a surface in every view counts as
solid, and the mesh has an outside only. Parts that are small beside the largest, such as fog in the air, are left out.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from voronerf.app.export.space import (
    VIEWS,
    Nodes,
    Track,
    ask,
    box_of,
    check_export,
    density_at,
    hidden_and_seen,
    in_silence,
    placed,
    views_of,
    write_geometry,
)
from voronerf.app.run import Run
from voronerf.app.train.config import ConfigError
from voronerf.ops._core.checks import available_memory

SUFFIXES = (".ply", ".glb", ".obj")
#: Cubes along the longest side of the box, if memory allows.
RESOLUTION = 256
#: Share of the longest side of the box over which the density of the surface lets half of the light pass. Smaller ones
#: leave out what a short training has made a faint fog, larger ones take fog around surfaces for a part of them.
HALVING = 1 / 30
#: Bytes of memory that a node takes at the most, in marching cubes.
NODE = 40
#: Pixels along the longer side of the views, at least.
VIEW_SIDE = 128
#: Volume of the smallest part that is kept, as a share of the largest.
SMALLEST = 1e-3


def export_mesh(
    run: Run,
    path: Path | str,
    *,
    resolution: int | None = None,
    density: float | None = None,
    box: Tensor | None = None,
    to_files: bool = False,
    track: Track = in_silence,
) -> Any:
    """Writes the surface of a run as .ply, .glb or .obj, and returns it as a ``trimesh.Trimesh``.

    Each vertex has a colour and a normal. The mesh of a scene with a box is watertight. That of an unbounded scene is
    open: its surfaces end where the box ends, and where no camera looks.

    Args:
        run: The run.
        path: File to write, .ply, .glb or .obj.
        resolution: Cubes along the longest side of the box; default 256, or what fits into memory.
        density: Of the surface, per scene unit; default that of which a thirtieth of that side lets half of the light
            pass.
        box: [2, 3], what is exported; default the scene's, or that around the sphere of the contraction.
        to_files: Positions are those of the scene's files, rather than the scene's.
        track: Shows progress: yields the items of a sequence, and is given its name.

    Raises:
        ConfigError: A resolution that does not fit into memory, a density that is not positive, no box, or no surface
            in it.
        ImportError: trimesh, scikit-image or scipy is missing.
        ValueError: Another suffix.
        OSError: The file cannot be written.

    Examples:
        >>> from voronerf.app import Run
        >>> from voronerf.app.export import export_mesh
        >>> def volume(run: Run) -> float:
        ...     return export_mesh(run, "scene.glb", resolution=128).volume
    """
    path = Path(path)
    check_export(path, SUFFIXES)
    mesh = placed(run, _surface(run, resolution, density, box, track), to_files)
    write_geometry(path, mesh)
    return mesh


def _surface(run: Run, resolution: int | None, density: float | None, box: Tensor | None, track: Track) -> Any:
    import trimesh
    from scipy import ndimage
    from skimage.measure import marching_cubes

    closed = run.scene.box is not None and box is None
    box = box_of(run, box)
    nodes = Nodes.fill(box, _resolution(box, resolution))
    halving = HALVING * float((box[1] - box[0]).max())
    level = math.log(2) / halving if density is None else density
    if not 0 < level < math.inf:
        raise ConfigError(f"--density must be positive and finite, got {density}")
    found = density_at(run, nodes, track)
    dense = (found > level).numpy()
    hidden, seen = _views_of(run, nodes, track)
    # Free is what is empty, not hidden, and connected to what a camera sees to be free.
    labels, _ = ndimage.label(~dense & ~hidden)
    free = np.isin(labels, np.unique(labels[seen & (labels > 0)]))
    solid = _largest_parts(~free, ndimage)
    if not solid.any() or not dense.any():
        raise ConfigError(f"--density must be lower: nothing in the box is as dense as {level:g}")
    # The opacity of a cube of that side, 0.5 at the surface; what was decided otherwise than by density gets 0 or 1.
    opacity = (1 - torch.exp(found * (-math.log(2) / level))).numpy()
    opacity[solid & ~dense] = 1
    opacity[~solid & dense] = 0
    del labels, free, hidden, seen
    if closed:
        opacity = np.pad(opacity, 1)
    vertices, faces, _, _ = marching_cubes(opacity, 0.5, gradient_direction="ascent")
    vertices -= float(closed)
    if not closed:
        faces = faces[_of_density(vertices, dense, ndimage)[faces].all(-1)]
    mesh: Any = trimesh.Trimesh(nodes.positions(torch.from_numpy(vertices.copy())).numpy(), faces, process=False)
    mesh.remove_unreferenced_vertices()
    normals = torch.from_numpy(np.ascontiguousarray(mesh.vertex_normals, dtype=np.float32))
    points = torch.from_numpy(np.ascontiguousarray(mesh.vertices, dtype=np.float32))
    # Just inside, where the field was trained; a vertex may lie in an empty cell of the occupancy grid.
    colour, _ = ask(run, points - nodes.side / 2 * normals, -normals, side=nodes.side, everywhere=True)
    mesh.visual.vertex_colors = (colour.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    return mesh


def _resolution(box: Tensor, wanted: int | None) -> int:
    extent = box[1] - box[0]
    share = float((extent / extent.max()).prod())
    most = int((available_memory() / 2 / NODE / share) ** (1 / 3))
    if wanted is None:
        return max(min(RESOLUTION, most), 8)
    if not 8 <= wanted <= most:
        raise ConfigError(f"--resolution must be 8 to {most}, for which there is memory, got {wanted}")
    return wanted


def _views_of(run: Run, nodes: Nodes, track: Track) -> tuple[Any, Any]:
    cameras = run.scene.train.cameras
    cameras = cameras.downscaled(max(max(cameras.width, cameras.height) // VIEW_SIDE, 1))
    views = views_of(run, cameras, VIEWS, track)
    hidden, seen = np.empty(nodes.shape, dtype=bool), np.empty(nodes.shape, dtype=bool)
    for first, last in track(nodes.slabs(), "what the views see"):
        parts = hidden_and_seen(nodes.slab(first, last), views, nodes.side)
        hidden[first:last], seen[first:last] = (part.view(last - first, *nodes.shape[1:]).numpy() for part in parts)
    return hidden, seen


def _largest_parts(solid: Any, ndimage: Any) -> Any:
    labels, count = ndimage.label(solid)
    if count == 0:
        return solid
    sizes = np.bincount(labels.reshape(-1))
    sizes[0] = 0
    return (sizes >= SMALLEST * sizes.max())[labels] & solid


def _of_density(vertices: Any, dense: Any, ndimage: Any) -> Any:
    """Which vertices lie beside a dense node, rather than where no camera has looked."""
    near = ndimage.binary_dilation(dense, iterations=1)
    whole = np.minimum(vertices.round().astype(np.int64), np.array(dense.shape) - 1)
    return near[tuple(whole.T)]
