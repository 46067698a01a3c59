"""The loss of rendered rays, from the outputs of the networks. r rays, m samples of all rays (packed)."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.checks import FLOATING, INDEX, Checked, check_count, check_number, check_positive, detached
from voronerf.ops.render_loss.reference import RenderLoss, RenderLossInputs

_OP = backends.declare(
    "render_loss", native=Implementation(EVERYWHERE, FLOATS), warp=Implementation(EVERYWHERE, FLOATS)
)
_GRADIENT = backends.declare(
    "render_loss_gradient",
    native=Implementation(EVERYWHERE, (torch.float32,), file="render_loss"),
    reference=Implementation(file="render_loss"),
)


def render_loss(
    raw: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor,
    target: Tensor,
    *,
    background: Tensor | None = None,
    density_scale: float,
    hidden: float = 0.0,
    backend: str = "auto",
) -> RenderLoss:
    """The mean squared error of rendered rays, from what the networks put out for their samples.

    The colour of a sample is ``sigmoid(raw[:, :3])``, its density ``density_scale * softplus(raw[:, 3])``. `composite`
    makes the colours of the rays of them. The loss is ``(colour - target).square().mean()`` (Mildenhall et al. 2020,
    equations 3 and 6). The native backend computes loss and gradient in one pass over each ray.

    Args:
        raw: [m, 4], colour and density before their activations: float16, bfloat16, float32 or float64.
        deltas: [m], length of the part of its ray that a sample stands for, at least 0.
        ray_offsets: int32 [r + 1]: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``, possibly none.
            Other samples have weight 0.
        target: [r, 3], the colours to learn.
        background: [3] or [r, 3], added with weight 1 - opacity, or None.
        density_scale: factor on the density, > 0.
        hidden: share of the light, in [0, 1). Samples that no more than it reaches have no gradient; they count as all
            others in those of the samples in front of them.
        backend: "auto", "reference", "native" or "warp".

    ``deltas``, ``target`` and ``background`` are float32, or float64 where ``raw`` is; so are the results. The loss is
    differentiable in ``raw``, any number of times. Nothing else has gradients.

    Returns:
        RenderLoss(loss [], colour [r, 3], weights [m], density [m], error [r]).

    Raises:
        ValueError: on the CPU offsets that fall or exceed m.

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
    """
    given = _checked(_OP, raw, deltas, ray_offsets, target, background, density_scale, hidden)
    return RenderLoss(*backends.resolve(_OP, backend=backend, device=raw.device, dtype=raw.dtype)(given))


def render_loss_gradient(
    raw: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor,
    target: Tensor,
    *,
    background: Tensor | None = None,
    density_scale: float,
    hidden: float = 0.0,
    backend: str = "auto",
) -> tuple[RenderLoss, Tensor]:
    """`render_loss` and the gradient of its loss to ``raw``, for `forward_with_tape`; nothing is differentiable.

    Args:
        raw: [m, 4], float32 or float64.
        deltas: [m], as in `render_loss`.
        ray_offsets: int32 [r + 1], as in `render_loss`.
        target: [r, 3], the colours to learn.
        background: [3] or [r, 3], as in `render_loss`, or None.
        density_scale: factor on the density, > 0.
        hidden: share of the light, as in `render_loss`.
        backend: "auto", "reference" or "native".

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
    given = _checked(_GRADIENT, raw, deltas, ray_offsets, target, background, density_scale, hidden)
    *parts, gradient = backends.resolve(_GRADIENT, backend=backend, device=raw.device, dtype=raw.dtype)(given)
    return RenderLoss(*parts), gradient


def _checked(
    op: str,
    raw: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor,
    target: Tensor,
    background: Tensor | None,
    density_scale: float,
    hidden: float,
) -> RenderLossInputs:
    """The arguments, of which the outputs of the networks alone are part of a graph."""
    tensors = Checked(op)
    tensors.tensor("raw", raw, FLOATING, "m", 4)
    wide = (torch.promote_types(raw.dtype, torch.float32),)
    tensors.tensor("deltas", deltas, wide, "m")
    tensors.tensor("ray_offsets", ray_offsets, INDEX, "r+1")
    tensors.tensor("target", target, wide, "r", 3)
    tensors.each_or_all("background", background, wide, "r", 3)
    tensors.no_inference()
    check_count(op, "raw", raw.numel())
    check_positive(op, "density_scale", density_scale)
    check_number(op, "hidden", hidden)
    if not 0 <= hidden < 1:
        raise ValueError(f"{op}: hidden must lie in [0, 1), got {hidden}")
    constant = detached(deltas), ray_offsets, detached(target), detached(background)
    return RenderLossInputs(raw, *constant, float(density_scale), float(hidden))
