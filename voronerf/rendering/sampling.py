"""Where along its ray a field is asked. r rays, s samples a ray; distances in world units."""

from __future__ import annotations

import torch
from torch import Tensor

SPACINGS = ("linear", "disparity")


def stratified_depths(
    near: Tensor,
    far: Tensor,
    samples: int,
    *,
    jitter: bool,
    spacing: str = "linear",
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """One sample in each of s strata of [near, far] (Mildenhall et al. 2020, NeRF, eq. 2).

    Args:
        near: [r]; positive where spacing is "disparity". That is not checked, which would make the host wait for the
            device; a ray with near == 0 gets finite depths there, all but the far end at 0.
        far: [r], >= near.
        samples: s, >= 1.
        jitter: uniformly random inside each stratum, else in its middle (the middle in disparity, where that is the
            spacing).
        spacing: "linear": strata of equal length; "disparity": equal steps of 1 / distance, dense near the camera, for
            scenes with a far background.
        generator: of the jitter, on any device: what it draws is moved to the rays'.

    Returns:
        (depths [r, s] ascending, deltas [r, s], edges [r, s + 1]). A sample stands for its whole stratum: deltas are
        the widths of the strata, and sum to far - near.

    Raises:
        ValueError: shapes, an unknown spacing, no samples.
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
    edges = _spaced(near[:, None], far[:, None], steps[None, :], spacing)
    if jitter:
        device = near.device if generator is None else generator.device
        inside = torch.rand(len(near), samples, device=device, dtype=near.dtype, generator=generator).to(near.device)
    else:
        inside = torch.full((1, samples), 0.5, device=near.device, dtype=near.dtype)
    fractions = (torch.arange(samples, device=near.device, dtype=near.dtype) + inside) / samples
    depths = _spaced(near[:, None], far[:, None], fractions, spacing)
    # rounding may put a sample a last bit outside its stratum
    depths = torch.minimum(torch.maximum(depths, edges[:, :-1]), edges[:, 1:])
    return depths, edges.diff(dim=-1), edges


def _spaced(near: Tensor, far: Tensor, fraction: Tensor, spacing: str) -> Tensor:
    """Distance at a fraction of the way, exact at both ends."""
    if spacing == "linear":
        return torch.lerp(near, far, fraction)
    # 1 / lerp(1 / near, 1 / far), without the two roundings of the reciprocals, and without 0 / 0 where near is 0
    disparity = far * (1 - fraction) + near * fraction
    return torch.where(fraction < 1, near * far / disparity.clamp_min(torch.finfo(near.dtype).tiny), far)
