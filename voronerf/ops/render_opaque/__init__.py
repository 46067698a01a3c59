"""The rendering of rays until they are opaque, with an occupancy grid. r rays, s strata of a ray."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.checks import check_count
from voronerf.ops._core.declare import declare
from voronerf.ops.formulas import RenderedRays
from voronerf.ops.render_loss.reference import scaled
from voronerf.ops.routed_program import check_network

#: The arguments of `routed_program` that belong to the network, rather than to samples or to the backward pass.
NETWORK = ("program", "parameters", "centres", "child_offsets", "child", "depth", "centre_index")


def _prepare(arguments: Any) -> Any:
    op, network, occupied = "render_opaque", arguments.network, arguments.occupied
    check_count(op, "samples of all rays", arguments.near.shape[0] * arguments.samples)
    if occupied.numel() < 1:
        raise ValueError(f"{op}: occupied must have at least one cell, got {list(occupied.shape)}")
    if not isinstance(network, Mapping) or not {"program", "parameters"} <= network.keys():
        got = ", ".join(map(str, network)) or "nothing" if isinstance(network, Mapping) else repr(network)
        raise ValueError(f"{op}: network must hold program and parameters, got {got:.60}")
    if unknown := [name for name in network if name not in NETWORK]:
        raise TypeError(f"{op}: network must hold {', '.join(NETWORK)} alone, got {', '.join(map(str, unknown))}")
    # The check of the network gets one sample per ray, at the ray's origin.
    origins, reads = arguments.origins, bool(getattr(network["program"], "rays", ()))
    index = torch.arange(len(origins), dtype=torch.int32, device=origins.device) if reads else None
    inputs = [origins, arguments.directions] if reads else [origins]
    routed = check_network(op, {**network, "inputs": inputs, "ray_index": index})
    if (dtype := routed.arguments(op).dtype) is torch.float64 and origins.dtype is not dtype:
        raise TypeError(f"{op}: parameters must have dtype {str(origins.dtype)[6:]} or one of 16 bits, got float64")
    if (width := routed.program.outputs[0].width) != 4:
        raise ValueError(f"{op}: program must have outputs of 4 numbers, colour and density, got {width}")
    return scaled(op, arguments._replace(network=routed))


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
    network: Mapping[str, Any],
    *,
    density_scale: Annotated[float | None, "positive"] = None,
    activated: bool = False,
    wave: Annotated[int, "1..1024"] = 8,
    opaque: Annotated[float, "[0, 1)"] = 0.02,
    spacing: Annotated[str, "linear|disparity"] = "linear",
    contraction: Annotated[Tensor | None, "same [4] or [5, 3]"] = None,
    background: Annotated[Tensor | None, "same [3] or [r, 3]"] = None,
    heaviest: bool = True,
    backend: str = "auto",
) -> RenderedRays:
    """Renders rays without gradients or randomness; each ray ends when it is opaque.

    Equivalent to ``march_rays``, ``routed_program``, activations as in ``render_loss``, and ``composite``, on waves of
    a few samples of each ray that is not yet opaque. The networks then evaluate few samples behind the first surface of
    each ray.

    Args:
        origins: the origins of the rays.
        directions: the directions of the rays, unit vectors; the networks may read them.
        near: the start of the first stratum.
        far: the end of the last stratum; a ray with far <= near has no samples.
        occupied: whether each cell of the box is occupied.
        box: the lowest and the highest corner of the grid.
        samples: the number of strata of a ray, s; each sample is the middle of its stratum.
        network: the arguments of `routed_program` by name: ``program`` and ``parameters``; optionally centres,
            child_offsets, child, depth and centre_index. The program's inputs are positions [n, 3] and, if it reads
            them, directions with one row for each ray. It has 4 outputs: colour before its sigmoid and density before
            its softplus or, with ``activated``, the colour and density themselves.
        density_scale: the factor on the density, > 0; None with ``activated``.
        activated: whether the networks' outputs are the colour and the density themselves, as for `composite`. They are
            not clamped.
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
        ValueError: both or neither of ``density_scale`` and ``activated``.

    Examples:
        >>> import torch
        >>> from voronerf import MLP, Layer
        >>> from voronerf.ops import render_opaque
        >>> program = MLP((Layer(("positions",), 4),), outputs=(0,)).program(3, 0, None, (True,))
        >>> parameters = [torch.zeros(1, 4, 3), torch.tensor([[0.0, 0, 0, 20]])]  # grey, density 20
        >>> network = {"program": program, "parameters": parameters}
        >>> ray = torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]), torch.zeros(1), torch.full((1,), 4.0)
        >>> box, occupied = torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), torch.ones(1, 1, 1, dtype=torch.bool)
        >>> seen = render_opaque(*ray, occupied, box, 64, network, density_scale=1.0)
        >>> seen.colour, seen.opacity, seen.depth.round(decimals=2), float(seen.light) < 0.02
        (tensor([[0.5000, 0.5000, 0.5000]]), tensor([1.]), tensor([1.0600]), True)
    """
