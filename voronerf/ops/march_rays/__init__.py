"""Ray marching through an occupancy grid. r rays, s strata of a ray, m samples of all rays (packed)."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, Implementation
from voronerf.ops._core.checks import check_count
from voronerf.ops._core.declare import declare
from voronerf.ops.march_rays.reference import March


def _prepare(arguments: Any) -> Any:
    if arguments.seed is not None and arguments.uniforms is not None:
        raise ValueError("march_rays: seed must be None where uniforms are given, got both")
    check_count("march_rays", "samples of all rays", arguments.origins.shape[0] * arguments.samples)
    if arguments.occupied.numel() < 1:
        raise ValueError(f"march_rays: occupied must have at least one cell, got {list(arguments.occupied.shape)}")
    return arguments


@declare(
    native=Implementation(EVERYWHERE, (torch.float32,)),
    warp=Implementation(EVERYWHERE, (torch.float32,)),
    small=["occupied"],
    prepare=_prepare,
)
def march_rays(
    origins: Annotated[Tensor, "float32|float64 [r, 3]"],
    directions: Annotated[Tensor, "same [r, 3]"],
    near: Annotated[Tensor, "same [r]"],
    far: Annotated[Tensor, "same [r]"],
    occupied: Annotated[Tensor, "bool [x, y, z]"],
    box: Annotated[Tensor, "same [2, 3]"],
    samples: Annotated[int, "1..65535"],
    *,
    uniforms: Annotated[Tensor | None, "same [r, samples]"] = None,
    seed: Annotated[Tensor | None, "int32 [1]"] = None,
    spacing: Annotated[str, "linear|disparity"] = "linear",
    start: Annotated[Tensor | None, "int32 [r]"] = None,
    max_samples: Annotated[int | None, "1.."] = None,
    capacity: Annotated[int | None, "1..134217728"] = None,
    contraction: Annotated[Tensor | None, "same [4] or [5, 3]"] = None,
    backend: str = "auto",
) -> March:
    """Samples rays in strata, skips the empty voxels of an occupancy grid, and packs the samples for ``composite``.

    Each ray is cut into ``samples`` strata between its near and its far end, with one sample in each, as in
    ``voronerf.nerf.sampling.stratified_depths``. A sample is kept if its voxel of the grid is occupied. Space
    outside the box is empty. If every voxel is occupied, all stratified samples in the box are kept.

    With a ``contraction``, rays and distances are in world space; the grid, its box and the positions are in contracted
    space (Barron et al. 2022, "Mip-NeRF 360", equation 10; or Mildenhall et al. 2020, "NeRF", appendix C).

    To stop at opaque surfaces, march in pieces: limit each call to ``max_samples`` per ray, and pass the ``stop`` of
    its result as ``start`` to the next call.

    The number of samples depends on values on the device. Without ``capacity`` the host waits for this number. With
    ``capacity`` the result has that many rows: rows beyond ``ray_offsets[r]`` belong to no ray and are 0, and rays that
    do not fit are cut off at their ``stop``. This form can be captured in a CUDA graph and compiled. Not
    differentiable.

    Args:
        origins: the origins of the rays.
        directions: the directions of the rays, unit vectors.
        near: the start of the first stratum.
        far: the end of the last stratum; a ray with far <= near has no samples.
        occupied: whether each voxel of the box is occupied; x, y, z >= 1.
        box: the lowest and the highest corner of the grid.
        samples: the number of strata of a ray, s, 1 to 65,535.
        uniforms: the relative position of each sample in its stratum, 0 to 1; None for the middle.
        seed: a seed instead of ``uniforms``. The uniforms are then hashes of seed, ray and stratum, the same on every
            backend.
        spacing: the spacing of the strata, "linear" or "disparity" (equal steps of 1 / distance).
        start: the first stratum to consider, >= 0; None for 0.
        max_samples: the largest number of samples of a ray, at least 1; None for all.
        capacity: the number of rows of the result, at least 1; None for the number of samples.
        contraction: [4], the centre and radius of the sphere of a ``voronerf.nerf.Contraction``; or [5, 3], the rows of
            a ``voronerf.nerf.Perspective``: the camera's centre, its right, up and forward axes, and (depth of the near
            plane, half the width and half the height of the view at depth 1). None for a grid in world space.

    Returns:
        March(ray_offsets, ray_index, depths, deltas, positions, stop). Depths, deltas and positions have the dtype of
        the floating-point arguments, which share one dtype.

    Examples:
        >>> import torch
        >>> from voronerf import march_rays
        >>> origins, directions = torch.tensor([[-1.0, 0.5, 0.5]]), torch.tensor([[1.0, 0.0, 0.0]])
        >>> near, far = torch.zeros(1), torch.tensor([4.0])
        >>> occupied = torch.tensor([False, True]).reshape(2, 1, 1)  # the second half of the box
        >>> box = torch.tensor([[0.0, 0, 0], [2.0, 1, 1]])
        >>> march = march_rays(origins, directions, near, far, occupied, box, 8)
        >>> march.depths  # two of eight strata
        tensor([2.2500, 2.7500])
        >>> march.ray_offsets
        tensor([0, 2], dtype=torch.int32)
    """
