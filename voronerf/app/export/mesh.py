"""The surface of a trained run as a coloured mesh.

The pictures of training views say how far away the surface is that each pixel shows. These distances are fused into one
function, the signed distance from the surface along the rays, truncated, and averaged over the views (Curless and Levoy
1996), then smoothed a little. It is zero on the surface or, of an object on a plain background, a little behind it.
What one view takes for a surface and others look through is averaged away. A node of the grid has a value where a view
sees it or where it lies shortly behind a surface; only blocks of nodes near what some pixel shows are filled.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool3d

from voronerf.app.export.space import (
    SurfaceView,
    Track,
    box_of,
    check_export,
    in_silence,
    placed,
    views_of,
    write_geometry,
)
from voronerf.app.run import Run
from voronerf.app.train.config import ConfigError
from voronerf.nerf.cameras import Cameras, shared_focus
from voronerf.ops._core.checks import available_memory

SUFFIXES = (".ply", ".glb", ".obj")
#: Cubes along the longest side of the box, if memory allows, and triangles.
RESOLUTION, FACES = 256, 100_000
#: Pixels along the longer side of the pictures, at the most.
LONGEST = 512
#: Cubes before and behind a surface in which its distance is averaged. Fewer leave holes where views disagree, more let
#: the two sides of a thin thing meet.
REACH = 8
#: Distances are smoothed by a Gaussian of so many cubes, since a learnt surface is rough. Before, they are cut off at
#: this share of a reach: farther ones are too long where views see a surface from the side, and only before it, which
#: would move it inwards.
SMOOTH, CUT = 1.0, 0.3
#: The surface of an object on a plain background lies so far before the distances along rays, as a share of the longest
#: side of the scene's box: views look a little into its field, and smoothing makes it smaller. Chosen on the built-in
#: scene and Lego (docs/export.md); photographs without a box would lose by it.
BEFORE = 0.003
#: Nodes along the side of a block, and blocks that are filled at a time.
BLOCK, BLOCKS = 8, 256
#: Bytes of memory that a node takes at the most, in marching cubes.
NODE = 16
#: What cameras look at lies in this share of their pictures. The share of its points that may be outliers, at either
#: end of the box; how much longer the box is than what lies between; and how many points tell it.
SHARED, OUTLIERS, LONGER, POINTS = 0.5, 0.02, 1.2, 100_000
#: The least side of that box, as a share of its longest: a wall is flat.
FLAT = 0.1
#: Triangles of the smallest part that is kept, as a share of the largest part's.
SMALLEST = 0.02
#: Colours count by this power of the cosine between a view's direction and the normal.
FRONTAL = 4


def export_mesh(
    run: Run,
    path: Path | str,
    *,
    resolution: int | None = None,
    faces: int = FACES,
    box: Tensor | None = None,
    to_files: bool = False,
    track: Track = in_silence,
    say: Callable[[str], None] = lambda line: None,
) -> Any:
    """Writes the surface of a run as .ply, .glb or .obj, and returns it as a ``trimesh.Trimesh``.

    Each vertex has the colour that the training views show there. .ply and .obj have z up and sRGB colours, .glb has y
    up and linear colours, as glTF asks for; the mesh that is returned has z up and sRGB colours. The mesh of a scene
    with a box is closed: what is behind a surface in every view counts as solid. That of an unbounded scene ends where
    the box ends, and where no camera looks; what the box leaves out is said. Parts with few triangles beside the
    largest are left out.

    Args:
        run: The run.
        path: File to write, .ply, .glb or .obj.
        resolution: Cubes along the longest side of the box; default 256, or what fits into memory.
        faces: Triangles at the most.
        box: [2, 3], what is exported; default the scene's, or that of what the cameras look at: :func:`looked_at`.
        to_files: Positions are those of the scene's files, rather than the scene's.
        track: Shows progress: yields the items of a sequence, and is given its name.
        say: Takes a line about what a box leaves out.

    Raises:
        ConfigError: A resolution that does not fit into memory, fewer than 4 faces, or views that show no surface
            in the box.
        ImportError: trimesh, scikit-image, scipy or fast-simplification is missing.
        ValueError: Another suffix.
        OSError: The file cannot be written.

    Examples:
        >>> from voronerf.app import Run
        >>> from voronerf.app.export import export_mesh
        >>> def volume(run: Run) -> float:
        ...     return export_mesh(run, "scene.glb", faces=20_000).volume
    """
    path = Path(path)
    check_export(path, SUFFIXES)
    mesh = placed(run, _surface(run, resolution, faces, box, track, say), to_files)
    write_geometry(path, mesh)
    return mesh


def looked_at(views: list[SurfaceView]) -> Tensor | None:
    """The box [2, 3] of what cameras look at: of the points that views show, those that lie in the pictures of half of
    the views, and nearer to what these look at than half of the cameras. None where there are none.
    """
    cameras = Cameras.joined([view.camera for view in views])
    points = torch.cat([view.surface.reshape(-1, 3) for view in views])
    points = points[points.isfinite().all(-1)]
    points = points[:: len(points) // POINTS + 1]
    shared = torch.zeros(len(points))
    for view in views:
        shared += _in_picture(points, view)[1]
    kept = shared >= SHARED * len(views)
    focus = shared_focus(cameras)
    if focus is not None:
        kept &= (points - focus).norm(dim=-1) < (cameras.origins - focus).norm(dim=-1).median()
    if not kept.any():
        return None
    low, high = torch.quantile(points[kept], points.new_tensor((OUTLIERS, 1 - OUTLIERS)), dim=0)
    sides = high - low
    middle, half = (low + high) / 2, LONGER * sides.clamp_min(FLAT * float(sides.max())) / 2
    return torch.stack((middle - half, middle + half))


def _left_out(views: list[SurfaceView], box: Tensor) -> str:
    """A line about the surfaces that lie outside of a box."""
    points = torch.cat([view.surface.reshape(-1, 3) for view in views])
    points = points[points.isfinite().all(-1)]
    inside = ((points >= box[0]) & (points <= box[1])).all(-1)
    corners = " ".join(f"{x:.3g}" for x in box.flatten().tolist())
    share = 1 - float(inside.float().mean()) if len(points) else 0.0
    return f"{share:.0%} of the surfaces in the views lie outside of the box {corners} (--crop takes another)"


def _surface(
    run: Run, resolution: int | None, faces: int, box: Tensor | None, track: Track, say: Callable[[str], None]
) -> Any:
    import trimesh
    from scipy.ndimage import gaussian_filter, minimum_filter
    from skimage.measure import marching_cubes

    if faces < 4:
        raise ConfigError(f"--faces must be at least 4, got {faces}")
    closed = run.scene.box is not None and box is None
    cameras = run.scene.train.cameras
    cameras = cameras.downscaled(-(-max(cameras.width, cameras.height) // LONGEST))
    if box is not None or closed:
        box = box_of(run, box)
        _resolution(box[1] - box[0], resolution)
    views = views_of(run, cameras, track)
    box = looked_at(views) if box is None else box
    empty = ConfigError(f"{run.path}: the training views show no surface in the box")
    if box is None:
        raise empty
    if not closed:
        say(_left_out(views, box))
    low, high = box
    extent = high - low
    side = float(extent.max()) / _resolution(extent, resolution)
    blocks = (extent / side / BLOCK).long() + 1
    value, seen = _fused(low, side, blocks, views, closed, track)
    shape = tuple(slice(count) for count in ((extent / side).round().long().clamp_min(1) + 1).tolist())
    bounds = run.scene.box
    before = 0.0 if bounds is None else BEFORE * float((bounds[1] - bounds[0]).max()) / (REACH * side)
    distance = gaussian_filter((value[shape] - before).clamp(-CUT, CUT).numpy(), SMOOTH)
    if closed:
        distance = np.pad(distance, 1, constant_values=1)
    if not distance.min() < 0 < distance.max():
        raise empty
    vertices, triangles, _, _ = marching_cubes(distance, 0.0, gradient_direction="descent")
    if closed:
        vertices -= 1
    else:  # cubes with eight nodes that were seen
        whole = minimum_filter(seen[shape].numpy(), size=2, origin=-1)
        triangles = triangles[whole[tuple(vertices[triangles].mean(1).astype(np.int64).T)]]
    if len(triangles) == 0:
        raise empty
    mesh: Any = trimesh.Trimesh(low.numpy() + side * vertices, triangles, process=False)
    mesh = _without_loose(mesh)
    if len(mesh.faces) > faces:  # which parts where the surface is thin
        mesh = _without_loose(mesh.simplify_quadric_decimation(face_count=faces))
    points = torch.from_numpy(np.array(mesh.vertices, dtype=np.float32))
    normals = torch.from_numpy(np.array(mesh.vertex_normals, dtype=np.float32))
    colour = _colours(points, normals, views, REACH * side)
    mesh.visual.vertex_colors = (colour.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    return mesh


def _without_loose(mesh: Any) -> Any:
    """A mesh without parts of few triangles."""
    from trimesh.graph import connected_component_labels

    part = connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    sizes = np.bincount(part)
    mesh.update_faces((sizes >= SMALLEST * sizes.max())[part])
    mesh.remove_unreferenced_vertices()
    return mesh


def _resolution(extent: Tensor, wanted: int | None) -> int:
    share = float((extent / extent.max()).prod())
    most = int((available_memory() / 2 / NODE / share) ** (1 / 3))
    if wanted is None:
        return max(min(RESOLUTION, most), 8)
    if not 8 <= wanted <= most:
        raise ConfigError(f"--resolution must be 8 to {most}, for which there is memory, got {wanted}")
    return wanted


def _fused(
    low: Tensor, side: float, blocks: Tensor, views: list[SurfaceView], closed: bool, track: Track
) -> tuple[Tensor, Tensor]:
    """The truncated distances of blocks of nodes, positive before a surface, and which of the nodes were seen."""
    counts: list[int] = blocks.tolist()
    value, seen = torch.ones(counts), torch.zeros([BLOCK * count for count in counts], dtype=torch.bool)
    near = torch.zeros(counts, dtype=torch.bool)
    reach = REACH * side
    if closed:  # far from a surface too, what is behind one counts as solid; what is between needs all nodes
        middles = low + side * (BLOCK * near.logical_not().nonzero() + (BLOCK - 1) / 2)
        value = _distance(middles, views, reach)[0].view(counts)
        greatest, least = (sign * max_pool3d(sign * value[None], 3, 1, 1)[0] for sign in (1, -1))
        near |= greatest != least
    shown = torch.zeros(counts)
    for view in views:
        points = view.surface[((view.surface > low) & (view.surface < low + BLOCK * side * blocks)).all(-1)]
        place = ((points - low) / (BLOCK * side)).long()
        shown[torch.minimum(place, blocks - 1).unbind(-1)] = 1
    near |= max_pool3d(shown[None], 3, 1, 1)[0] > 0  # a block is a reach wide
    for axis in range(3):
        value = value.repeat_interleave(BLOCK, axis)
    inside = torch.cartesian_prod(*[torch.arange(BLOCK)] * 3)
    for part in track(near.nonzero().split(BLOCKS), "fusing"):
        nodes = (BLOCK * part[:, None] + inside).reshape(-1, 3)
        value[nodes.unbind(-1)], seen[nodes.unbind(-1)] = _distance(low + side * nodes, views, reach)
    return value, seen


def _distance(points: Tensor, views: list[SurfaceView], reach: float) -> tuple[Tensor, Tensor]:
    """Mean distances [n] of points [n, 3] from the surfaces behind them, in reaches and at most 1; and which were seen.

    Without a view that sees a point, or a surface shortly before it, it is -1 behind a surface and 1 outside of all
    pictures.
    """
    total, count, inside = (torch.zeros(len(points)) for _ in range(3))
    for view in views:
        _, gap = _gap(points, view)
        known = gap > -reach
        total += torch.where(known, (gap / reach).clamp_max(1), 0)
        count += known
        inside += gap == gap
    return torch.where(count > 0, total / count.clamp_min(1), torch.where(inside > 0, -1.0, 1.0)), count > 0


def _in_picture(points: Tensor, view: SurfaceView) -> tuple[Tensor, Tensor]:
    """Where a view has points [n, 3] in its picture, [n, 2], and which of them lie in it, bool [n]."""
    height, width = view.colour.shape[:2]
    pixels, depth = view.camera.project(points, 0)
    limit = pixels.new_tensor((width, height))
    return pixels, (depth > 0) & ((pixels >= 0) & (pixels < limit)).all(-1)


def _gap(points: Tensor, view: SurfaceView) -> tuple[Tensor, Tensor]:
    """Where a view has points in its picture [n, 2], and how far behind them the surface is [n]; NaN outside of it."""
    width = view.colour.shape[1]
    pixels, inside = _in_picture(points, view)
    x, y = torch.where(inside[:, None], pixels, 0).long().unbind(-1)
    gap = view.distance.view(-1)[y * width + x] - (points - view.camera.origins[0]).norm(dim=-1)
    return pixels, torch.where(inside, gap, torch.nan)


def _colours(points: Tensor, normals: Tensor, views: list[SurfaceView], margin: float) -> Tensor:
    """The colours [n, 3] that views show of points: means, in which what is near and frontal counts most."""
    from scipy.spatial import cKDTree

    total, weight = torch.zeros(len(points), 3), torch.zeros(len(points))
    for view in views:
        pixels, gap = _gap(points, view)
        away = view.camera.origins[0] - points
        distance = away.norm(dim=-1)
        cosine = (away * normals).sum(-1) / distance
        seen = ((gap.abs() < margin) & (cosine > 0)).nonzero()[:, 0]
        height, width = view.colour.shape[:2]
        places = (2 * pixels[seen] / pixels.new_tensor((width, height)) - 1)[None, None]
        colour = grid_sample(view.colour.permute(2, 0, 1)[None], places, padding_mode="border", align_corners=False)
        share = cosine[seen] ** FRONTAL * (view.camera.intrinsics[0, 0] / distance[seen]).square()
        total[seen] += share[:, None] * colour[0, :, 0].T
        weight[seen] += share
    known = weight > 0
    if known.any():  # what no view sees has the colour of the nearest vertex that one does
        total[known] /= weight[known, None]
        nearest = cKDTree(points[known].numpy()).query(points[~known].numpy())[1]
        total[~known] = total[known][torch.from_numpy(nearest)]
    return total
