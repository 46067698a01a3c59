"""What rays of a picture see through an occupancy grid. r rays, s strata of a ray."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import Implementation
from voronerf.ops._core.checks import (
    LIKE_FIRST,
    Checked,
    check_choice,
    check_count,
    check_flag,
    check_integer,
    check_number,
    check_positive,
    detached,
)
from voronerf.ops._core.declare import declared
from voronerf.ops.composite import composite
from voronerf.ops.march_rays.reference import March
from voronerf.ops.render_opaque.reference import Operations, RaySums, Rule
from voronerf.ops.routed_mlp import check_routed, routed_mlp

_OP = backends.declare("render_opaque", native=Implementation(("cpu",), (torch.float32,)))
#: Names of the arguments of `routed_mlp` that a network has; the others are of the samples, or of the backward pass.
NETWORK = ("weights", "biases", "layers", "features", "centres", "child_offsets", "child", "depth")
_MOST_WAVE = 1024


def render_opaque(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    occupied: Tensor,
    box: Tensor,
    samples: int,
    network: Mapping[str, Any],
    *,
    density_scale: float,
    wave: int = 8,
    opaque: float = 0.02,
    spacing: str = "linear",
    contraction: Tensor | None = None,
    heaviest: bool = True,
    backend: str = "auto",
) -> RaySums:
    """Renders rays without gradients and without randomness: each is walked until it is opaque.

    Equivalent to ``march_rays``, ``routed_mlp``, the activations of ``render_loss`` and ``composite`` for a few samples
    of each ray at a time, of all rays that are not opaque yet. So the networks are asked about little more than what
    lies in front of the first surface of each ray.

    Args:
        origins: float32 or float64 [r, 3].
        directions: [r, 3], unit vectors, which the layers may read, too.
        near: [r], as in ``march_rays``.
        far: [r].
        occupied: bool [x, y, z], as in ``march_rays``.
        box: [2, 3].
        samples: strata of a ray, s; samples are their middles.
        network: Arguments of `routed_mlp` by name: weights, biases and layers, and where there are any, features,
            centres, child_offsets, child and depth. The networks put out 4 numbers, colour before its sigmoid and
            density before its softplus.
        density_scale: factor on the density, > 0.
        wave: samples of a ray that are evaluated at a time, 1 to 1,024.
        opaque: a ray ends with a wave behind which no more than this share of the light is left, in [0, 1).
        spacing: of the strata, "linear" or "disparity".
        contraction: as in ``march_rays``, or None.
        heaviest: whether to find the heaviest sample of each ray; else ``heaviest`` is the far end.
        backend: "auto", "reference" or "native".

    Returns:
        RaySums(colour [r, 3], opacity [r], depth [r], light [r], heaviest [r]), sums without a background.

    Examples:
        >>> import torch
        >>> from voronerf import MLP, Layer
        >>> from voronerf.ops import render_opaque
        >>> weights, biases = [torch.zeros(1, 4, 3)], [torch.tensor([[0.0, 0, 0, 20]])]  # grey, and 20 dense
        >>> network = {"weights": weights, "biases": biases, "layers": MLP((Layer(("positions",), 4),), outputs=(0,))}
        >>> ray = torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]), torch.zeros(1), torch.full((1,), 4.0)
        >>> box, occupied = torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), torch.ones(1, 1, 1, dtype=torch.bool)
        >>> seen = render_opaque(*ray, occupied, box, 64, network, density_scale=1.0)
        >>> seen.colour.round(decimals=2), (seen.depth / seen.opacity).round(decimals=2), float(seen.light) < 0.02
        (tensor([[0.5000, 0.5000, 0.5000]]), tensor([1.0600]), True)
    """
    check_integer(_OP, "samples", samples, 1, 65_535)
    check_integer(_OP, "wave", wave, 1, _MOST_WAVE)
    given = Checked(_OP)
    given.tensor("origins", origins, (torch.float32, torch.float64), "r", 3)
    given.tensor("directions", directions, LIKE_FIRST, "r", 3)
    given.tensor("near", near, LIKE_FIRST, "r")
    given.tensor("far", far, LIKE_FIRST, "r")
    given.tensor("occupied", occupied, (torch.bool,), "x", "y", "z")
    given.tensor("box", box, LIKE_FIRST, 2, 3)
    sphere = isinstance(contraction, Tensor) and contraction.dim() == 1
    given.optional("contraction", contraction, LIKE_FIRST, *((4,) if sphere else (5, 3)))
    check_choice(_OP, "spacing", spacing, ("linear", "disparity"))
    check_flag(_OP, "heaviest", heaviest)
    check_positive(_OP, "density_scale", density_scale)
    check_number(_OP, "opaque", opaque)
    if not 0 <= opaque < 1:
        raise ValueError(f"{_OP}: opaque must be 0 or more and below 1, got {opaque}")
    check_count(_OP, "occupied", occupied.numel())
    check_count(_OP, "samples of all rays", len(near) * samples)
    if occupied.numel() < 1:
        raise ValueError(f"{_OP}: occupied must have at least one cell, got {list(occupied.shape)}")
    if not isinstance(network, Mapping) or not {"weights", "biases", "layers"} <= network.keys():
        raise ValueError(f"{_OP}: network must hold weights, biases and layers, got {network!r:.60}")
    if unknown := [name for name in network if name not in NETWORK]:
        raise TypeError(f"{_OP}: network must hold {', '.join(NETWORK)} alone, got {', '.join(unknown)}")
    reads = getattr(network["layers"], "uses_directions", False)
    table = check_routed(_OP, origins, **network, directions=directions if reads else None)
    table.pop("frozen")
    outputs = sum(table["weights"][output].shape[1] for output in table["layers"].outputs)
    if outputs != 4:
        raise ValueError(f"{_OP}: layers must put out 4 numbers, colour and density, got {outputs}")
    device = origins.device
    run = backends.resolve(_OP, backend=backend, device=device, dtype=origins.dtype)
    if backend == "auto" and backends.chosen(_OP, device, origins.dtype) == "reference":
        run = functools.partial(run, operations=_operations(device, origins.dtype))
    rays = declared("march_rays").Inputs(
        origins=detached(origins),
        directions=detached(directions),
        near=detached(near),
        far=detached(far),
        occupied=occupied,
        box=detached(box),
        samples=samples,
        uniforms=None,
        seed=None,
        spacing=spacing,
        start=None,
        most=None,
        capacity=None,
        contraction=detached(contraction),
    )
    found = run(rays, table, Rule(density_scale, opaque, wave, heaviest))
    return RaySums(*found)


def _operations(device: torch.device, dtype: torch.dtype) -> Operations:
    """Each operation on the backend that "auto" gives it."""
    march = backends.resolve("march_rays", backend="auto", device=device, dtype=dtype)
    return Operations(lambda *rays: March(*march(*rays)), routed_mlp, composite)
