"""Territories: the regions of space of a joint training, each with its own views.

Letters: T territories, c views, l centres, v voxels. Positions are in the space of the fields: the world, or its
contraction.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from voronerf.app.scenes import Scene
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.rays import intersect_box
from voronerf.ops.nearest_centre import nearest_centre

#: The number of rays along each side of a lattice over an image; the lattice gives the view's place (`cut_space`).
LATTICE = 7
#: Number of nearest centres whose bisectors are intersected for the corners of a territory.
NEIGHBOURS = 16


@dataclass(frozen=True)
class Territories:
    """A flat Voronoi diagram of space, and the territory of each view.

    Attributes:
        centres: float32 [T, 3].
        boxes: float32 [T, 2, 3], around each territory, lowest and highest corner.
        train: int64 [c], the territory of each training view.
    """

    centres: Tensor
    boxes: Tensor
    train: Tensor

    def __len__(self) -> int:
        return len(self.centres)

    def place(self, number: int) -> Place:
        """Returns the place of a territory: its box, its centre and the neighbouring centres."""
        other_territories = torch.arange(len(self)) != number
        low, high = self.boxes[number]
        corners = torch.cartesian_prod(*torch.stack((low, high)).T)
        squares = (corners[:, None] - self.centres).square().sum(-1)
        reaches_box = (squares < squares[:, number, None] * (1 + 1e-5) + 1e-12).any(0)
        numbers = (reaches_box & other_territories).nonzero()[:, 0].tolist()
        members = sorted([number, *numbers])
        is_own = torch.full((len(members),), -1, dtype=torch.int32)
        is_own[members.index(number)] = 0
        return Place(self.boxes[number], self.centres[members], is_own)

    def views(self, number: int) -> Tensor:
        """Returns the numbers of a territory's training views, int64, ascending."""
        return (self.train == number).nonzero()[:, 0]

    def scene(self, whole: Scene, number: int) -> Scene:
        """Returns a scene with the box and the cameras of a territory, without images.

        The settings of the territory are computed from this scene.
        """
        rows = self.views(number)
        names = tuple(whole.train.names[row] for row in rows.tolist())
        train = replace(whole.train, cameras=whole.train.cameras[rows], names=names, images=whole.train.images[:0])
        return replace(whole, train=train, box=None if whole.box is None else self.boxes[number], notes=())


@dataclass(frozen=True)
class Place:
    """The place of a territory among its neighbours.

    Attributes:
        box: [2, 3], the box around the territory.
        centres: [l, 3], its own centre and the centres of territories that may reach into its box, in ascending order
            of territories.
        own: int32 [l], 0 for the territory's own centre and -1 for the other centres.
    """

    box: Tensor
    centres: Tensor
    own: Tensor

    def cells(self, positions: Tensor, backend: str) -> Tensor:
        """Returns the number of the nearest of ``centres``, int32 [n], for positions [n, 3]."""
        return nearest_centre(positions, self.centres.to(positions.device), backend=backend)

    def outside(self, grid: OccupancyGrid) -> Tensor:
        """Returns a mask, bool [v], of the voxels of a grid that lie wholly outside of the territory."""
        half = (grid.box[1] - grid.box[0]) / torch.tensor(grid.occupied.shape, device=grid.box.device) / 2
        number, centres = int((self.own == 0).nonzero()), self.centres.to(grid.box.device)
        slack = 2.002 * ((centres - centres[number]).abs() * half).sum(-1)
        masks = []
        for voxels in torch.arange(grid.occupied.numel(), device=grid.box.device).split(1 << 16):
            squares = (grid.points(voxels)[:, None] - centres).square().sum(-1)
            masks.append((squares + slack < squares[:, number, None]).any(1))
        return torch.cat(masks)

    def bounds(self, grid: OccupancyGrid) -> Tensor:
        """Returns [2, 3], a box around the occupied voxels; for an empty grid, the first corner is above the second.

        If the grid has a contraction, the box is all of space, because a contraction bends rays.
        """
        if grid.contraction is not None:
            return torch.tensor([[-torch.inf] * 3, [torch.inf] * 3])
        if not bool(grid.occupied.any()):
            return torch.tensor([[torch.inf] * 3, [-torch.inf] * 3])
        rows = [grid.occupied.amax(tuple({0, 1, 2} - {axis})).nonzero() for axis in range(3)]
        first, last = (torch.tensor([float(occupied[end]) for occupied in rows]) for end in (0, -1))
        size = (grid.box[1] - grid.box[0]).cpu() / torch.tensor(grid.occupied.shape)
        return grid.box[0].cpu() + torch.stack((first, last + 1)) * size


def cut_space(scene: Scene, count: int, contraction: Contraction | Perspective | None) -> Territories:
    """Cuts the space of a scene into territories whose numbers of training views differ by at most one.

    The middle of a ray is halfway between its ends in the scene, but at most half a territory's width beyond the near
    end. The place of a view is the mean of the middles of its rays. The views are halved recursively by their places,
    along the longest side of the places' box. The centre of a territory is the mean of its views' places.
    """
    views = len(scene.train)
    if count > views:
        raise ValueError(f"--territories must be at most the {views} training views of {scene.name}, got {count}")
    box = scene.box if contraction is None else contraction.cube.cpu()
    if box is None:
        raise ValueError(f"--territories needs a scene with a box or --contraction, {scene.name} has no box")
    width = float((box[1] - box[0]).prod() / count) ** (1 / 3)
    places = _places(scene, width, contraction)
    homes = halve(places, count)
    sizes = torch.bincount(homes, minlength=count)
    centres = torch.zeros(count, 3).index_add(0, homes, places) / sizes[:, None]
    if len(centres.unique(dim=0)) < count:
        raise ValueError(
            f"--territories must be at most the number of different places that the views of {scene.name} look at, "
            f"got {count}"
        )
    return Territories(centres, _boxes(centres, box), homes)


def halve(places: Tensor, count: int) -> Tensor:
    """Divides places [n, 3] into compact parts by recursive halving; part sizes differ by at most one.

    Returns:
        int64 [n], the part of each place; parts with neighbouring numbers are neighbours in space.
    """
    part = torch.zeros(len(places), dtype=torch.int64)
    pending = [(torch.arange(len(places)), 0, count)]
    while pending:
        rows, first, parts = pending.pop()
        if parts == 1:
            part[rows] = first
            continue
        part_places = places[rows]
        rows = rows[part_places[:, int((part_places.amax(0) - part_places.amin(0)).argmax())].argsort(stable=True)]
        lower = parts // 2
        end = max(len(rows) * lower // parts, lower)
        pending += [(rows[:end], first, lower), (rows[end:], first + lower, parts - lower)]
    return part


def _places(scene: Scene, width: float, contraction: Contraction | Perspective | None) -> Tensor:
    """Returns the place of each training view, [c, 3]; see `cut_space`."""
    cameras, views = scene.train.cameras, len(scene.train)
    share = (torch.arange(LATTICE) + 0.5) / LATTICE
    y, x = (values.reshape(-1) for values in torch.meshgrid(share, share, indexing="ij"))
    sizes = torch.tensor([cameras.size(view) for view in range(views)]).reshape(-1, 2)
    number = torch.arange(views).repeat_interleave(len(x))
    rays = cameras.rays(number, (sizes[:, :1] * x).reshape(-1), (sizes[:, 1:] * y).reshape(-1))
    near, far, hit = intersect_box(rays.origins, rays.directions, scene.box, scene.near, scene.far)
    for view, (sees, (width_of, height_of)) in enumerate(zip(hit.view(views, -1), sizes.tolist())):
        if (mask := scene.train.mask(view)) is not None:  # some pixels may have no ray
            sees &= mask[(height_of * y).long(), (width_of * x).long()]
    depth = near + torch.minimum((far - near) / 2, torch.full_like(near, width / 2))
    points = torch.addcmul(rays.origins, depth[:, None], rays.directions)
    points = points if contraction is None else contraction.points(points)
    weight = hit.float()[:, None]
    blind = ~hit.view(views, -1).any(1)  # views without a ray that hits the scene
    weight[blind.repeat_interleave(len(x))] = 1
    return (points * weight).view(views, -1, 3).sum(1) / weight.view(views, -1, 1).sum(1)


def _boxes(centres: Tensor, box: Tensor) -> Tensor:
    """Returns a box around each territory, [T, 2, 3], within the box of the scene.

    Three sides of a territory meet in each corner. The candidates are the sides of the scene and the bisectors to the
    nearest centres. The other bisectors are left out, which can only make a box larger.
    """
    sides = torch.cat((torch.eye(3), -torch.eye(3))).double()
    limits = torch.cat((box[1], -box[0])).double()
    boxes = []
    for centre in centres.double():
        squares = (centres.double() - centre).square().sum(1)
        near = centres.double()[squares.argsort()[1 : NEIGHBOURS + 1]]
        normals = torch.cat((sides, near - centre))
        ends = torch.cat((limits, (near.square().sum(1) - centre.square().sum()) / 2))
        size = normals.norm(dim=1)
        normals, ends = normals / size[:, None], ends / size
        triples = torch.tensor(list(itertools.combinations(range(len(ends)), 3)))
        solved, failed = torch.linalg.solve_ex(normals[triples], ends[triples][..., None])
        corners = solved[..., 0]
        slack = 1e-6 * float((box[1] - box[0]).max())
        inside = (corners @ normals.T <= ends + slack).all(1) & (failed == 0) & corners.isfinite().all(1)
        corners = corners[inside]
        boxes.append(torch.stack((corners.amin(0), corners.amax(0))) if len(corners) else box.double())
    return torch.stack(boxes).float().clamp(box[0], box[1])
