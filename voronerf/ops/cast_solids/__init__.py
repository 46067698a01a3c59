"""First hits of rays on spheres, boxes, cylinders and tori. r rays, s solids."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import backends
from voronerf.backends import EVERYWHERE, Implementation
from voronerf.checks import INDEX, LIKE_FIRST, Checked

_OP = backends.declare(
    "cast_solids",
    warp=Implementation(EVERYWHERE, (torch.float32,)),
)


def cast_solids(
    kinds: Tensor, frames: Tensor, sizes: Tensor, origins: Tensor, directions: Tensor, *, backend: str = "auto"
) -> tuple[Tensor, Tensor]:
    """The first solid on each ray, for ground truth computed from formulas.

    A ray that starts inside a solid, or inside the bounding box of a torus, does not see that solid. Not
    differentiable.

    Args:
        kinds: int32 [s], 0 sphere, 1 box, 2 cylinder around z with flat ends, 3 torus around z; not checked.
        frames: float32 [s, 4, 3]: a rotation M in the first three rows, the solid's centre in the last. A point p of
            the world is (p - centre) @ M in the solid's own frame.
        sizes: float32 [s, 3], positive: a sphere's radius; a box's half sides; a cylinder's radius and half height; a
            torus' radius of the ring and of the tube. Unused entries are ignored.
        origins: float32 [r, 3].
        directions: float32 [r, 3], unit.
        backend: "auto", "reference" or "warp". Warp searches a tree of bounding boxes, so it is faster for many solids,
            on the CPU too, where it uses one thread.

    Returns:
        (depths float32 [r], infinite for a ray that hits nothing; solids int32 [r], -1 for such a ray). If several
        solids are hit at the same distance, the first counts.

    Examples:
        >>> import torch
        >>> from voronerf.ops import cast_solids
        >>> kinds = torch.tensor([0], dtype=torch.int32)  # a sphere
        >>> frames = torch.cat([torch.eye(3), torch.zeros(1, 3)])[None]
        >>> sizes = torch.ones(1, 3)
        >>> origins = torch.tensor([[0.0, 0, 5], [3.0, 0, 5]])
        >>> directions = torch.tensor([[0.0, 0, -1], [0.0, 0, -1]])
        >>> cast_solids(kinds, frames, sizes, origins, directions)
        (tensor([4., inf]), tensor([ 0, -1], dtype=torch.int32))
    """
    given = Checked(_OP)
    given.tensor("kinds", kinds, INDEX, "s")
    given.tensor("frames", frames, (torch.float32,), "s", 4, 3)
    given.tensor("sizes", sizes, LIKE_FIRST, "s", 3)
    given.tensor("origins", origins, LIKE_FIRST, "r", 3)
    given.tensor("directions", directions, LIKE_FIRST, "r", 3)
    run = backends.resolve(_OP, backend=backend, device=origins.device, dtype=origins.dtype)
    depths, solids = run(kinds, *(tensor.detach() for tensor in (frames, sizes, origins, directions)))
    return depths, solids
