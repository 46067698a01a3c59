"""The loss of rendered rays and its gradient as Warp kernels. r rays, m samples of all rays (packed).

A thread takes a ray, whose samples lie side by side. With o_i = sigma_i delta_i the optical depth of sample i and F_i
the sum of those in front of it, its weight is exp(-F_i) (1 - exp(-o_i)); the background is seen with exp(-F) over the
whole ray. F is summed in float64, the rest is float32. With G_i the gradient to weight i, that to o_i is
``G_i exp(-F_i - o_i) - sum over j > i of G_j w_j``: one sweep finds the colour of the ray and leaves F_i where the
gradient of the density is to be, a second one comes back with the sum of what is behind.
"""

from __future__ import annotations

from typing import Any

import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, filled, launch
from voronerf.ops._core.declare import declared
from voronerf.ops.composite.reference import check_ray_offsets
from voronerf.ops.render_loss.autograd import register
from voronerf.ops.render_loss.reference import robust_error

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
def sigmoid(x: wp.float32) -> wp.float32:
    """1 / (1 + e^-x), which is 0 where e^-x is infinite."""
    return 1.0 / (1.0 + wp.exp(-x))


@wp.func
def softplus(x: wp.float32) -> wp.float32:
    """Without the digits that 1 + exp(-|x|) would cost (Kahan's way); NaN stays NaN."""
    small = wp.exp(-wp.abs(x))
    sum = 1.0 + small
    rest = small
    if sum != 1.0:
        rest = wp.log(sum) * small / (sum - 1.0)
    if x > 0.0:
        rest = rest + x
    return rest


@wp.struct
class Inputs:
    """Outputs of networks for the samples of rays, and what the rays are compared with.

    ``activated``: the outputs are colour and density as they are. ``seen``: the number of rays with a colour to learn.
    """

    raw: wp.array2d(dtype=wp.float32)
    deltas: wp.array(dtype=wp.float32)
    offsets: wp.array(dtype=wp.int32)
    target: wp.array2d(dtype=wp.float32)
    background: wp.array2d(dtype=wp.float32)
    scale: wp.float32
    activated: wp.bool
    hidden: wp.float32
    robust: wp.float32
    seen: wp.int32


@wp.struct
class Found:
    """Results of rays and of samples."""

    colour: wp.array2d(dtype=wp.float32)
    weights: wp.array(dtype=wp.float32)
    error: wp.array(dtype=wp.float32)
    gradient: wp.array2d(dtype=wp.float32)


@wp.func
def _colour_of(given: Inputs, i: wp.int32) -> wp.vec3:
    raw = wp.vec3(given.raw[i, 0], given.raw[i, 1], given.raw[i, 2])
    if given.activated:
        return raw
    return wp.vec3(sigmoid(raw[0]), sigmoid(raw[1]), sigmoid(raw[2]))


@wp.func
def _density_of(raw: wp.float32, scale: wp.float32, activated: wp.bool) -> wp.float32:
    if activated:
        return raw
    return softplus(raw) * scale


@wp.kernel
def _render_loss_kernel(given: Inputs, found: Found) -> None:
    ray = wp.tid()
    begin = wp.clamp(given.offsets[ray], 0, given.raw.shape[0])
    end = wp.clamp(given.offsets[ray + 1], 0, given.raw.shape[0])
    front = wp.float64(0.0)
    light = wp.vec3(0.0, 0.0, 0.0)
    for i in range(begin, end):
        optical = _density(_density_of(given.raw[i, 3], given.scale, given.activated)) * given.deltas[i]
        weight = wp.exp(-wp.float32(front)) * _absorbed(optical)
        found.gradient[i, 3] = wp.float32(front)
        front += wp.float64(optical)
        found.weights[i] = weight
        light = light + weight * _colour_of(given, i)
    left = wp.exp(-wp.float32(front))
    shown = wp.vec3(0.0, 0.0, 0.0)
    if given.background.shape[0] > 0:
        shown = wp.vec3(given.background[ray, 0], given.background[ray, 1], given.background[ray, 2])
    seen = light + left * shown
    off = seen - wp.vec3(given.target[ray, 0], given.target[ray, 1], given.target[ray, 2])
    share = 2.0 / (3.0 * wp.float32(given.target.shape[0]))
    if given.robust > 0.0:
        share = share * given.robust / wp.sqrt(wp.dot(off, off) + given.robust * given.robust)
    slopes = off * share
    for k in range(3):
        found.colour[ray, k] = seen[k]
    if ray >= given.seen:
        found.error[ray] = 0.0
        for i in range(begin, end):
            for k in range(4):
                found.gradient[i, k] = 0.0
        return
    found.error[ray] = wp.dot(off, off)
    behind = left * wp.dot(slopes, shown)
    for reverse in range(end - begin):
        i = end - 1 - reverse
        density = _density_of(given.raw[i, 3], given.scale, given.activated)
        optical = _density(density) * given.deltas[i]
        ahead = found.gradient[i, 3]
        value = _colour_of(given, i)
        to_weight = wp.dot(slopes, value)
        to_optical = to_weight * wp.exp(-(ahead + optical)) - behind
        behind += to_weight * found.weights[i]
        for k in range(3):
            to_colour = found.weights[i] * slopes[k]
            if not given.activated:
                to_colour = to_colour * (value[k] * (1.0 - value[k]))
            found.gradient[i, k] = to_colour
        slope = wp.float32(1.0)
        if not given.activated:
            slope = sigmoid(given.raw[i, 3]) * given.scale
        if density > _OPAQUE:
            slope = wp.float32(0.0)
        found.gradient[i, 3] = to_optical * given.deltas[i] * slope
        if wp.exp(-ahead) <= given.hidden:
            for k in range(4):
                found.gradient[i, k] = 0.0


@wp.kernel
def _density_kernel(given: Inputs, density: wp.array(dtype=wp.float32)) -> None:
    i = wp.tid()
    density[i] = _density_of(given.raw[i, 3], given.scale, given.activated)


def render_loss(raw: Tensor, *others: Any) -> list[Tensor]:
    """Activations, compositing and squared error; see ``voronerf.ops.render_loss``."""
    *parts, _ = _render_loss(raw.float(), *others)
    return parts


@declared("render_loss_gradient").custom_op("render_loss_warp")
def _render_loss(given: Any, found: Any) -> None:
    raw, target, m, r = given.raw, given.target, given.m, given.r
    check_ray_offsets("render_loss", given.ray_offsets, m)
    for of_strays in (found.weights, found.gradient):  # samples that belong to no ray
        of_strays.zero_()
    behind = target.new_empty(0, 3) if given.background is None else given.background.expand_as(target)
    compared = {"target": target, "background": behind, "hidden": given.hidden, "robust": given.robust}
    rule = {"scale": given.density_scale, "activated": given.activated, "seen": r - 3 * given.triples}
    inputs = filled(Inputs(), raw=raw, deltas=given.deltas, offsets=given.ray_offsets, **compared, **rule)
    outputs = {name: getattr(found, name) for name in ("colour", "weights", "error", "gradient")}
    launch(_render_loss_kernel, r, [inputs, filled(Found(), **outputs)], raw)
    launch(_density_kernel, m, [inputs, array(found.density, raw)], raw)
    found.loss.copy_(robust_error(found.error.double(), given.robust).mean() / 3)


register(_render_loss)
render_loss_gradient = _render_loss
