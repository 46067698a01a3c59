"""The rendering of rays until they are opaque, with an occupancy grid. r rays, s strata of a ray."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.checks import check_count
from voronerf.ops._core.declare import declare
from voronerf.ops._core.program import Names
from voronerf.ops.formulas import RenderedRays
from voronerf.ops.network import Cells, Network

_NAMES = Names("render_opaque")


def _prepare(arguments: Any) -> Any:
    op, occupied, cells = "render_opaque", arguments.occupied, arguments.cells or Cells()
    check_count(op, "samples of all rays", arguments.near.shape[0] * arguments.samples)
    if occupied.numel() < 1:
        raise ValueError(f"{op}: occupied must have at least one cell, got {list(occupied.shape)}")
    if given := [name for name in ("offsets", "cells", "coords", "rows") if getattr(cells, name) is not None]:
        raise ValueError(f"{op}: cells must hold a diagram alone, got {', '.join(given)}")
    # The check of the network gets one sample per ray, at the ray's origin.
    origins, network = arguments.origins, Network(arguments.network.program, arguments.network.parameters, names=_NAMES)
    index = torch.arange(len(origins), dtype=torch.int32, device=origins.device) if network.program.rays else None
    network.check([origins, arguments.directions][: len(network.program.inputs)], cells, index)
    parameters, program = network.parameters, network.program
    dtype = parameters[program.first_layer].dtype if program.first_layer >= 0 else origins.dtype
    if dtype is torch.float64 and origins.dtype is not dtype:
        raise TypeError(f"{op}: parameters must have dtype {str(origins.dtype)[6:]} or one of 16 bits, got float64")
    if (widths := [columns.width for columns in program.outputs]) != [4]:
        raise ValueError(f"{op}: program must have one output of 4 numbers, colour and density, got {widths}")
    return arguments._replace(network=network, cells=cells)


@declare(
    native=Implementation(("cpu",), (torch.float32,)), warp=PLAIN, small=["occupied"], prepare=_prepare, composed=True
)
def render_opaque(
    origins: Annotated[Tensor, "float32|float64 [r, 3]"],
    directions: Annotated[Tensor, "same [r, 3]"],
    near: Annotated[Tensor, "same [r]"],
    far: Annotated[Tensor, "same [r]"],
    occupied: Annotated[Tensor, "bool [x, y, z]"],
    box: Annotated[Tensor, "same [2, 3]"],
    samples: Annotated[int, "1..65535"],
    network: Network,
    *,
    cells: Cells | None = None,
    wave: Annotated[int, "1..1024"] = 8,
    opaque: Annotated[float, "[0, 1)"] = 0.02,
    spacing: Annotated[str, "linear|disparity"] = "linear",
    contraction: Annotated[Tensor | None, "same [4] or [5, 3]"] = None,
    background: Annotated[Tensor | None, "same [3] or [r, 3]"] = None,
    heaviest: bool = True,
    backend: str = "auto",
) -> RenderedRays:
    """Renders rays without gradients or randomness; each ray ends when it is opaque.

    Equivalent to ``march_rays``, a call of the network and ``composite``, on waves of a few samples of each ray that is
    not yet opaque. The networks then evaluate few samples behind the first surface of each ray.

    Args:
        origins: the origins of the rays.
        directions: the directions of the rays, unit vectors; the networks may read them.
        near: the start of the first stratum.
        far: the end of the last stratum; a ray with far <= near has no samples.
        occupied: whether each voxel of the box is occupied.
        box: the lowest and the highest corner of the grid.
        samples: the number of strata of a ray, s; each sample is the middle of its stratum.
        network: the networks. The program's inputs are positions [n, 3] and, if it reads them, directions with one row
            for each ray. Its output has 4 columns, colour and density, as for `composite`; they are not clamped.
        cells: the diagram of the cells; None for one cell.
        wave: the number of samples of a ray that are evaluated at a time, 1 to 1,024.
        opaque: a ray ends after a wave if at most this fraction of the light remains, in [0, 1).
        spacing: the spacing of the strata, "linear" or "disparity".
        contraction: the contraction of the grid's space, as in ``march_rays``.
        background: the colour behind everything; None is black.
        heaviest: whether to find the sample with the largest weight on each ray; if not, the result's ``heaviest`` is
            the far end.

    Returns:
        RenderedRays(colour [r, 3], opacity [r], depth [r], light [r], heaviest [r]).

    Raises:
        ValueError: ``cells`` hold offsets, labels, coordinates or a number of rows; or the program has other outputs.

    Examples:
        >>> import torch
        >>> from voronerf import MLP, Layer
        >>> from voronerf.ops import Network, render_opaque
        >>> program = MLP((Layer(("positions",), 4),), outputs=(0,)).program(3, 0, None, (True,))
        >>> parameters = [torch.zeros(1, 4, 3), torch.tensor([[0.5, 0.5, 0.5, 20]])]  # grey, density 20
        >>> network = Network(program, parameters)
        >>> ray = torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]), torch.zeros(1), torch.full((1,), 4.0)
        >>> box, occupied = torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), torch.ones(1, 1, 1, dtype=torch.bool)
        >>> seen = render_opaque(*ray, occupied, box, 64, network)
        >>> seen.colour, seen.opacity, seen.depth.round(decimals=2), float(seen.light) < 0.02
        (tensor([[0.5000, 0.5000, 0.5000]]), tensor([1.]), tensor([1.0600]), True)
    """
