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

from collections.abc import Iterator, Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from voronerf.custom_op import custom_op, in_float32
from voronerf.kernels._launch import array, launch
from voronerf.ops.composite.autograd import Arriving, RaySamples, register

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


def composite(*given: Tensor | None) -> Any:
    """Absorption and emission along rays; see ``voronerf.ops.composite``."""
    return in_float32(_forward, RaySamples._make(given))


@custom_op("composite_warp")
def _forward(given: RaySamples) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    colour, opacity, depth, weights = results = given.results()
    yield results
    # Samples that belong to no ray.
    weights.zero_()
    outputs = [array(tensor, colour) for tensor in (colour, opacity, depth, weights.view(-1))]
    launch(_composite_kernel, given.rays, [*_inputs(given), *outputs], colour)


@custom_op("composite_warp_backward")
def _backward(arriving: Arriving, given: RaySamples, wanted: Sequence[bool]) -> Iterator[list[Tensor]]:
    sigma, rgb = given.sigma, given.rgb
    results = given.gradients([*[True] * 4, wanted[4]])
    yield results
    *to_samples, to_background = results
    colour, opacity, depth, weights = (
        torch.zeros_like(part) if gradient is None else gradient for gradient, part in zip(arriving, given.results())
    )
    left = sigma.new_empty(given.rays)
    for result in to_samples:
        result.zero_()
    to_sigma, to_rgb, to_depths, to_deltas = to_samples
    flat = to_sigma.view(-1), to_rgb.view(-1, rgb.shape[-1]), to_depths.view(-1), to_deltas.view(-1), left
    gradients = [array(tensor, sigma) for tensor in (colour, opacity, depth, weights.reshape(-1))]
    outputs = [array(tensor, sigma) for tensor in flat]
    launch(_composite_backward_kernel, given.rays, [*gradients, *_inputs(given), *outputs], sigma)
    if to_background.numel():
        seen = colour * left[:, None]
        to_background.copy_(seen if to_background.dim() == 2 else seen.sum(dim=0, dtype=torch.float64))


def _inputs(given: RaySamples) -> list[Any]:
    """The inputs of both kernels, in their order. Samples are numbered through all rays."""
    sigma, rgb, ray_offsets, rays = given.sigma, given.rgb, given.ray_offsets, given.rays
    flat = [sigma.reshape(-1), rgb.reshape(sigma.numel(), rgb.shape[-1])]
    flat += [given.depths.reshape(-1), given.deltas.reshape(-1)]
    behind = rgb.new_empty(0, rgb.shape[-1])
    if given.background is not None:
        behind = given.background.expand(rays, rgb.shape[-1])
    views, offsets = [array(tensor, sigma) for tensor in flat], array(ray_offsets, sigma, torch.int32)
    s = 0 if ray_offsets is not None else sigma.shape[1]
    return [*views, offsets, ray_offsets is not None, s, array(behind, sigma)]


register(_forward, _backward)
