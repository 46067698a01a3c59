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

from typing import Any

import torch
import warp as wp

from voronerf.kernels._launch import filled, launch
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared
from voronerf.ops.composite import reference

wp.set_module_options({"enable_backward": False})
_OP = declared("composite")

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


@wp.struct
class Samples:
    """Samples of rays, numbered through all rays; dense ones, s of each ray, unless packed."""

    sigma: wp.array(dtype=wp.float32)
    rgb: wp.array2d(dtype=wp.float32)
    depths: wp.array(dtype=wp.float32)
    deltas: wp.array(dtype=wp.float32)
    offsets: wp.array(dtype=wp.int32)
    packed: wp.bool
    s: wp.int32
    background: wp.array2d(dtype=wp.float32)


@wp.struct
class Results:
    """What is shown of rays, and the weights of samples; or the gradients of these."""

    colour: wp.array2d(dtype=wp.float32)
    opacity: wp.array(dtype=wp.float32)
    depth: wp.array(dtype=wp.float32)
    weights: wp.array(dtype=wp.float32)


@wp.struct
class Gradients:
    """Gradients of samples, and what each ray leaves of the light."""

    sigma: wp.array(dtype=wp.float32)
    rgb: wp.array2d(dtype=wp.float32)
    depths: wp.array(dtype=wp.float32)
    deltas: wp.array(dtype=wp.float32)
    left: wp.array(dtype=wp.float32)


@wp.func
def _bound(given: Samples, ray: wp.int32) -> wp.int32:
    """First sample of a ray; never out of range, whatever the offsets say."""
    bound = ray * given.s
    if given.packed:
        bound = wp.clamp(given.offsets[ray], 0, given.sigma.shape[0])
    return bound


@wp.kernel
def _composite_kernel(given: Samples, found: Results) -> None:
    ray = wp.tid()
    begin = _bound(given, ray)
    end = _bound(given, ray + 1)
    front = wp.float64(0.0)
    total = wp.float32(0.0)
    distance = wp.float32(0.0)
    for i in range(begin, end):
        optical = _density(given.sigma[i]) * given.deltas[i]
        weight = wp.exp(-wp.float32(front)) * _absorbed(optical)
        front += wp.float64(optical)
        found.weights[i] = weight
        total += weight
        distance += weight * given.depths[i]
    found.opacity[ray] = total
    found.depth[ray] = distance
    left = wp.exp(-wp.float32(front))
    for k in range(given.rgb.shape[1]):
        channel = wp.float32(0.0)
        for i in range(begin, end):
            channel += found.weights[i] * given.rgb[i, k]
        if given.background.shape[0] > 0:
            channel += left * given.background[ray, k]
        found.colour[ray, k] = channel


@wp.kernel
def _composite_backward_kernel(arriving: Results, given: Samples, found: Gradients) -> None:
    ray = wp.tid()
    begin = _bound(given, ray)
    end = _bound(given, ray + 1)
    front = wp.float64(0.0)
    for i in range(begin, end):
        found.sigma[i] = wp.float32(front)
        front += wp.float64(_density(given.sigma[i]) * given.deltas[i])
    found.left[ray] = wp.exp(-wp.float32(front))
    # Of the gradient to each weight, what is the same for all samples of the ray; and what is behind, the background.
    common = arriving.opacity[ray]
    behind = wp.float32(0.0)
    if given.background.shape[0] > 0:
        for k in range(given.rgb.shape[1]):
            behind += found.left[ray] * arriving.colour[ray, k] * given.background[ray, k]
    for reverse in range(end - begin):
        i = end - 1 - reverse
        density = _density(given.sigma[i])
        optical = density * given.deltas[i]
        ahead = found.sigma[i]
        weight = wp.exp(-ahead) * _absorbed(optical)
        gradient = common + arriving.depth[ray] * given.depths[i] + arriving.weights[i]
        for k in range(given.rgb.shape[1]):
            gradient += arriving.colour[ray, k] * given.rgb[i, k]
            found.rgb[i, k] = weight * arriving.colour[ray, k]
        found.depths[i] = weight * arriving.depth[ray]
        to_optical = gradient * wp.exp(-(ahead + optical)) - behind
        behind += gradient * weight
        found.deltas[i] = to_optical * density
        if given.sigma[i] > _OPAQUE:
            found.sigma[i] = 0.0
        else:
            found.sigma[i] = to_optical * given.deltas[i]


@_OP.custom_op("composite_warp")
def _forward(given: Any, found: Any) -> None:
    if given.ray_offsets is not None:
        reference.check_ray_offsets("composite", given.ray_offsets, given.m)
    found.weights.zero_()  # samples that belong to no ray
    outputs = filled(Results(), **found._replace(weights=found.weights.view(-1))._asdict())
    launch(_composite_kernel, given.r, [_inputs(given), outputs], given.sigma)


@_OP.backward_op("composite_warp_backward", _forward, reference.composite)
def _backward(given: Any, arriving: Any, gradients: Any) -> None:
    sigma, rgb, r, c = given.sigma, given.rgb, given.r, given.c
    shapes = {"colour": (r, c), "opacity": (r,), "depth": (r,), "weights": sigma.shape}
    arrived = {
        name: sigma.new_zeros(shape) if getattr(arriving, name) is None else getattr(arriving, name)
        for name, shape in shapes.items()
    }
    found, of_samples = {"left": sigma.new_empty(r)}, {"sigma": sigma, "rgb": rgb, "depths": sigma, "deltas": sigma}
    for name, like in of_samples.items():
        gradient = getattr(gradients, name)
        gradient = like.new_zeros(like.shape) if gradient is None else gradient.zero_()
        found[name] = gradient.view(-1, c) if name == "rgb" else gradient.view(-1)
    arrivals = filled(Results(), **{**arrived, "weights": arrived["weights"].reshape(-1)})
    launch(_composite_backward_kernel, r, [arrivals, _inputs(given), filled(Gradients(), **found)], sigma)
    if gradients.background is not None:
        seen = arrived["colour"] * found["left"][:, None]
        gradients.background.copy_(seen if gradients.background.dim() == 2 else seen.sum(dim=0, dtype=torch.float64))


def _inputs(given: Any) -> Any:
    """The inputs of both kernels. Samples are numbered through all rays."""
    sigma, rgb, offsets, rays = given.sigma, given.rgb, given.ray_offsets, given.r
    behind = rgb.new_empty(0, rgb.shape[-1])
    if given.background is not None:
        behind = given.background.expand(rays, rgb.shape[-1])
    return filled(
        Samples(),
        sigma=sigma.reshape(-1),
        rgb=rgb.reshape(sigma.numel(), rgb.shape[-1]),
        depths=given.depths.reshape(-1),
        deltas=given.deltas.reshape(-1),
        offsets=sigma.new_empty(0, dtype=torch.int32) if offsets is None else offsets,
        packed=offsets is not None,
        s=0 if offsets is not None else sigma.shape[1],
        background=behind,
    )


composite = in_float32(_forward)
