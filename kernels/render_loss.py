"""The loss of rendered rays and its gradient as Warp kernels. r rays, m samples of all rays (packed).

A thread takes a ray, as in ``composite``, whose formulas these are between the activations of the networks' outputs and
the squared error of the colour: one sweep finds the colour of the ray and leaves the optical depth in front of each
sample where the gradient of its density is to be, a second one comes back with the sum of what is behind.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
import warp as wp
from torch import Tensor

from voronerf.custom_op import custom_op
from voronerf.kernels._launch import array, launch
from voronerf.kernels.composite import _OPAQUE, _absorbed, _density
from voronerf.ops.composite.reference import check_ray_offsets
from voronerf.ops.render_loss.autograd import Results, register, results
from voronerf.ops.render_loss.reference import Rendered

wp.set_module_options({"enable_backward": False})


@wp.func
def _sigmoid(x: wp.float32) -> wp.float32:
    return 1.0 / (1.0 + wp.exp(-x))


@wp.func
def _softplus(x: wp.float32) -> wp.float32:
    """Without the digits that 1 + exp(-|x|) would cost (Kahan's way); NaN stays NaN."""
    small = wp.exp(-wp.abs(x))
    sum = 1.0 + small
    rest = small
    if sum != 1.0:
        rest = wp.log(sum) * small / (sum - 1.0)
    if x > 0.0:
        rest = rest + x
    return rest


@wp.kernel
def _render_loss_kernel(
    raw: wp.array2d(dtype=wp.float32),
    deltas: wp.array(dtype=wp.float32),
    offsets: wp.array(dtype=wp.int32),
    target: wp.array2d(dtype=wp.float32),
    background: wp.array2d(dtype=wp.float32),
    scale: wp.float32,
    hidden: wp.float32,
    colour: wp.array2d(dtype=wp.float32),
    weights: wp.array(dtype=wp.float32),
    error: wp.array(dtype=wp.float32),
    gradient: wp.array2d(dtype=wp.float32),
) -> None:
    ray = wp.tid()
    begin = wp.clamp(offsets[ray], 0, raw.shape[0])
    end = wp.clamp(offsets[ray + 1], 0, raw.shape[0])
    front = wp.float64(0.0)
    light = wp.vec3(0.0, 0.0, 0.0)
    for i in range(begin, end):
        optical = _density(_softplus(raw[i, 3]) * scale) * deltas[i]
        weight = wp.exp(-wp.float32(front)) * _absorbed(optical)
        gradient[i, 3] = wp.float32(front)
        front += wp.float64(optical)
        weights[i] = weight
        light = light + weight * wp.vec3(_sigmoid(raw[i, 0]), _sigmoid(raw[i, 1]), _sigmoid(raw[i, 2]))
    left = wp.exp(-wp.float32(front))
    shown = wp.vec3(0.0, 0.0, 0.0)
    if background.shape[0] > 0:
        shown = wp.vec3(background[ray, 0], background[ray, 1], background[ray, 2])
    seen = light + left * shown
    off = seen - wp.vec3(target[ray, 0], target[ray, 1], target[ray, 2])
    slopes = off * (2.0 / (3.0 * wp.float32(target.shape[0])))
    for k in range(3):
        colour[ray, k] = seen[k]
    error[ray] = wp.dot(off, off)
    behind = left * wp.dot(slopes, shown)
    for reverse in range(end - begin):
        i = end - 1 - reverse
        density = _softplus(raw[i, 3]) * scale
        optical = _density(density) * deltas[i]
        ahead = gradient[i, 3]
        value = wp.vec3(_sigmoid(raw[i, 0]), _sigmoid(raw[i, 1]), _sigmoid(raw[i, 2]))
        to_weight = wp.dot(slopes, value)
        to_optical = to_weight * wp.exp(-(ahead + optical)) - behind
        behind += to_weight * weights[i]
        for k in range(3):
            gradient[i, k] = weights[i] * slopes[k] * (value[k] * (1.0 - value[k]))
        slope = _sigmoid(raw[i, 3]) * scale
        if density > _OPAQUE:
            slope = wp.float32(0.0)
        gradient[i, 3] = to_optical * deltas[i] * slope
        if wp.exp(-ahead) <= hidden:
            for k in range(4):
                gradient[i, k] = 0.0


@wp.kernel
def _density_kernel(raw: wp.array2d(dtype=wp.float32), scale: wp.float32, density: wp.array(dtype=wp.float32)) -> None:
    i = wp.tid()
    density[i] = _softplus(raw[i, 3]) * scale


def render_loss(given: Rendered) -> list[Tensor]:
    """Activations, compositing and squared error; see ``voronerf.ops.render_loss``."""
    *parts, _ = _render_loss(given._replace(raw=given.raw.float()))
    return parts


@custom_op("render_loss_warp")
def _render_loss(given: Rendered) -> Iterator[Results]:
    loss, colour, weights, density, error, gradient = found = results(given)
    yield found
    raw, target, m, r = given.raw, given.target, given.raw.shape[0], given.target.shape[0]
    check_ray_offsets("render_loss", given.ray_offsets, m)
    for of_strays in (weights, gradient):  # samples that belong to no ray
        of_strays.zero_()
    behind = target.new_empty(0, 3) if given.background is None else given.background.expand_as(target)
    inputs = [array(tensor, raw) for tensor in (raw, given.deltas, given.ray_offsets, target, behind)]
    outputs = [array(tensor, raw) for tensor in (colour, weights, error, gradient)]
    launch(_render_loss_kernel, r, [*inputs, given.density_scale, given.hidden, *outputs], raw)
    launch(_density_kernel, m, [inputs[0], given.density_scale, array(density, raw)], raw)
    loss.copy_(error.mean(dtype=torch.float64) / 3)


register(_render_loss)
