"""The loss of rendered rays and its gradient as Warp kernels. r rays, m samples of all rays (packed).

One thread handles one ray, whose samples are adjacent. Let o_i = sigma_i delta_i be the optical depth of sample i and
F_i the sum of the optical depths in front of it. Its weight w_i is exp(-F_i) (1 - exp(-o_i)), and the background's
weight is exp(-F), with the sum F over the whole ray. F is summed in float64, other values are float32. With G_i the
gradient of w_i, the gradient of o_i is ``G_i exp(-F_i - o_i) - sum over j > i of G_j w_j``. A first sweep computes the
colour of the ray and stores F_i in the memory of the density's gradient; a second sweep, from far to near, maintains
the sum over the samples behind the current one.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from voronerf.kernels._launch import array, filled, launch
from voronerf.ops._core.declare import declared
from voronerf.ops.composite.reference import check_ray_offsets
from voronerf.ops.render_loss.reference import robust_error

wp.set_module_options({"enable_backward": False})

_OPAQUE = wp.constant(wp.float32(1.0e30))
"""The finite value that replaces infinite density: a sample of any usual length is opaque, and a sample of length 0 has
optical depth 0, not NaN."""


@wp.func
def _density(sigma: wp.float32) -> wp.float32:
    # NaN stays NaN.
    density = sigma
    if sigma > _OPAQUE:
        density = _OPAQUE
    return density


@wp.func
def _absorbed(optical: wp.float32) -> wp.float32:
    """Returns 1 - exp(-x) without cancellation (Kahan's method)."""
    left = wp.exp(-optical)
    absorbed = 1.0 - left
    if left == 1.0:
        absorbed = optical
    elif left > 0.5:
        absorbed = (left - 1.0) * optical / wp.log(left)
    return absorbed


@wp.func
def sigmoid(x: wp.float32) -> wp.float32:
    """Returns 1 / (1 + e^-x), which is 0 if e^-x is infinite."""
    return 1.0 / (1.0 + wp.exp(-x))


@wp.func
def softplus(x: wp.float32) -> wp.float32:
    """Returns log(1 + e^x) without the rounding of 1 + exp(-|x|) (Kahan's method); NaN stays NaN."""
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
    """The networks' outputs for the samples, and the targets of the rays.

    ``activated``: whether the outputs are colour and density themselves. ``seen``: the number of rays with a target
    colour.
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
class Outputs:
    """The results for rays and for samples."""

    colour: wp.array2d(dtype=wp.float32)
    weights: wp.array(dtype=wp.float32)
    error: wp.array(dtype=wp.float32)
    gradient: wp.array2d(dtype=wp.float32)


@wp.func
def _colour_of(inputs: Inputs, i: wp.int32) -> wp.vec3:
    raw = wp.vec3(inputs.raw[i, 0], inputs.raw[i, 1], inputs.raw[i, 2])
    if inputs.activated:
        return raw
    return wp.vec3(sigmoid(raw[0]), sigmoid(raw[1]), sigmoid(raw[2]))


@wp.func
def _density_of(raw: wp.float32, scale: wp.float32, activated: wp.bool) -> wp.float32:
    if activated:
        return raw
    return softplus(raw) * scale


@wp.kernel
def _render_loss_kernel(inputs: Inputs, outputs: Outputs) -> None:
    ray = wp.tid()
    begin = wp.clamp(inputs.offsets[ray], 0, inputs.raw.shape[0])
    end = wp.clamp(inputs.offsets[ray + 1], 0, inputs.raw.shape[0])
    front = wp.float64(0.0)
    light = wp.vec3(0.0, 0.0, 0.0)
    for i in range(begin, end):
        optical = _density(_density_of(inputs.raw[i, 3], inputs.scale, inputs.activated)) * inputs.deltas[i]
        weight = wp.exp(-wp.float32(front)) * _absorbed(optical)
        outputs.gradient[i, 3] = wp.float32(front)
        front += wp.float64(optical)
        outputs.weights[i] = weight
        light = light + weight * _colour_of(inputs, i)
    left = wp.exp(-wp.float32(front))
    shown = wp.vec3(0.0, 0.0, 0.0)
    if inputs.background.shape[0] > 0:
        shown = wp.vec3(inputs.background[ray, 0], inputs.background[ray, 1], inputs.background[ray, 2])
    seen = light + left * shown
    off = seen - wp.vec3(inputs.target[ray, 0], inputs.target[ray, 1], inputs.target[ray, 2])
    share = 2.0 / (3.0 * wp.float32(inputs.target.shape[0]))
    if inputs.robust > 0.0:
        share = share * inputs.robust / wp.sqrt(wp.dot(off, off) + inputs.robust * inputs.robust)
    slopes = off * share
    for k in range(3):
        outputs.colour[ray, k] = seen[k]
    if ray >= inputs.seen:
        outputs.error[ray] = 0.0
        for i in range(begin, end):
            for k in range(4):
                outputs.gradient[i, k] = 0.0
        return
    outputs.error[ray] = wp.dot(off, off)
    behind = left * wp.dot(slopes, shown)
    for reverse in range(end - begin):
        i = end - 1 - reverse
        density = _density_of(inputs.raw[i, 3], inputs.scale, inputs.activated)
        optical = _density(density) * inputs.deltas[i]
        ahead = outputs.gradient[i, 3]
        value = _colour_of(inputs, i)
        to_weight = wp.dot(slopes, value)
        to_optical = to_weight * wp.exp(-(ahead + optical)) - behind
        behind += to_weight * outputs.weights[i]
        for k in range(3):
            to_colour = outputs.weights[i] * slopes[k]
            if not inputs.activated:
                to_colour = to_colour * (value[k] * (1.0 - value[k]))
            outputs.gradient[i, k] = to_colour
        slope = wp.float32(1.0)
        if not inputs.activated:
            slope = sigmoid(inputs.raw[i, 3]) * inputs.scale
        if density > _OPAQUE:
            slope = wp.float32(0.0)
        outputs.gradient[i, 3] = to_optical * inputs.deltas[i] * slope
        if wp.exp(-ahead) <= inputs.hidden:
            for k in range(4):
                outputs.gradient[i, k] = 0.0


@wp.kernel
def _density_kernel(inputs: Inputs, density: wp.array(dtype=wp.float32)) -> None:
    i = wp.tid()
    density[i] = _density_of(inputs.raw[i, 3], inputs.scale, inputs.activated)


@declared("render_loss").custom_op("render_loss_warp")
def render_loss(arguments: Any, results: Any) -> None:
    """Applies activations, compositing and the error; see ``voronerf.ops.render_loss``."""
    raw, target, m, r = arguments.raw, arguments.target, arguments.m, arguments.r
    check_ray_offsets("render_loss", arguments.ray_offsets, m)
    for of_strays in (results.weights, results.gradient):  # samples that belong to no ray
        of_strays.zero_()
    behind = target.new_empty(0, 3) if arguments.background is None else arguments.background.expand_as(target)
    compared = {"target": target, "background": behind, "hidden": arguments.hidden, "robust": arguments.robust}
    rule = {"scale": arguments.density_scale, "activated": arguments.activated, "seen": r - 3 * arguments.triples}
    inputs = filled(Inputs(), raw=raw, deltas=arguments.deltas, offsets=arguments.ray_offsets, **compared, **rule)
    outputs = {name: getattr(results, name) for name in ("colour", "weights", "error", "gradient")}
    launch(_render_loss_kernel, r, [inputs, filled(Outputs(), **outputs)], raw)
    launch(_density_kernel, m, [inputs, array(results.density, raw)], raw)
    results.loss.copy_(robust_error(results.error.double(), arguments.robust).mean() / 3)
