"""The loss of rendered rays, from the outputs of the networks. r rays, m samples of all rays (packed)."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.declare import declare
from voronerf.ops.render_loss.reference import RenderLoss, scaled
from voronerf.ops.unseen_rays import check_triples


def _prepare(op: str, given: Any) -> Any:
    check_triples(op, given)
    return scaled(op, given)


@declare(
    native=Implementation(EVERYWHERE, FLOATS),
    warp=Implementation(EVERYWHERE, FLOATS),
    smooth=["raw"],
    small=["raw"],
    prepare=lambda given: _prepare("render_loss", given),
)
def render_loss(
    raw: Annotated[Tensor, "floating [m, 4]"],
    deltas: Annotated[Tensor, "wide [m]"],
    ray_offsets: Annotated[Tensor, "int32 [r+1]"],
    target: Annotated[Tensor, "wide [r, 3]"],
    *,
    background: Annotated[Tensor | None, "wide [3] or [r, 3]"] = None,
    density_scale: Annotated[float | None, "positive"] = None,
    activated: bool = False,
    hidden: Annotated[float, "[0, 1)"] = 0.0,
    robust: Annotated[float, "[0, 1)"] = 0.0,
    triples: Annotated[int, "0.."] = 0,
    backend: str = "auto",
) -> RenderLoss:
    """The mean squared or robust error of rendered rays, from what the networks put out for their samples.

    The colour of a sample is ``sigmoid(raw[:, :3])``, its density ``density_scale * softplus(raw[:, 3])``. With
    ``activated`` both are ``raw`` as it is, for networks with other activations. `composite` makes the colours of the
    rays of them. The loss is ``(colour - target).square().mean()`` (Mildenhall et al. 2020, equations 3 and 6); or with
    ``robust`` s, where e is the squared error of a ray, summed over its channels, a third of the mean of
    ``2 s ((e + s^2).sqrt() - s)`` (Charbonnier et al. 1994), which grows with the error of a ray, not with its square,
    beyond s. The native backend computes loss and gradient in one pass over each ray.

    Args:
        raw: colour and density before their activations, or ``activated``.
        deltas: length of the part of its ray that a sample stands for, at least 0.
        ray_offsets: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``, possibly none. Other samples have
            weight 0.
        target: the colours to learn.
        background: added with weight 1 - opacity.
        density_scale: factor on the density, > 0; None with ``activated``.
        activated: whether ``raw`` is the colour and the density themselves, as for `composite`: no sigmoid, softplus or
            scale comes in between, nothing is clamped, and gradients are to them.
        hidden: share of the light, in [0, 1). Samples that no more than it reaches have no gradient; they count as all
            others in those of the samples in front of them.
        robust: s in [0, 1), the scale of the errors beyond which the loss is not squared; 0 for none.
        triples: at most r / 3. The last ``3 triples`` rays are `unseen_rays`, which have no colour to learn: their
            error and the gradients of their samples are 0, and the loss is still divided by the number of all rays.

    ``deltas``, ``target`` and ``background`` are float32, or float64 where ``raw`` is; so are the results. The loss is
    differentiable in ``raw``, any number of times. Nothing else has gradients.

    Returns:
        RenderLoss(loss [], colour [r, 3], weights [m], density [m], error [r]).

    Raises:
        ValueError: ``density_scale`` with ``activated``, or neither; more triples than a third of the rays; on the CPU
            offsets that fall or exceed m.

    Examples:
        >>> import torch
        >>> from voronerf.ops import render_loss
        >>> raw = torch.tensor([[0.0, 0, 0, 50.0]], requires_grad=True)  # a grey wall
        >>> offsets = torch.tensor([0, 1], dtype=torch.int32)
        >>> result = render_loss(raw, torch.ones(1), offsets, torch.ones(1, 3), density_scale=1.0)
        >>> result.colour, float(result.loss)
        (tensor([[0.5000, 0.5000, 0.5000]]), 0.25)
        >>> result.loss.backward()
        >>> raw.grad[:, :3].round(decimals=4)  # lighter
        tensor([[-0.0833, -0.0833, -0.0833]])
        >>> values = torch.tensor([[0.5, 0.5, 0.5, 50.0]])  # the same wall, of networks that have activated
        >>> float(render_loss(values, torch.ones(1), offsets, torch.ones(1, 3), activated=True).loss)
        0.25
    """


@declare(
    native=Implementation(EVERYWHERE, (torch.float32,), file="render_loss"),
    warp=Implementation(EVERYWHERE, (torch.float32,), file="render_loss"),
    reference=Implementation(file="render_loss"),
    small=["raw"],
    prepare=lambda given: _prepare("render_loss_gradient", given),
)
def render_loss_gradient(
    raw: Annotated[Tensor, "floating [m, 4]"],
    deltas: Annotated[Tensor, "wide [m]"],
    ray_offsets: Annotated[Tensor, "int32 [r+1]"],
    target: Annotated[Tensor, "wide [r, 3]"],
    *,
    background: Annotated[Tensor | None, "wide [3] or [r, 3]"] = None,
    density_scale: Annotated[float | None, "positive"] = None,
    activated: bool = False,
    hidden: Annotated[float, "[0, 1)"] = 0.0,
    robust: Annotated[float, "[0, 1)"] = 0.0,
    triples: Annotated[int, "0.."] = 0,
    backend: str = "auto",
) -> tuple[RenderLoss, Annotated[Tensor, "same [m, 4]"]]:
    """`render_loss` and the gradient of its loss to ``raw``, for `forward_with_tape`; nothing is differentiable.

    Args:
        raw: as in `render_loss`.
        deltas: as in `render_loss`.
        ray_offsets: as in `render_loss`.
        target: the colours to learn.
        background: as in `render_loss`.
        density_scale: factor on the density, > 0; None with ``activated``.
        activated: whether ``raw`` is the colour and the density themselves, as in `render_loss`. So is the gradient.
        hidden: share of the light, as in `render_loss`.
        robust: as in `render_loss`.
        triples: of unseen rays, as in `render_loss`.

    Returns:
        (RenderLoss, gradient [m, 4]).

    Raises:
        ValueError: as `render_loss`.

    Examples:
        >>> import torch
        >>> from voronerf.ops import render_loss_gradient
        >>> raw, offsets = torch.tensor([[0.0, 0, 0, 50.0]]), torch.tensor([0, 1], dtype=torch.int32)
        >>> result, gradient = render_loss_gradient(raw, torch.ones(1), offsets, torch.ones(1, 3), density_scale=1.0)
        >>> float(result.loss), gradient[:, :3].round(decimals=4)
        (0.25, tensor([[-0.0833, -0.0833, -0.0833]]))
    """
