"""Territories: the parts of space that a joint training is made of, each with its own views, and who has which.

T territories, c views, l centres, v voxels. Positions are in the space that the fields see: that of the world, or of
its contraction.
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

#: Rays of a view that say where it looks, on each side of a lattice.
LATTICE = 7
#: Nearest centres among which the corners of a territory are looked for.
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
        """One of them among its neighbours."""
        others = torch.arange(len(self)) != number
        low, high = self.boxes[number]
        corners = torch.cartesian_prod(*torch.stack((low, high)).T)
        squares = (corners[:, None] - self.centres).square().sum(-1)
        reach = (squares < squares[:, number, None] * (1 + 1e-5) + 1e-12).any(0)
        numbers = (reach & others).nonzero()[:, 0].tolist()
        kept = sorted([number, *numbers])
        own = torch.full((len(kept),), -1, dtype=torch.int32)
        own[kept.index(number)] = 0
        return Place(self.boxes[number], self.centres[kept], own)

    def views(self, number: int) -> Tensor:
        """The training views of a territory, int64, ascending."""
        return (self.train == number).nonzero()[:, 0]

    def scene(self, whole: Scene, number: int) -> Scene:
        """What the settings of a territory follow from: its box, and the cameras of its views without their images."""
        rows = self.views(number)
        names = tuple(whole.train.names[row] for row in rows.tolist())
        train = replace(whole.train, cameras=whole.train.cameras[rows], names=names, images=whole.train.images[:0])
        return replace(whole, train=train, box=None if whole.box is None else self.boxes[number], notes=())


@dataclass(frozen=True)
class Place:
    """Where a territory is.

    Attributes:
        box: [2, 3], around it.
        centres: [l, 3], its own and those whose territories may reach into its box, by their numbers.
        own: int32 [l], 0 for its own centre and -1 for the others.
    """

    box: Tensor
    centres: Tensor
    own: Tensor

    def cells(self, positions: Tensor, backend: str) -> Tensor:
        """The nearest of the centres, int32 [n], of positions [n, 3]; where it is the own one, see ``own``."""
        return nearest_centre(positions, self.centres.to(positions.device), backend=backend)

    def outside(self, grid: OccupancyGrid) -> Tensor:
        """Voxels of a grid that the territory does not reach, bool [v]."""
        half = (grid.box[1] - grid.box[0]) / torch.tensor(grid.occupied.shape, device=grid.box.device) / 2
        number, centres = int((self.own == 0).nonzero()), self.centres.to(grid.box.device)
        slack = 2.002 * ((centres - centres[number]).abs() * half).sum(-1)
        found = []
        for voxels in torch.arange(grid.occupied.numel(), device=grid.box.device).split(1 << 16):
            squares = (grid.points(voxels)[:, None] - centres).square().sum(-1)
            found.append((squares + slack < squares[:, number, None]).any(1))
        return torch.cat(found)

    def bounds(self, grid: OccupancyGrid) -> Tensor:
        """[2, 3], a box around all that is not empty; all of space where rays are bent by a contraction.

        Nothing at all is a box whose first corner is above the second.
        """
        if grid.contraction is not None:
            return torch.tensor([[-torch.inf] * 3, [torch.inf] * 3])
        if not bool(grid.occupied.any()):
            return torch.tensor([[torch.inf] * 3, [-torch.inf] * 3])
        rows = [grid.occupied.amax(tuple({0, 1, 2} - {axis})).nonzero() for axis in range(3)]
        first, last = (torch.tensor([float(found[end]) for found in rows]) for end in (0, -1))
        size = (grid.box[1] - grid.box[0]).cpu() / torch.tensor(grid.occupied.shape)
        return grid.box[0].cpu() + torch.stack((first, last + 1)) * size


def cut_space(scene: Scene, count: int, contraction: Contraction | Perspective | None) -> Territories:
    """Cuts the space of a scene into territories that have as many training views each, within one.

    A view lies where its rays are when they have gone half of their way through the scene, but for no longer than a
    territory is wide. Views are halved by their places along the longest side of these, again and again; the centre of
    a territory is the mean of its views' places.
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
        raise ValueError(f"--territories must be at most the places that views of {scene.name} look at, got {count}")
    return Territories(centres, _boxes(centres, box), homes)


def halve(places: Tensor, count: int) -> Tensor:
    """Divides places into parts that lie together and have as many each, within one.

    Returns:
        int64 [n], the part of each place; parts with neighbouring numbers lie together.
    """
    part = torch.zeros(len(places), dtype=torch.int64)
    pending = [(torch.arange(len(places)), 0, count)]
    while pending:
        rows, first, parts = pending.pop()
        if parts == 1:
            part[rows] = first
            continue
        own = places[rows]
        rows = rows[own[:, int((own.amax(0) - own.amin(0)).argmax())].argsort(stable=True)]
        left = parts // 2
        end = max(len(rows) * left // parts, left)
        pending += [(rows[:end], first, left), (rows[end:], first + left, parts - left)]
    return part


def _places(scene: Scene, width: float, contraction: Contraction | Perspective | None) -> Tensor:
    """Where each training view lies, [c, 3]."""
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
    blind = ~hit.view(views, -1).any(1)  # looks past the scene
    weight[blind.repeat_interleave(len(x))] = 1
    return (points * weight).view(views, -1, 3).sum(1) / weight.view(views, -1, 1).sum(1)


def _boxes(centres: Tensor, box: Tensor) -> Tensor:
    """A box around each territory [T, 2, 3], within the box of the scene.

    Corners of a territory are where three of its sides meet. They are looked for among the sides of the scene and those
    towards the nearest centres: without the others a territory can only be larger.
    """
    sides = torch.cat((torch.eye(3), -torch.eye(3))).double()
    limits = torch.cat((box[1], -box[0])).double()
    found = []
    for centre in centres.double():
        away = (centres.double() - centre).square().sum(1)
        near = centres.double()[away.argsort()[1 : NEIGHBOURS + 1]]
        normals = torch.cat((sides, near - centre))
        ends = torch.cat((limits, (near.square().sum(1) - centre.square().sum()) / 2))
        size = normals.norm(dim=1)
        normals, ends = normals / size[:, None], ends / size
        three = torch.tensor(list(itertools.combinations(range(len(ends)), 3)))
        solved, failed = torch.linalg.solve_ex(normals[three], ends[three][..., None])
        corners = solved[..., 0]
        slack = 1e-6 * float((box[1] - box[0]).max())
        inside = (corners @ normals.T <= ends + slack).all(1) & (failed == 0) & corners.isfinite().all(1)
        corners = corners[inside]
        found.append(torch.stack((corners.amin(0), corners.amax(0))) if len(corners) else box.double())
    return torch.stack(found).float().clamp(box[0], box[1])
