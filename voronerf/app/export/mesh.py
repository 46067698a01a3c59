"""Exports the surface of a trained run as a coloured mesh.

The training views are rendered, which gives each pixel the distance of its surface. These distances are fused into a
truncated signed distance function: the distance from the surface along the rays, averaged over the views (Curless and
Levoy 1996), then smoothed a little. The mesh is the zero level of this function; for an object on a plain background,
the level is shifted by `BEFORE`. The average removes a surface that only one view shows, if other views look through
it. A node of the grid has a value if a view sees it, or if it lies behind a surface by less than the truncation
distance. Only blocks of nodes near a visible surface are filled.
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
#: Default number of grid cubes along the longest side of the box, if memory allows, and default number of triangles.
RESOLUTION, FACES = 256, 100_000
#: Greatest number of pixels along the longer side of the rendered views.
LONGEST = 512
#: The truncation distance in cubes, in front of and behind a surface. Fewer cubes leave holes where views disagree;
#: more let the two sides of a thin object meet.
REACH = 8
#: The standard deviation, in grid cubes, of the Gaussian that smooths the distances, since a learnt surface is rough;
#: and the fraction of `REACH` to which distances are clamped before they are smoothed. Without the clamp, views that
#: see a surface at a grazing angle would overestimate the distances in front of the surface, which moves the surface
#: inwards.
SMOOTH, CUT = 1.0, 0.3
#: The distance by which the surface of an object on a plain background is moved towards the cameras, as a fraction of
#: the longest side of the scene's box: rendered depths lie a little inside the object, and smoothing makes it smaller.
#: The value was chosen on the built-in scene and Lego. For scenes without a box, the shift makes
#: meshes worse.
BEFORE = 0.003
#: Nodes along the side of a block, and number of blocks that are filled at once.
BLOCK, BLOCKS = 8, 256
#: Greatest number of bytes that a node takes in marching cubes.
NODE = 16
#: Constants of :func:`looked_at`: the minimum fraction of the pictures that show a point of the box; the fraction of
#: outliers at each end of an axis; the factor by which the box is enlarged; and the greatest number of points.
SHARED, OUTLIERS, LONGER, POINTS = 0.5, 0.02, 1.2, 100_000
#: The minimum side of the box of :func:`looked_at` as a fraction of its longest side: the box of a wall would be flat.
FLAT = 0.1
#: Triangles of the smallest connected component that is kept, as a fraction of the largest component.
SMALLEST = 0.02
#: Exponent of the cosine between a view's direction and the normal, in the weights of colours.
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
    up and linear colours, as glTF requires; the returned mesh has z up and sRGB colours. The mesh of a scene with a box
    is closed: space that is behind a surface in every view counts as solid. The mesh of an unbounded scene is open at
    the sides of the box and where no camera looks. Components with few triangles are left out.

    Args:
        run: The run.
        path: File to write, .ply, .glb or .obj.
        resolution: Grid cubes along the longest side of the box; default 256, or fewer if memory is short.
        faces: Greatest number of triangles.
        box: [2, 3], the exported region; default the scene's box, or the box of :func:`looked_at`.
        to_files: Write coordinates of the scene's files instead of scene coordinates.
        track: Shows progress: takes a sequence and the task's name, and yields the items.
        say: Called with a line about the fraction of surfaces outside of the box.

    Raises:
        ConfigError: The resolution does not fit into memory, `faces` is below 4, or the views show no surface in the
            box.
        ImportError: trimesh, scikit-image, scipy or fast-simplification is missing.
        ValueError: The suffix is not .ply, .glb or .obj.
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
    """Returns the box [2, 3] of the region that the cameras look at, or None if there is none.

    The box encloses the surface points that project into the pictures of at least half of the views. If the cameras
    share a focus, the points must also be nearer to it than the median camera. Outliers are left out.
    """
    cameras = Cameras.joined([view.camera for view in views])
    points = torch.cat([view.surface.reshape(-1, 3) for view in views])
    points = points[points.isfinite().all(-1)]
    points = points[:: len(points) // POINTS + 1]
    shared = points.new_zeros(len(points))
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
    """Returns a line about the fraction of the surfaces that lies outside of a box."""
    points = torch.cat([view.surface.reshape(-1, 3) for view in views])
    points = points[points.isfinite().all(-1)]
    inside = ((points >= box[0]) & (points <= box[1])).all(-1)
    corners = " ".join(f"{x:.3g}" for x in box.flatten().tolist())
    share = 1 - float(inside.float().mean()) if len(points) else 0.0
    return f"{share:.0%} of the surfaces in the views lie outside of the box {corners} (--crop chooses another box)"


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
    no_surface = ConfigError(f"{run.path}: the training views show no surface in the box")
    if box is None:
        raise no_surface
    if not closed:
        say(_left_out(views, box))
    low, high = box
    extent = high - low
    side = float(extent.max()) / _resolution(extent, resolution)
    blocks = (extent / side / BLOCK).long() + 1
    value, seen = _fused(low, side, blocks, views, closed, track)
    shape = tuple(slice(count) for count in ((extent / side).round().long().clamp_min(1) + 1).tolist())
    bounds = run.scene.box
    shift = 0.0 if bounds is None else BEFORE * float((bounds[1] - bounds[0]).max()) / (REACH * side)
    distance = gaussian_filter((value[shape] - shift).clamp(-CUT, CUT).numpy(), SMOOTH)
    if closed:
        distance = np.pad(distance, 1, constant_values=1)
    if not distance.min() < 0 < distance.max():
        raise no_surface
    vertices, triangles, _, _ = marching_cubes(distance, 0.0, gradient_direction="descent")
    if closed:
        vertices -= 1
    else:  # keeps the triangles of cubes whose eight nodes were seen
        complete = minimum_filter(seen[shape].numpy(), size=2, origin=-1)
        triangles = triangles[complete[tuple(vertices[triangles].mean(1).astype(np.int64).T)]]
    if len(triangles) == 0:
        raise no_surface
    mesh: Any = trimesh.Trimesh(low.numpy() + side * vertices, triangles, process=False)
    mesh = _without_loose(mesh)
    if len(mesh.faces) > faces:  # simplification may split thin surfaces
        mesh = _without_loose(mesh.simplify_quadric_decimation(face_count=faces))
    points = torch.from_numpy(np.array(mesh.vertices, dtype=np.float32))
    normals = torch.from_numpy(np.array(mesh.vertex_normals, dtype=np.float32))
    colour = _colours(points, normals, views, REACH * side)
    mesh.visual.vertex_colors = (colour.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    return mesh


def _without_loose(mesh: Any) -> Any:
    """Removes the connected components with few triangles from a mesh; returns the mesh."""
    from trimesh.graph import connected_component_labels

    part = connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    sizes = np.bincount(part)
    mesh.update_faces((sizes >= SMALLEST * sizes.max())[part])
    mesh.remove_unreferenced_vertices()
    return mesh


def _resolution(extent: Tensor, resolution: int | None) -> int:
    share = float((extent / extent.max()).prod())
    greatest = int((available_memory() / 2 / NODE / share) ** (1 / 3))
    if resolution is None:
        return max(min(RESOLUTION, greatest), 8)
    if not 8 <= resolution <= greatest:
        raise ConfigError(f"--resolution must be 8 to {greatest}, the most that fits into memory, got {resolution}")
    return resolution


def _fused(
    low: Tensor, side: float, blocks: Tensor, views: list[SurfaceView], closed: bool, track: Track
) -> tuple[Tensor, Tensor]:
    """Returns the truncated distances of the nodes, positive in front of a surface, and a mask of the seen nodes.

    Args:
        low: [3], the position of the first node.
        side: The side of a grid cube.
        blocks: [3], the number of blocks along each axis.
        views: The rendered views.
        closed: Whether to also fill the blocks between solid and empty blocks, so that the mesh is closed.
        track: Shows progress.
    """
    counts: list[int] = blocks.tolist()
    value, near = low.new_ones(counts), low.new_zeros(counts, dtype=torch.bool)
    seen = low.new_zeros([BLOCK * count for count in counts], dtype=torch.bool)
    reach = REACH * side
    if closed:  # blocks far from a surface are solid or empty; blocks between them are filled
        centres = low + side * (BLOCK * near.logical_not().nonzero().float() + (BLOCK - 1) / 2)
        value = _distance(centres, views, reach)[0].view(counts)
        greatest, least = (sign * max_pool3d(sign * value[None], 3, 1, 1)[0] for sign in (1, -1))
        near |= greatest != least
    has_surface = low.new_zeros(counts)
    for view in views:
        points = view.surface[((view.surface > low) & (view.surface < low + BLOCK * side * blocks.float())).all(-1)]
        place = ((points - low) / (BLOCK * side)).long()
        has_surface[torch.minimum(place, blocks - 1).unbind(-1)] = 1
    near |= max_pool3d(has_surface[None], 3, 1, 1)[0] > 0  # blocks are `REACH` cubes wide, so neighbours suffice
    for axis in range(3):
        value = value.repeat_interleave(BLOCK, axis)
    inside = torch.cartesian_prod(*[torch.arange(BLOCK, device=low.device)] * 3)
    for part in track(near.nonzero().split(BLOCKS), "fusing"):
        nodes = (BLOCK * part[:, None] + inside).reshape(-1, 3)
        value[nodes.unbind(-1)], seen[nodes.unbind(-1)] = _distance(low + side * nodes.float(), views, reach)
    return value, seen


def _distance(points: Tensor, views: list[SurfaceView], reach: float) -> tuple[Tensor, Tensor]:
    """Returns the mean distances [n] from points [n, 3] to the surfaces behind them, and a mask [n] of seen points.

    Distances are in units of `reach`, at most 1. A point is seen if it lies in front of a surface of a view, or
    behind the surface by less than `reach`. The distance of an unseen point is -1 behind a surface, and 1 outside of
    all pictures.
    """
    total, count, inside = points.new_zeros(3, len(points))
    for view in views:
        _, gap = _gap(points, view)
        sees = gap > -reach
        total += torch.where(sees, (gap / reach).clamp_max(1), 0)
        count += sees
        inside += gap == gap
    return torch.where(count > 0, total / count.clamp_min(1), 1 - 2 * (inside > 0).to(total)), count > 0


def _in_picture(points: Tensor, view: SurfaceView) -> tuple[Tensor, Tensor]:
    """Projects points [n, 3] into the picture of a view: pixels [n, 2], and a mask [n] of the points inside."""
    height, width = view.colour.shape[:2]
    pixels, depth = view.camera.project(points, 0)
    limit = pixels.new_tensor((width, height))
    return pixels, (depth > 0) & ((pixels >= 0) & (pixels < limit)).all(-1)


def _gap(points: Tensor, view: SurfaceView) -> tuple[Tensor, Tensor]:
    """Returns the pixels [n, 2] of points, and the distances [n] to the surface behind them; NaN outside a picture."""
    width = view.colour.shape[1]
    pixels, inside = _in_picture(points, view)
    x, y = torch.where(inside[:, None], pixels, 0).long().unbind(-1)
    gap = view.distance.view(-1)[y * width + x] - (points - view.camera.origins[0]).norm(dim=-1)
    return pixels, torch.where(inside, gap, torch.nan)


def _colours(points: Tensor, normals: Tensor, views: list[SurfaceView], margin: float) -> Tensor:
    """Returns the colours [n, 3] of points with normals [n, 3], as weighted means over the views.

    A view counts for a point that lies within ``margin`` of the view's surface and faces the camera. The weight of a
    view is larger the nearer its camera is to the point, and the more frontally the camera sees the surface. A point
    for which no view counts gets the colour of the nearest point with a colour.
    """
    from scipy.spatial import cKDTree

    total, weight = points.new_zeros(len(points), 3), points.new_zeros(len(points))
    for view in views:
        pixels, gap = _gap(points, view)
        towards = view.camera.origins[0] - points
        distance = towards.norm(dim=-1)
        cosine = (towards * normals).sum(-1) / distance
        seen = ((gap.abs() < margin) & (cosine > 0)).nonzero()[:, 0]
        height, width = view.colour.shape[:2]
        places = (2 * pixels[seen] / pixels.new_tensor((width, height)) - 1)[None, None]
        colour = grid_sample(view.colour.permute(2, 0, 1)[None], places, padding_mode="border", align_corners=False)
        share = cosine[seen] ** FRONTAL * (view.camera.intrinsics[0, 0] / distance[seen]).square()
        total[seen] += share[:, None] * colour[0, :, 0].T
        weight[seen] += share
    coloured = weight > 0
    if coloured.any():  # unseen vertices get the colour of the nearest seen one
        total[coloured] /= weight[coloured, None]
        nearest = cKDTree(points[coloured].numpy()).query(points[~coloured].numpy())[1]
        total[~coloured] = total[coloured][torch.from_numpy(nearest)]
    return total
