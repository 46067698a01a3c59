"""The loss of rendered rays and its gradient, from networks' outputs. r rays, m samples of all rays (packed)."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, Implementation
from voronerf.ops._core.declare import declare
from voronerf.ops.render_loss.reference import RenderLoss, scaled
from voronerf.ops.unseen_rays import check_triples


def _prepare(arguments: Any) -> Any:
    check_triples("render_loss", arguments)
    return scaled("render_loss", arguments)


@declare(
    native=Implementation(EVERYWHERE, (torch.float32,)),
    warp=Implementation(EVERYWHERE, (torch.float32,)),
    small=["raw"],
    prepare=_prepare,
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
    """Returns the mean squared or robust error of rendered rays, and its gradient with respect to ``raw``.

    The colour of a sample is ``sigmoid(raw[:, :3])``, its density ``density_scale * softplus(raw[:, 3])``. With
    ``activated``, colour and density are ``raw`` itself, for networks with other activations. `composite` renders the
    samples to the colours of rays. The loss is ``(colour - target).square().mean()`` (Mildenhall et al. 2020, equations
    3 and 6). With ``robust`` s the loss is a third of the mean of ``2 s ((e + s^2).sqrt() - s)`` over the rays
    (Charbonnier et al. 1994), where e is the squared error of a ray, summed over its channels. It is quadratic for
    small errors and linear beyond s. The native backend computes everything in one pass over each ray.

    The gradient is computed with the loss, for `Tape.learn`; the results are not differentiable.

    Args:
        raw: colour and density, before their activations unless ``activated``.
        deltas: the length of the ray segment of each sample, at least 0.
        ray_offsets: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``, possibly none. Samples outside all
            rays have weight 0.
        target: the target colours of the rays.
        background: a colour added with weight 1 - opacity; None is black.
        density_scale: the factor on the density, > 0; None with ``activated``.
        activated: whether ``raw`` is the colour and the density themselves, as for `composite`. They are not clamped,
            and the gradient is with respect to them.
        hidden: the transmittance, in [0, 1), up to which a sample counts as hidden. Hidden samples have no gradient,
            but they contribute to the gradients of the samples in front of them.
        robust: the scale s of errors beyond which the loss is linear, in [0, 1); 0 for the squared error.
        triples: the number of triples of `unseen_rays`, at most r / 3. The last ``3 triples`` rays have no target:
            the errors of these rays and the gradients of their samples are 0, but the loss is divided by the number of
            all rays.

    ``deltas``, ``target``, ``background`` and the results are float32, or float64 if ``raw`` is.

    Returns:
        RenderLoss(loss [], colour [r, 3], weights [m], density [m], error [r], gradient [m, 4]).

    Raises:
        ValueError: both or neither of ``density_scale`` and ``activated``; more triples than a third of the rays;
            offsets that decrease or exceed m (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf.ops import render_loss
        >>> raw, offsets = torch.tensor([[0.0, 0, 0, 50.0]]), torch.tensor([0, 1], dtype=torch.int32)  # a grey wall
        >>> result = render_loss(raw, torch.ones(1), offsets, torch.ones(1, 3), density_scale=1.0)
        >>> result.colour, float(result.loss)
        (tensor([[0.5000, 0.5000, 0.5000]]), 0.25)
        >>> result.gradient[:, :3].round(decimals=4)  # more light is better
        tensor([[-0.0833, -0.0833, -0.0833]])
        >>> values = torch.tensor([[0.5, 0.5, 0.5, 50.0]])  # the same wall as activated values
        >>> float(render_loss(values, torch.ones(1), offsets, torch.ones(1, 3), activated=True).loss)
        0.25
    """
