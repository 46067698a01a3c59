"""The update of an occupancy grid from rendered samples. x, y, z voxels along each axis, m samples."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, Implementation
from voronerf.ops._core.declare import declare


def _prepare(arguments: Any) -> Any:
    if arguments.density.numel() < 1:
        raise ValueError(f"observe_occupancy: density must have at least one cell, got {list(arguments.density.shape)}")
    if (arguments.deltas is None) != (arguments.weights is None):
        missing = "deltas" if arguments.deltas is None else "weights"
        raise ValueError(f"observe_occupancy: deltas and weights must be given together, got no {missing}")
    return arguments


@declare(
    native=Implementation(EVERYWHERE, (torch.float32,)),
    warp=Implementation(EVERYWHERE, (torch.float32,)),
    small=["density"],
    writes=["density", "occupied"],
    prepare=_prepare,
)
def observe_occupancy(
    density: Annotated[Tensor, "float32 [x, y, z]"],
    occupied: Annotated[Tensor, "bool [x, y, z]"],
    box: Annotated[Tensor, "same [2, 3]"],
    positions: Annotated[Tensor, "same [m, 3]"],
    sigma: Annotated[Tensor, "same [m]"],
    deltas: Annotated[Tensor | None, "same [m]"] = None,
    weights: Annotated[Tensor | None, "same [m]"] = None,
    *,
    decay: Annotated[float, "0 to 1"],
    threshold: float,
    hidden: float,
    contraction: Annotated[Tensor | None, "same [4] or [5, 3]"] = None,
    fixed: Annotated[Tensor | None, "bool [x, y, z]"] = None,
    backend: str = "auto",
) -> None:
    """Updates the voxels of an occupancy grid that contain rendered samples, in place.

    The new density of a voxel with samples is the maximum of two values: ``decay`` times its old density, and the
    largest density of its samples (Mueller et al. 2022, appendix C). If at most the fraction ``hidden`` of the light
    reaches a sample (``weights <= hidden * (1 - exp(-sigma * deltas))``), its density counts as 0. Voxels
    without samples keep their density. Not differentiable.

    With a ``contraction``, the grid, its box and the positions are in contracted space, ``sigma`` and ``deltas`` in
    world space. The density of a voxel is then per unit of contracted length along rays from the centre of the sphere
    or of the camera.

    Args:
        density: the density of each voxel, >= 0, contiguous.
        occupied: whether the density of each voxel is at least ``threshold``; contiguous.
        box: the lowest and the highest corner.
        positions: the positions of the samples; a position outside the box is clamped to it.
        sigma: the densities of the samples; NaN counts as infinite.
        deltas: the lengths of the samples' strata; a sample of length 0 is ignored. None if all light reaches every
            sample.
        weights: the rendering weights of the samples; None if ``deltas`` is None.
        decay: the factor on the old density, 0 to 1.
        threshold: the density from which a voxel counts as occupied.
        hidden: the transmittance, 0 to 1, up to which the density of a sample counts as 0.
        contraction: the contraction of the grid's space, as for ``march_rays``.
        fixed: whether each voxel keeps its values; None to update all voxels.

    Raises:
        ValueError: a grid that is not contiguous; ``deltas`` without ``weights``, or the reverse.

    Examples:
        >>> import torch
        >>> from voronerf.ops import observe_occupancy
        >>> density, occupied = torch.full((3, 1, 1), 4.0), torch.ones(3, 1, 1, dtype=torch.bool)
        >>> box = torch.tensor([[0.0, 0, 0], [3.0, 1, 1]])
        >>> positions = torch.tensor([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5]])  # in the first two voxels
        >>> samples = positions, torch.tensor([0.0, 9.0]), torch.ones(2), torch.tensor([0.0, 1.0])
        >>> observe_occupancy(density, occupied, box, *samples, decay=0.5, threshold=3.0, hidden=1e-3)
        >>> density.flatten(), occupied.flatten()
        (tensor([2., 9., 4.]), tensor([False,  True,  True]))
    """
