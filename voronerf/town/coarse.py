"""The coarse level of a part: a colour and an opacity for each voxel, for pictures that see the part from far away.

n samples, q voxels. Positions, lengths and densities are in the frame of the part.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from voronerf.ops.observe_occupancy.reference import cells_of

if TYPE_CHECKING:
    from voronerf.town.parts import Part

#: Voxels that are made at a time.
CHUNK = 1 << 14
#: The most voxels along the longest side of a part. A level is drawn where a voxel is no wider than a pixel: by this
#: where the part takes up to so many pixels of a picture, from which it is near.
MOST_ACROSS = 128
#: The opacity that is kept as 255, since a density cannot be infinite.
OPAQUE = 0.999
#: Where a voxel is asked: the middles of its eighths.
_CORNERS = torch.tensor([*itertools.product((-1.0, 1.0), repeat=3)])


@dataclass(frozen=True, eq=False)
class Coarse:
    """Voxels of a box, of which those that show nothing are left out.

    Raises:
        ValueError: For other shapes or types.
    """

    box: Tensor  # [2, 3]
    shape: Tensor  # int64 [3], voxels along each axis
    voxels: Tensor  # int32 [q], flat numbers, ascending
    values: Tensor  # uint8 [q, 4], colour and opacity of a ray through the voxel along an axis

    def __post_init__(self) -> None:
        q = len(self.voxels)
        wanted = {"box": (2, 3), "shape": (3,), "voxels": (q,), "values": (q, 4)}
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape or not q:
                raise ValueError(f"{name} must have shape {list(shape)}, got {list(getattr(self, name).shape)}")
        if (self.voxels.dtype, self.values.dtype) != (torch.int32, torch.uint8):
            raise ValueError(f"voxels must be int32 and values uint8, got {self.voxels.dtype} and {self.values.dtype}")

    @property
    def side(self) -> float:
        """Of a voxel."""
        return float(((self.box[1] - self.box[0]) / self.shape).mean())

    def __call__(self, own: Tensor) -> tuple[Tensor, Tensor]:
        """Colours [n, 3] and densities [n] at positions [n, 3]."""
        numbers = cells_of(own, self.box, torch.Size(self.shape.tolist()))
        at = torch.searchsorted(self.voxels, numbers).clamp(max=len(self.voxels) - 1)
        found = self.values[at].to(own) / 255
        opacity = torch.where(self.voxels[at] == numbers, found[:, 3], 0)
        return found[:, :3], -torch.log1p(-OPAQUE * opacity) / self.side


@torch.no_grad()
def make_coarse(part: Part, side: float, occupied: Callable[[Tensor], Tensor] | None, backend: str) -> Coarse | None:
    """The coarse level of a part; None for one that shows nothing, or has no bounds.

    A voxel's opacity is the mean of eight, so that one half of which is full is half transparent. Its colour is that
    seen along the slope of the density, from outside.

    Args:
        part: In evaluation mode.
        side: Of a voxel in the scene, about; longer where there were more than `MOST_ACROSS`.
        occupied: Which positions [n, 3] of the scene may show something, bool [n]; None for all.
        backend: Of the look-up.
    """
    boxes = [solid.bounds() for solid in part.region if not solid.outside]
    if not boxes or part.contraction is not None:
        return None
    box = torch.stack((torch.stack([b[0] for b in boxes]).amax(0), torch.stack([b[1] for b in boxes]).amin(0)))
    box = box.to(part.owner.device)
    extent = (box[1] - box[0]) * part.frame.scale
    side = max(side, float(extent.max()) / MOST_ACROSS)
    shape = (extent / side).ceil().clamp(1, MOST_ACROSS).long()
    sides = (box[1] - box[0]) / shape
    corners, length = _CORNERS.to(box), float(sides.mean())
    voxels, values = [], []
    for numbers in torch.arange(int(shape.prod()), device=box.device).split(CHUNK):
        place = torch.stack((numbers // (shape[1] * shape[2]), numbers // shape[2] % shape[1], numbers % shape[2]), 1)
        middles = box[0] + (place + 0.5) * sides
        if occupied is not None:
            near = occupied(part.frame.points(middles))
            numbers, middles = numbers[near], middles[near]
        points = (middles[:, None] + corners * sides / 4).reshape(-1, 3)
        leaf, speaks = part.find(points, backend)
        rows = speaks.nonzero()[:, 0]
        if not len(rows):
            continue
        points, leaf, of = points[rows], leaf[rows], (rows // 8).int()

        def opacity_of(density: Tensor) -> Tensor:
            return -torch.expm1(-density.float() * (part.frame.scale * length))

        down = middles.new_tensor([[0.0, 0, -1]])
        _, density = part.evaluate(points, leaf, down, torch.zeros_like(of), backend)
        opacity = density.new_zeros(len(middles), 8).view(-1).index_copy(0, rows, opacity_of(density)).view(-1, 8)
        slope = torch.nn.functional.normalize(opacity @ corners, dim=1)
        slope = part.frame.directions(torch.where(slope.any(1, keepdim=True), slope, down))
        colour, density = part.evaluate(points, leaf, slope, of, backend)
        weight = opacity_of(density)[:, None]
        mixed = colour.new_zeros(len(middles), 4).index_add(0, of.long(), torch.cat((colour * weight, weight), 1))
        mean = torch.cat((mixed[:, :3] / mixed[:, 3:].clamp(min=1e-6), opacity.mean(1, keepdim=True)), 1)
        rounded = (mean.clamp(0, 1) * 255).round().byte()
        seen = rounded[:, 3] > 0
        voxels.append(numbers[seen].int())
        values.append(rounded[seen])
    if not any(map(len, voxels)):
        return None
    return Coarse(box, shape, torch.cat(voxels), torch.cat(values))


def is_far(coarse: Coarse, scale: float, bounds: Tensor, eye: Tensor, pixel: float) -> bool:
    """Whether a voxel is no larger than a pixel, wherever in the part it is.

    Args:
        coarse: The level of a part.
        scale: Of the part in the scene.
        bounds: [2, 3], the box in the scene that the part is in.
        eye: [3], where the scene is seen from.
        pixel: Width of a pixel at distance 1.
    """
    away = torch.maximum(bounds[0] - eye, eye - bounds[1]).clamp(min=0)
    return math.hypot(*away.tolist()) * pixel >= coarse.side * scale
