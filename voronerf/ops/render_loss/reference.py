"""The loss of rendered rays and its gradient, from networks' outputs. r rays, m samples of all rays (packed)."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from voronerf.ops.composite.reference import check_ray_offsets, composite, optical_depth, packed_light, saveable
from voronerf.ops.formulas import activate


class RenderLoss(NamedTuple):
    """The result of `render_loss`.

    Attributes:
        loss: [], the mean squared error of the colours, or the robust error.
        colour: [r, 3], background included.
        weights: [m], the rendering weight of each sample.
        density: [m], the density of each sample.
        error: [r], the squared error of the colour of each ray, summed over the channels; 0 for a ray without a target.
        gradient: [m, 4], the gradient of the loss with respect to ``raw``.

    Examples:
        >>> import torch
        >>> from voronerf.ops import render_loss
        >>> offsets = torch.tensor([0, 2, 4], dtype=torch.int32)  # two rays of two samples
        >>> result = render_loss(torch.zeros(4, 4), torch.ones(4), offsets, torch.zeros(2, 3), density_scale=1.0)
        >>> result.weights.shape, result.error.shape, result.gradient.shape
        (torch.Size([4]), torch.Size([2]), torch.Size([4, 4]))
    """

    loss: Annotated[Tensor, "wide []"]
    colour: Annotated[Tensor, "wide [r, 3]"]
    weights: Annotated[Tensor, "wide [m]"]
    density: Annotated[Tensor, "wide [m]"]
    error: Annotated[Tensor, "wide [r]"]
    gradient: Annotated[Tensor, "same [m, 4]"]


@torch.inference_mode(False)
@torch.enable_grad()
def render_loss(raw: Tensor, *arguments: Any) -> RenderLoss:
    """Applies activations, compositing and the error; see ``voronerf.ops.render_loss``."""
    deltas, ray_offsets, target, background, *rule, hidden, robust, triples = map(saveable, arguments)
    leaf = saveable(raw.detach()).requires_grad_()
    check_ray_offsets("render_loss", ray_offsets, leaf.shape[0])
    learning, first = leaf.to(torch.promote_types(leaf.dtype, torch.float32)), len(target) - 3 * triples
    if hidden:
        _, density = activate(learning.detach(), *rule)
        dark = packed_light(optical_depth(density, deltas), ray_offsets)[0] <= hidden
        learning = torch.where(dark[:, None], learning.detach(), learning)
    if triples:  # avoids a host read of the offset
        unseen = torch.arange(len(learning), device=raw.device) >= ray_offsets[first]
        learning = torch.where(unseen[:, None], learning.detach(), learning)
    colours, density = activate(learning, *rule)
    seen = composite(density, colours, deltas, deltas, ray_offsets, background)
    error = (seen.colour - target).square().sum(-1)
    if triples:
        error = F.pad(error[:first], (0, 3 * triples))
    loss = robust_error(error, robust).mean() / 3
    (gradient,) = torch.autograd.grad(loss, leaf)
    return RenderLoss(*(part.detach() for part in (loss, seen.colour, seen.weights, density, error, gradient)))


def robust_error(error: Tensor, robust: float) -> Tensor:
    """Returns the robust errors [r] of rays from their squared errors [r], or the squared errors if ``robust`` is 0."""
    return 2 * robust * error / ((error + robust**2).sqrt() + robust) if robust else error


def scaled(op: str, arguments: Any) -> Any:
    """Returns the arguments, with a density scale of 1 for activated values.

    Raises ValueError unless exactly one of ``density_scale`` and ``activated`` is set.
    """
    scale = arguments.density_scale
    if not arguments.activated:
        if scale is None:
            raise ValueError(f"{op}: density_scale must be given unless the values are activated, got None")
        return arguments
    if scale is not None:
        raise ValueError(f"{op}: density_scale must not be given for activated values, got {scale}")
    return arguments._replace(density_scale=1.0)
