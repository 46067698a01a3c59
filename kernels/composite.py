"""Volume rendering along rays as Warp kernels. r rays, m samples of all rays, c channels.

A thread takes a ray, whose samples lie side by side: ``offsets[i]`` to ``offsets[i + 1]``, or s of them. With
o_i = sigma_i delta_i the optical depth of sample i and F_i the sum of those in front of it, its weight is
exp(-F_i) (1 - exp(-o_i)). F is summed in float64, the rest is float32; half types are cast on the way in and out.
Backward, with G_i the gradient to weight i through all that it feeds,
``gradient to o_i = G_i exp(-F_i - o_i) - sum over j > i of G_j w_j``: one sweep leaves F_i where the gradient of sigma
is to be, a second one comes back with the sum of what is behind. The background is seen with weight exp(-F) over the
whole ray. Second derivatives come from the reference formula.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch
from voronerf.ops.composite.autograd import (
    composite_backward_backward,
    composite_backward_setup,
    composite_forward_backward,
    composite_forward_setup,
)
from voronerf.ops.composite.reference import Composite

wp.set_module_options({"enable_backward": False})

_OPAQUE = wp.constant(wp.float32(1.0e30))
"""Stands for infinite density: as opaque over any length but 0, and 0 times it is 0."""


@wp.func
def _density(sigma: wp.float32) -> wp.float32:
    # NaN stays NaN.
    density = sigma
    if sigma > _OPAQUE:
        density = _OPAQUE
    return density


@wp.func
def _absorbed(optical: wp.float32) -> wp.float32:
    """1 - exp(-x) without the digits that the subtraction would cost (Kahan's way)."""
    left = wp.exp(-optical)
    absorbed = 1.0 - left
    if left == 1.0:
        absorbed = optical
    elif left > 0.5:
        absorbed = (left - 1.0) * optical / wp.log(left)
    return absorbed


@wp.func
def _bound(offsets: wp.array(dtype=wp.int32), ray: wp.int32, packed: wp.bool, s: wp.int32, m: wp.int32) -> wp.int32:
    """First sample of a ray; never out of range, whatever the offsets say."""
    bound = ray * s
    if packed:
        bound = wp.clamp(offsets[ray], 0, m)
    return bound


@wp.kernel
def _composite_kernel(
    sigma: wp.array(dtype=wp.float32),
    rgb: wp.array2d(dtype=wp.float32),
    depths: wp.array(dtype=wp.float32),
    deltas: wp.array(dtype=wp.float32),
    offsets: wp.array(dtype=wp.int32),
    packed: wp.bool,
    s: wp.int32,
    background: wp.array2d(dtype=wp.float32),
    colour: wp.array2d(dtype=wp.float32),
    opacity: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
    weights: wp.array(dtype=wp.float32),
) -> None:
    ray = wp.tid()
    begin = _bound(offsets, ray, packed, s, sigma.shape[0])
    end = _bound(offsets, ray + 1, packed, s, sigma.shape[0])
    front = wp.float64(0.0)
    total = wp.float32(0.0)
    distance = wp.float32(0.0)
    for i in range(begin, end):
        optical = _density(sigma[i]) * deltas[i]
        weight = wp.exp(-wp.float32(front)) * _absorbed(optical)
        front += wp.float64(optical)
        weights[i] = weight
        total += weight
        distance += weight * depths[i]
    opacity[ray] = total
    depth[ray] = distance
    left = wp.exp(-wp.float32(front))
    for k in range(rgb.shape[1]):
        channel = wp.float32(0.0)
        for i in range(begin, end):
            channel += weights[i] * rgb[i, k]
        if background.shape[0] > 0:
            channel += left * background[ray, k]
        colour[ray, k] = channel


@wp.kernel
def _composite_backward_kernel(
    to_colour: wp.array2d(dtype=wp.float32),
    to_opacity: wp.array(dtype=wp.float32),
    to_depth: wp.array(dtype=wp.float32),
    to_weights: wp.array(dtype=wp.float32),
    sigma: wp.array(dtype=wp.float32),
    rgb: wp.array2d(dtype=wp.float32),
    depths: wp.array(dtype=wp.float32),
    deltas: wp.array(dtype=wp.float32),
    offsets: wp.array(dtype=wp.int32),
    packed: wp.bool,
    s: wp.int32,
    background: wp.array2d(dtype=wp.float32),
    grad_sigma: wp.array(dtype=wp.float32),
    grad_rgb: wp.array2d(dtype=wp.float32),
    grad_depths: wp.array(dtype=wp.float32),
    grad_deltas: wp.array(dtype=wp.float32),
    left: wp.array(dtype=wp.float32),
) -> None:
    ray = wp.tid()
    begin = _bound(offsets, ray, packed, s, sigma.shape[0])
    end = _bound(offsets, ray + 1, packed, s, sigma.shape[0])
    front = wp.float64(0.0)
    for i in range(begin, end):
        grad_sigma[i] = wp.float32(front)
        front += wp.float64(_density(sigma[i]) * deltas[i])
    left[ray] = wp.exp(-wp.float32(front))
    # Of the gradient to each weight, what is the same for all samples of the ray; and what is behind, the background.
    common = to_opacity[ray]
    behind = wp.float32(0.0)
    if background.shape[0] > 0:
        for k in range(rgb.shape[1]):
            behind += left[ray] * to_colour[ray, k] * background[ray, k]
    for reverse in range(end - begin):
        i = end - 1 - reverse
        density = _density(sigma[i])
        optical = density * deltas[i]
        ahead = grad_sigma[i]
        weight = wp.exp(-ahead) * _absorbed(optical)
        gradient = common + to_depth[ray] * depths[i] + to_weights[i]
        for k in range(rgb.shape[1]):
            gradient += to_colour[ray, k] * rgb[i, k]
            grad_rgb[i, k] = weight * to_colour[ray, k]
        grad_depths[i] = weight * to_depth[ray]
        to_optical = gradient * wp.exp(-(ahead + optical)) - behind
        behind += gradient * weight
        grad_deltas[i] = to_optical * density
        if sigma[i] > _OPAQUE:
            grad_sigma[i] = 0.0
        else:
            grad_sigma[i] = to_optical * deltas[i]


def composite(
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    *,
    ray_offsets: Tensor | None = None,
    background: Tensor | None = None,
) -> Composite:
    """Absorption and emission along rays; see ``voronerf.ops.composite``."""
    if background is not None:
        background = background.float()
    parts = _forward(sigma.float(), rgb.float(), depths.float(), deltas.float(), ray_offsets, background)
    return Composite(*(part.to(rgb.dtype) for part in parts))


@torch.library.custom_op("voronerf::composite_warp", mutates_args=())
def _forward(
    sigma: Tensor, rgb: Tensor, depths: Tensor, deltas: Tensor, ray_offsets: Tensor | None, background: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    colour, opacity, depth, weights = results = _allocate(sigma, rgb, ray_offsets)
    # Samples that belong to no ray.
    weights.zero_()
    outputs = [array(tensor, sigma) for tensor in (colour, opacity, depth, weights.view(-1))]
    inputs = _inputs(sigma, rgb, depths, deltas, ray_offsets, background)
    launch(_composite_kernel, opacity.shape[0], [*inputs, *outputs], sigma)
    return results


@torch.library.custom_op("voronerf::composite_warp_backward", mutates_args=())
def _backward(
    colour: Tensor | None,
    opacity: Tensor | None,
    depth: Tensor | None,
    weights: Tensor | None,
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor | None,
    background: Tensor | None,
    wanted: Sequence[bool],
) -> list[Tensor]:
    """Gradients to sigma, rgb, depths, deltas and background; the last is empty without one.

    The first four arguments are the gradients of the outputs, None for zero.
    """
    shapes = _allocate(sigma, rgb, ray_offsets)
    given = [
        torch.zeros_like(part) if gradient is None else gradient
        for gradient, part in zip((colour, opacity, depth, weights), shapes)
    ]
    results = [
        torch.zeros_like(tensor, memory_format=torch.contiguous_format) for tensor in (sigma, rgb, depths, deltas)
    ]
    left = sigma.new_empty(_rays(sigma, ray_offsets))
    gradients = [array(tensor, sigma) for tensor in (*given[:3], given[3].reshape(-1))]
    inputs = _inputs(sigma, rgb, depths, deltas, ray_offsets, background)
    flat = [results[0].view(-1), results[1].view(-1, rgb.shape[-1]), results[2].view(-1), results[3].view(-1), left]
    outputs = [array(tensor, sigma) for tensor in flat]
    launch(_composite_backward_kernel, left.shape[0], [*gradients, *inputs, *outputs], sigma)
    seen = sigma.new_empty(0)
    if background is not None:
        seen = given[0] * left[:, None]
        if background.dim() == 1:
            seen = seen.sum(dim=0, dtype=torch.float64).float()
    return [*results, seen]


def _inputs(
    sigma: Tensor, rgb: Tensor, depths: Tensor, deltas: Tensor, ray_offsets: Tensor | None, background: Tensor | None
) -> list[Any]:
    """The inputs of both kernels, in their order. Samples are numbered through all rays."""
    rays, c = _rays(sigma, ray_offsets), rgb.shape[-1]
    flat = [sigma.reshape(-1), rgb.reshape(sigma.numel(), c), depths.reshape(-1), deltas.reshape(-1)]
    behind = rgb.new_empty(0, c) if background is None else background.expand(rays, c)
    s = 0 if ray_offsets is not None else sigma.shape[1]
    views = [array(tensor, sigma) for tensor in flat]
    offsets = array(ray_offsets, sigma, torch.int32)
    return [*views, offsets, ray_offsets is not None, s, array(behind, sigma)]


def _rays(sigma: Tensor, ray_offsets: Tensor | None) -> int:
    return sigma.shape[0] if ray_offsets is None else ray_offsets.shape[0] - 1


def _allocate(sigma: Tensor, rgb: Tensor, ray_offsets: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    r = _rays(sigma, ray_offsets)
    return rgb.new_empty(r, rgb.shape[-1]), sigma.new_empty(r), sigma.new_empty(r), sigma.new_empty(sigma.shape)


@_forward.register_fake
def _(
    sigma: Tensor, rgb: Tensor, depths: Tensor, deltas: Tensor, ray_offsets: Tensor | None, background: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return _allocate(sigma, rgb, ray_offsets)


@_backward.register_fake
def _(
    colour: Tensor | None,
    opacity: Tensor | None,
    depth: Tensor | None,
    weights: Tensor | None,
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor | None,
    background: Tensor | None,
    wanted: Sequence[bool],
) -> list[Tensor]:
    given = (sigma, rgb, depths, deltas)
    return [
        *(tensor.new_empty(tensor.shape) for tensor in given),
        sigma.new_empty(0 if background is None else background.shape),
    ]


_forward.register_autograd(composite_forward_backward(_backward), setup_context=composite_forward_setup)
_backward.register_autograd(composite_backward_backward, setup_context=composite_backward_setup)
