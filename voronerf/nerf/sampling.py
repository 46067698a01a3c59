"""Depths of samples along rays, and the loss of colours. r rays, s samples per ray; distances in world units."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops.formulas import SPACINGS, depth_of
from voronerf.ops.resample import resample

#: The constant that `blurred_weights` adds to the weight of every interval (mip-NeRF, equation 18).
PADDING = 0.01


def stratified_depths(
    near: Tensor,
    far: Tensor,
    samples: int,
    *,
    jitter: bool,
    spacing: str = "linear",
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns one sample in each of s strata of [near, far] (Mildenhall et al. 2020, NeRF, eq. 2).

    Args:
        near: [r], the start of each ray; must be positive for "disparity". This is not checked, because the host would
            have to wait for the device. With "disparity", a ray with near == 0 gets depths of 0 except for the far end.
        far: [r], the end of each ray, >= near.
        samples: s, >= 1.
        jitter: Whether each sample is uniformly random in its stratum, instead of in the middle (for "disparity", the
            middle in disparity).
        spacing: "linear" for strata of equal length, or "disparity" for equal steps of 1 / distance, which are dense
            near the camera and suit scenes with a far background.
        generator: Random generator of the jitter, on any device; its numbers are moved to the device of the rays.

    Returns:
        (depths [r, s] ascending, deltas [r, s], edges [r, s + 1]). Deltas are the widths of the strata, and sum to
        far - near.

    Raises:
        ValueError: A shape is wrong, the spacing is unknown, or ``samples`` is below 1.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import stratified_depths
        >>> depths, deltas, edges = stratified_depths(torch.tensor([1.0]), torch.tensor([3.0]), 4, jitter=False)
        >>> depths, edges
        (tensor([[1.2500, 1.7500, 2.2500, 2.7500]]), tensor([[1.0000, 1.5000, 2.0000, 2.5000, 3.0000]]))
    """
    if near.dim() != 1 or near.shape != far.shape:
        raise ValueError(
            "stratified_depths: near and far must have the same shape [r], "
            f"got {list(near.shape)} and {list(far.shape)}"
        )
    if samples < 1:
        raise ValueError(f"stratified_depths: samples must be >= 1, got {samples}")
    if spacing not in SPACINGS:
        raise ValueError(f"stratified_depths: spacing must be one of {', '.join(SPACINGS)}, got {spacing!r}")

    steps = torch.arange(samples + 1, device=near.device, dtype=near.dtype) / samples
    edges = _distance_at(near[:, None], far[:, None], steps[None, :], spacing)
    inside = random_uniforms(len(near), samples, near, generator) if jitter else near.new_full((1, samples), 0.5)
    fractions = (torch.arange(samples, device=near.device, dtype=near.dtype) + inside) / samples
    depths = _distance_at(near[:, None], far[:, None], fractions, spacing)
    # Rounding may put a sample one bit outside its stratum.
    depths = torch.minimum(torch.maximum(depths, edges[:, :-1]), edges[:, 1:])
    return depths, edges.diff(dim=-1), edges


def stratified_edges(
    near: Tensor,
    far: Tensor,
    samples: int,
    *,
    jitter: bool,
    spacing: str = "linear",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Returns the ends of s intervals that cover [near, far], for cones.

    Args:
        near: [r], the start of each ray, as for `stratified_depths`.
        far: [r], the end of each ray.
        samples: s, >= 1.
        jitter: Whether each inner edge is uniformly random between the middles of its two strata, instead of evenly
            spaced.
        spacing: "linear" or "disparity".
        generator: Random generator of the jitter, on any device.

    Returns:
        [r, s + 1] ascending, from near to far.
    """
    edges = stratified_depths(near, far, samples, jitter=False, spacing=spacing)[2]
    if not jitter:
        return edges
    shift = random_uniforms(len(near), samples - 1, near, generator)
    steps = (torch.arange(1, samples, device=near.device, dtype=near.dtype) - 0.5 + shift) / samples
    inner = _distance_at(near[:, None], far[:, None], steps, spacing)
    return torch.cat((edges[:, :1], inner, edges[:, -1:]), dim=1)


def random_uniforms(rows: int, columns: int, like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Returns random numbers [rows, columns] in 0..1, drawn on the generator's device and moved to `like.device`."""
    device = like.device if generator is None else generator.device
    return torch.rand(rows, columns, device=device, dtype=like.dtype, generator=generator).to(like.device)


def strata_uniforms(
    rays: int, count: int, like: Tensor, jitter: bool, generator: torch.Generator | None
) -> Tensor | None:
    """Returns random numbers [r, count] in 0..1, one in each of `count` strata; None without jitter (the middles).

    The numbers cover 0..1 more evenly than independent numbers, with the same distribution.
    """
    if not jitter:
        return None
    drawn = random_uniforms(rays, count, like, generator)
    return (torch.arange(count, device=like.device, dtype=like.dtype) + drawn) / count


def blurred_weights(weights: Tensor) -> Tensor:
    """Returns weights [r, s] to draw from: blurred maxima of two neighbours, plus a constant (mip-NeRF, equation 18).

    The results are upper bounds of the weights, with wider peaks, so that a second pass also samples beside a surface.
    """
    wide = torch.nn.functional.pad(weights[:, None, :], (1, 1), mode="replicate")[:, 0]
    largest = torch.maximum(wide[:, :-1], wide[:, 1:])
    return (largest[:, :-1] + largest[:, 1:]) / 2 + PADDING


def union_depths(
    depths: Tensor, edges: Tensor, weights: Tensor, count: int, *, uniforms: Tensor | None = None, backend: str = "auto"
) -> tuple[Tensor, Tensor]:
    """Returns the samples of a first pass, and new samples drawn from its distribution of weights (NeRF, section 5.2).

    Args:
        depths: [r, s], the depths of the first pass.
        edges: [r, s + 1], the edges of its strata.
        weights: [r, s], the weights of its samples.
        count: f, the number of new samples.
        uniforms: [r, f], random numbers from `strata_uniforms`; None for the middles of strata of equal weight.
        backend: The backend of the op.

    Returns:
        (depths [r, s + f] ascending, edges [r, s + f + 1]). The edges lie halfway between neighbouring samples.
    """
    drawn = resample(weights, edges, count, uniforms=uniforms, backend=backend)
    merged = torch.cat((depths, drawn), dim=1).sort(dim=1).values
    return merged, torch.cat((edges[:, :1], (merged[:, 1:] + merged[:, :-1]) / 2, edges[:, -1:]), dim=1)


def colour_loss(colour: Tensor, target: Tensor) -> Tensor:
    """Returns the mean squared error of colours [r, 3] (NeRF, equation 6)."""
    return (colour - target).square().mean()


def _distance_at(near: Tensor, far: Tensor, fraction: Tensor, spacing: str) -> Tensor:
    """Returns the distance at a fraction of the way from near to far, exact at both ends."""
    if spacing == "linear":
        return torch.lerp(near, far, fraction)
    return torch.where(fraction < 1, depth_of(near, far, fraction, spacing), far)
