"""Losses along rays, with their gradients with respect to weights and densities. r rays, m samples of all rays."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from voronerf.ops.composite.reference import check_ray_offsets, ray_spans, ray_sums, saveable, sums_in_front
from voronerf.ops.render_loss.reference import robust_error

#: The largest distance of a sparse model's point from the surface, relative to the point's distance from the camera.
NEARBY = 0.03
#: The scale of the robust error of disparities. For larger log ratios, which occur at edges of surfaces, the loss is
#: linear.
EDGE = 0.05


def sparse_depth(weights: Tensor, depths: Tensor, deltas: Tensor, ray_offsets: Tensor, distances: Tensor) -> Tensor:
    """Returns the mean [] of the losses of ``voronerf.ops.sparse_depth_loss``, differentiable in the weights."""
    ray, *_ = ray_spans(ray_offsets[: len(distances) + 1], len(weights))
    points = pad(distances, (1, 1), value=torch.nan)
    near = (depths - points[ray]).abs() <= NEARBY * points[ray] + deltas
    light = ray_sums(torch.where(near, weights, 0), ray, ray_offsets[: len(distances) + 1])
    return -torch.log(light.clamp_min(1e-3)).sum() / max(len(distances), 1)


def smooth_depth(weights: Tensor, depths: Tensor, ray_offsets: Tensor, far: Tensor, triples: int) -> Tensor:
    """Returns the mean [] of the losses of ``voronerf.ops.smooth_depth_loss``, differentiable in the weights."""
    ray, *_ = ray_spans(ray_offsets, len(weights))
    disparity, opacity = ray_sums(torch.stack((weights / depths, weights), dim=1), ray, ray_offsets).T
    middle, one, other = (disparity + (1 - opacity) / far)[len(far) - 3 * triples :].view(3, triples)
    bent = ((one + other) / (2 * middle)).log()
    return robust_error(bent.square(), EDGE).mean() if triples else bent.sum()


def surface(
    weights: Tensor,
    opacities: Tensor,
    depths: Tensor,
    deltas: Tensor,
    spans: tuple[Tensor, Tensor, Tensor],
    lit: Tensor,
    near: Tensor,
    far: Tensor,
    factors: tuple[float, float],
) -> Tensor:
    """Returns the losses of ``voronerf.ops.surface_loss`` [], differentiable in weights and opacities [m].

    Args:
        weights: the weights of the samples, zero if not ``lit``.
        opacities: the opacities of the samples, zero if not ``lit``.
        depths: the depths of the samples, finite.
        deltas: the lengths of the samples, finite.
        spans: the result of `ray_spans`.
        lit: bool [m], whether the samples count.
        near: the near ends of the rays.
        far: the far ends of the rays.
        factors: distortion and orientation.
    """
    ray, first, last = spans
    scale = pad(1 / (1 / near - 1 / far), (1, 1))[ray]
    places, lengths = scale / depths, scale * deltas / depths.square()
    before, moment = (sums_in_front(values, first, last) for values in (weights, weights * places))
    spread = 2 * weights * (moment - before * places) + weights.square() * lengths / 3
    beside = lit[1:] & (ray[1:] == ray[:-1]) & (depths.diff() < deltas[1:] + deltas[:-1])
    falls = pad(torch.where(beside, -opacities.diff(), 0).clamp_min(0), (0, 1))[: len(weights)]
    losses = torch.where(lit, factors[0] * spread + factors[1] * weights * falls.square(), 0)
    return losses.sum().to(weights.dtype) / max(len(near), 1)


@torch.inference_mode(False)
@torch.enable_grad()
def sparse_depth_loss(loss: Tensor, of_weights: Tensor, *arguments: Any) -> None:
    """Adds the loss and its gradient; see ``voronerf.ops.sparse_depth_loss``."""
    depths, deltas, weights, ray_offsets, distances, factor = map(saveable, arguments)
    check_ray_offsets("sparse_depth_loss", ray_offsets, len(depths))
    weights = weights.detach().requires_grad_()
    added = factor * sparse_depth(weights, depths, deltas, ray_offsets, distances)
    _add(loss, of_weights, added, weights)


@torch.inference_mode(False)
@torch.enable_grad()
def smooth_depth_loss(loss: Tensor, of_weights: Tensor, *arguments: Any) -> None:
    """Adds the loss and its gradient; see ``voronerf.ops.smooth_depth_loss``."""
    depths, weights, ray_offsets, far, triples, factor = map(saveable, arguments)
    check_ray_offsets("smooth_depth_loss", ray_offsets, len(depths))
    weights = weights.detach().requires_grad_()
    _add(loss, of_weights, factor * smooth_depth(weights, depths, ray_offsets, far, triples), weights)


@torch.inference_mode(False)
@torch.enable_grad()
def surface_loss(loss: Tensor, of_weights: Tensor, of_density: Tensor, *arguments: Any) -> None:
    """Adds the loss and its gradients; see ``voronerf.ops.surface_loss``."""
    depths, deltas, weights, ray_offsets, near, far, distortion, orientation, hidden = map(saveable, arguments)
    check_ray_offsets("surface_loss", ray_offsets, len(depths))
    ray, first, last = spans = ray_spans(ray_offsets, len(depths))
    # Samples outside all rays may be uninitialised memory: the unused rows of a batch with a fixed number of rows.
    inside = (ray > 0) & (ray <= len(near))
    weights, deltas = (torch.where(inside, values.detach(), 0) for values in (weights, deltas))
    depths = torch.where(inside, depths, 1)
    light = 1 - sums_in_front(weights, first, last)
    lit = inside & ~(light <= hidden)
    weights = torch.where(lit, weights, 0).requires_grad_()
    opacities = torch.where(lit, weights / light, 0).to(weights.dtype).detach().requires_grad_()
    added = surface(weights, opacities, depths, deltas, spans, lit, near, far, (distortion, orientation))
    of_opacities = _add(loss, of_weights, added, weights, opacities)
    with torch.no_grad():
        of_density += of_opacities * (1 - opacities) * deltas


def _add(loss: Tensor, of_weights: Tensor, added: Tensor, *leaves: Tensor) -> Tensor:
    """Adds a loss, and its gradient with respect to the weights, in place; returns the last leaf's gradient."""
    slopes = torch.autograd.grad(added, leaves)
    with torch.no_grad():
        loss += added
        of_weights += slopes[0]
    return slopes[-1]
