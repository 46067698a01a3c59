"""Gaussians that approximate the conical frustums of cones. r rays, s frustums per ray.

A Gaussian has 6 numbers: its mean in world units, and the diagonal of its covariance in squared world units. Source:
Barron et al. 2021, "Mip-NeRF", section 3.1.
"""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.nerf.cameras import Rays
from voronerf.nerf.contraction import Contraction, Perspective


def frustum_moments(edges: Tensor, radii: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the means and variances of conical frustums (equation 7 in its stable form, and equation 8).

    Args:
        edges: [r, s + 1] ascending distances along the ray.
        radii: [r], the radius of each cone at distance 1.

    Returns:
        (mean distance, variance along the ray, variance across the ray), each [r, s].
    """
    middle, half = (edges[:, 1:] + edges[:, :-1]) / 2, edges.diff(dim=1) / 2
    middle2, half2 = middle.square(), half.square()
    # The sum is 0 only for a frustum that is a point at distance 0; all its moments are 0.
    sum2 = (3 * middle2 + half2).clamp_min(torch.finfo(edges.dtype).tiny)
    share = half2 / sum2
    mean = middle + 2 * middle * share
    along = half2 / 3 - (4 / 15) * share.square() * (12 * middle2 - half2)
    across = radii[:, None].square() * (middle2 / 4 + (5 / 12) * half2 - (4 / 15) * half2 * share)
    return mean, along, across


def frustum_gaussians(rays: Rays, edges: Tensor, contraction: Contraction | Perspective | None = None) -> Tensor:
    """Returns the Gaussians [r, s, 6] that have the moments of conical frustums (equations 8 and 16).

    Args:
        rays: r rays with radii.
        edges: [r, s + 1] ascending distances along the rays.
        contraction: The contraction that is applied to the Gaussians; None for none.

    Returns:
        [r, s, 6], means and variances.
    """
    if rays.radii is None:
        raise ValueError("frustum_gaussians: rays must have radii, got none")
    mean, *variances = frustum_moments(edges, rays.radii)
    along, across = (variance[:, :, None] for variance in variances)
    direction = rays.directions[:, None, :]
    means = torch.addcmul(rays.origins[:, None, :], mean[:, :, None], direction)
    if contraction is None:
        # along * d^2 + across * (1 - d^2), for unit directions
        diagonal = torch.addcmul(across, along - across, direction.square())
    else:
        means, diagonal = contraction.gaussians(means, direction, along, across)
    return torch.cat((means, diagonal.clamp_min(0)), dim=-1)
