"""Gradients of the networks' outputs, from gradients of rendered values. r rays, m samples of all rays (packed)."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare
from voronerf.ops.render_loss.reference import scaled


def _prepare(arguments: Any) -> Any:
    return scaled("rendered_gradient", arguments)


@declare(
    native=Implementation(("cpu",), (torch.float32,)),
    warp=PLAIN,
    small=["gradient"],
    writes=["gradient"],
    prepare=_prepare,
)
def rendered_gradient(
    gradient: Annotated[Tensor, "float32|float64 [m, 4]"],
    raw: Annotated[Tensor, "same [m, 4]"],
    density: Annotated[Tensor, "same [m]"],
    depths: Annotated[Tensor, "same [m]"],
    deltas: Annotated[Tensor, "same [m]"],
    weights: Annotated[Tensor, "same [m]"],
    ray_offsets: Annotated[Tensor, "int32 [r+1]"],
    *,
    background: Annotated[Tensor | None, "same [3] or [r, 3]"] = None,
    of_colour: Annotated[Tensor | None, "same [r, 3]"] = None,
    of_opacity: Annotated[Tensor | None, "same [r]"] = None,
    of_depth: Annotated[Tensor | None, "same [r]"] = None,
    of_weights: Annotated[Tensor | None, "same [m]"] = None,
    of_rgb: Annotated[Tensor | None, "same [m, 3]"] = None,
    of_density: Annotated[Tensor | None, "same [m]"] = None,
    hidden: Annotated[float, "[0, 1)"] = 0.0,
    density_scale: Annotated[float | None, "positive"] = None,
    activated: bool = False,
    backend: str = "auto",
) -> None:
    """Adds the gradient of a loss with respect to ``raw`` to ``gradient``, in place.

    The arguments ``of_...`` are the gradients of the loss with respect to the values of rays and samples. `composite`
    renders the samples, with weights w and transmittance T, to the colour ``sum w_i c_i + (1 - sum w_i) background``,
    the opacity ``sum w_i`` and the depth ``sum w_i d_i``, which is not divided by the opacity. Let
    ``v_i = of_weights_i + of_opacity + of_depth d_i + of_colour (c_i - background)`` be the derivative of the loss with
    respect to w_i, both directly and through these three values. Then the gradient of the density of a sample is
    ``of_density_i + delta_i (T_{i+1} v_i - sum over j > i of w_j v_j)``, and the gradient of its colour is
    ``of_rgb_i + w_i of_colour`` (Max 1995; Mildenhall et al. 2020, equation 3). The chain rule through the activations
    gives the gradient of ``raw``. Not differentiable.

    Args:
        gradient: the gradient of the loss with respect to the networks' outputs, contiguous, updated in place.
        raw: colour and density, before their activations unless ``activated``, as for `render_loss`.
        density: the densities of the samples, as `render_loss` returns them for ``raw``.
        depths: the distances of the samples along the rays.
        deltas: the lengths of the samples' ray segments.
        weights: the rendering weights of the samples.
        ray_offsets: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``, possibly none. Samples outside all
            rays have no gradient.
        background: a colour with weight 1 - opacity; None is black.
        of_colour: the gradient of the loss with respect to the colours of the rays. None counts as zero, here and for
            the arguments below.
        of_opacity: the gradient with respect to the opacities.
        of_depth: the gradient with respect to the depths.
        of_weights: the gradient with respect to the weights of the samples.
        of_rgb: the gradient with respect to the colours of the samples.
        of_density: the gradient with respect to the densities of the samples.
        hidden: the transmittance up to which a sample counts as hidden. Hidden samples have no gradient; 0 hides no
            sample.
        density_scale: the factor on the density after its softplus, as for `render_loss`; None with ``activated``.
        activated: whether ``raw`` and ``gradient`` refer to the colour and the density themselves.

    Raises:
        ValueError: a gradient that is not contiguous; both or neither of ``density_scale`` and ``activated``; offsets
            that decrease or exceed m (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf.ops import rendered_gradient
        >>> raw = torch.tensor([[1.0, 0, 0, 0.0], [0.0, 1, 0, 50.0]])  # red air before a green wall
        >>> depths, deltas, offsets = torch.tensor([1.0, 2.0]), torch.ones(2), torch.tensor([0, 2]).int()
        >>> along = raw[:, 3], depths, deltas, torch.tensor([0.0, 1.0]), offsets
        >>> gradient, slope = torch.zeros(2, 4), torch.tensor([[1.0, 0, 0]])  # the loss grows with red
        >>> rendered_gradient(gradient, raw, *along, of_colour=slope, activated=True)
        >>> gradient  # denser red air or a redder wall raises the loss
        tensor([[0., 0., 0., 1.],
                [1., 0., 0., 0.]])
    """
