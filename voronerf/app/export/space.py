"""What exports share: their files, the densities of a field on a grid, and what the training views show.

n points, c cameras. Positions and densities are in scene units.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from voronerf.app.evaluate.scores import Track, in_silence
from voronerf.app.files import write_bytes
from voronerf.app.run import Run
from voronerf.app.train.config import ConfigError
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.contraction import Contraction

#: What shows progress: it is given the parts of a work and its name, and yields the parts, as `rich.progress.track`.
#: Packages of the extra `export`: the name that is imported, and the name that is installed.
PACKAGES = {"trimesh": "trimesh", "skimage": "scikit-image", "scipy": "scipy"}
#: Points that a field is asked for at a time.
CHUNK = 1 << 17
#: Views that are rendered to find out what cameras see.
VIEWS = 64
#: Opacity from which a pixel shows a surface.
SOLID = 0.5
#: Distance from the origin beyond which a pixel of a contracted scene shows none.
FARTHEST = 1e6


def check_export(path: Path, suffixes: tuple[str, ...]) -> None:
    """Makes the folder of a file."""
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: the file must end in {' or '.join(suffixes)}")
    for module, package in PACKAGES.items():
        try:
            importlib.import_module(module)
        except ImportError:
            raise ImportError(f"an export needs {package}: pip install 'voronerf[export]'") from None
    path.parent.mkdir(parents=True, exist_ok=True)


def write_geometry(path: Path, geometry: Any, **options: Any) -> None:
    """Writes a mesh, points or a scene of trimesh in the format of the suffix, whole or not at all."""
    data = geometry.export(file_type=path.suffix[1:].lower(), **options)
    write_bytes(path, data.encode() if isinstance(data, str) else data)


def placed(run: Run, geometry: Any, to_files: bool) -> Any:
    """A geometry of trimesh, in the coordinates of the scene's files if ``to_files``."""
    if to_files and run.scene.transform is not None:
        geometry.apply_transform(torch.linalg.inv(run.scene.transform).numpy())
    return geometry


def box_of(run: Run, box: Tensor | None = None) -> Tensor:
    """The box [2, 3] that is exported: the one given, the scene's, or one around the sphere of a contraction."""
    if box is not None:
        run = run.cropped(box)
    if run.scene.box is not None:
        return run.scene.box.float().cpu()
    contraction = run.renderer.contraction
    if not isinstance(contraction, Contraction):
        raise ConfigError("--crop must be given, six numbers or saved: the scene has no bounds")
    return torch.stack((contraction.centre - contraction.radius, contraction.centre + contraction.radius)).cpu()


@torch.no_grad()
def ask(
    run: Run, points: Tensor, directions: Tensor, *, side: float, everywhere: bool = False
) -> tuple[Tensor, Tensor]:
    """The colours [n, 3] and densities [n] of a run at points.

    Where the occupancy grid is empty, the density is 0 and the colour black.

    Args:
        run: The run.
        points: [n, 3].
        directions: Unit vectors [n, 3] along which the points are seen, or [1, 3] for all.
        side: Of a cube around a point, for fields of cones.
        everywhere: Also evaluate the field where the grid is empty.
    """
    renderer = run.renderer
    colour, density = torch.zeros(len(points), 3), torch.zeros(len(points))
    rows = torch.arange(len(points))
    if renderer.occupancy is not None and not everywhere:
        grid = renderer.occupancy
        places = points.to(renderer.device)
        places = places if renderer.contraction is None else renderer.contraction.points(places)
        rows = rows[grid.occupied.view(-1)[grid.voxels(places).long()].cpu()]
    for part in rows.split(CHUNK):
        positions = points[part].to(renderer.device)
        along = (directions if len(directions) == 1 else directions[part]).to(renderer.device)
        if renderer.cones:
            variance = torch.full_like(positions[:, :1], side * side / 12)
            spread = variance.expand(-1, 3)
            if renderer.contraction is not None:
                positions, spread = renderer.contraction.gaussians(positions, along, variance, variance)
            positions = torch.cat((positions, spread), dim=-1)
        elif renderer.contraction is not None:
            positions = renderer.contraction.points(positions)
        last = len(along) - 1
        index = torch.arange(len(part), dtype=torch.int32, device=renderer.device).clamp(max=last)
        found = renderer.field(positions, along, index)
        colour[part], density[part] = found[0].float().cpu(), found[1].float().cpu()
    return colour, density


@dataclass(frozen=True)
class Nodes:
    """The nodes of a grid of cubes."""

    origin: Tensor  # [3], position of the first
    side: float  # of a cube
    shape: tuple[int, int, int]  # nodes along each axis

    @classmethod
    def fill(cls, box: Tensor, resolution: int) -> Nodes:
        """The nodes that fill a box, `resolution` cubes along its longest side."""
        extent = box[1] - box[0]
        side = float(extent.max()) / resolution
        shape = (extent / side).round().long().clamp_min(1) + 1
        return cls(box[0], side, tuple(shape.tolist()))

    def slab(self, first: int, last: int) -> Tensor:
        """Positions [(last - first) * y * z, 3] of the nodes whose first index is in that range."""
        ranges = (torch.arange(first, last), *map(torch.arange, self.shape[1:]))
        return self.positions(torch.stack(torch.meshgrid(*ranges, indexing="ij"), dim=-1).reshape(-1, 3))

    def positions(self, indices: Tensor) -> Tensor:
        """Positions [n, 3] of indices [n, 3], which need not be whole."""
        return self.origin + self.side * indices

    def slabs(self) -> list[tuple[int, int]]:
        """Ranges of first indices with about `CHUNK` nodes each."""
        step = max(CHUNK // (self.shape[1] * self.shape[2]), 1)
        return [(first, min(first + step, self.shape[0])) for first in range(0, self.shape[0], step)]


def density_at(run: Run, nodes: Nodes, track: Track) -> Tensor:
    """The densities of a run at nodes, float32 of their shape; densities do not depend on the direction."""
    density = torch.empty(nodes.shape)
    down = torch.tensor([[0.0, 0.0, -1.0]])
    for first, last in track(nodes.slabs(), "density"):
        _, found = ask(run, nodes.slab(first, last), down, side=nodes.side)
        density[first:last] = found.view(last - first, *nodes.shape[1:])
    return density.nan_to_num(0, 0, 0)


@dataclass(frozen=True)
class View:
    """What one camera sees."""

    camera: Cameras  # the camera alone
    colour: Tensor  # [h, w, 3]
    surface: Tensor  # [h, w, 3], the point that each pixel shows; NaN where it shows none


def views_of(run: Run, cameras: Cameras, most: int, track: Track = in_silence) -> list[View]:
    """Renders up to so many of the cameras, evenly spread."""
    views, contraction = [], run.renderer.contraction
    numbers = torch.linspace(0, len(cameras) - 1, min(most, len(cameras))).round().long().tolist()
    for number in track(numbers, "views"):
        image = run.render(cameras, number)
        surface = image.heaviest.cpu() if contraction is None else contraction.inverse(image.heaviest.cpu())
        shown = (image.opacity.cpu() > SOLID) & (surface.abs().amax(-1) < FARTHEST)
        views.append(View(cameras[[number]], image.colour.cpu(), torch.where(shown[..., None], surface, torch.nan)))
    return views


def spread_around(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """How the nearest points [n, 3] of each lie: axes [n, 3, 3], least spread first, and distances [n, count]."""
    from scipy.spatial import cKDTree

    apart, near = cKDTree(points.numpy()).query(points.numpy(), k=min(count, len(points)))
    around = points[torch.from_numpy(near).view(len(points), -1)]
    offsets = around - around.mean(1, keepdim=True)
    return torch.linalg.eigh(offsets.mT @ offsets)[1], torch.from_numpy(apart).float().view(len(points), -1)


def hidden_and_seen(points: Tensor, views: list[View], side: float) -> tuple[Tensor, Tensor]:
    """Which of the points [n, 3] lie behind a surface in every view that has them, and which before one in some view.

    Between the two is a margin of two sides of a cube of the grid and two pixels. Points in no view are seen.

    Returns:
        (hidden bool [n], seen bool [n]).
    """
    visible, seen = torch.zeros(len(points), dtype=torch.bool), torch.zeros(len(points), dtype=torch.bool)
    inside_one = torch.zeros(len(points), dtype=torch.bool)
    waiting = torch.arange(len(points))
    for view in views:
        distance = (view.surface - view.camera.origins[0]).norm(dim=-1).nan_to_num(torch.inf)
        height, width = distance.shape
        positions = points[waiting]
        pixels, depth = view.camera.project(positions, 0)
        x, y = pixels.floor().long().unbind(-1)
        inside = (depth > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
        rows, x, y, depth = waiting[inside], x[inside], y[inside], depth[inside]
        gap = distance[y, x] - (positions[inside] - view.camera.origins[0]).norm(dim=-1)
        margin = 2 * side + 2 * depth / view.camera.intrinsics[0, 1]
        inside_one[rows] = True
        visible[rows[gap > -margin]] = True
        seen[rows[gap > margin]] = True
        waiting = waiting[~seen[waiting]]  # most of space is free, and found so by the first views
    return inside_one & ~visible, seen | ~inside_one
