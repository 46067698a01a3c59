"""Volume rendering of samples along rays. r rays, s samples of a ray, m samples of all rays (packed), c channels."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

_OPAQUE = 1e30
"""The finite value that replaces infinite density: a sample of any usual length is opaque, and a sample of length 0 has
optical depth 0, not NaN."""


class Composite(NamedTuple):
    """The result of `composite`.

    Attributes:
        colour: [r, c], background included.
        opacity: [r], the sum of the weights.
        depth: [r], the sum of weight times depth, not divided by the opacity.
        weights: the shape of sigma, the weight of each sample in its ray's colour.

    Examples:
        >>> import torch
        >>> from voronerf import composite
        >>> result = composite(torch.ones(1, 4), torch.ones(1, 4, 3), torch.arange(4.0)[None], torch.ones(1, 4))
        >>> result.opacity.round(decimals=4)  # 1 - exp(-4)
        tensor([0.9817])
        >>> result.colour.shape, result.depth.shape, result.weights.shape
        (torch.Size([1, 3]), torch.Size([1]), torch.Size([1, 4]))
    """

    colour: Annotated[Tensor, "same [r, c]"]
    opacity: Annotated[Tensor, "same [r]"]
    depth: Annotated[Tensor, "same [r]"]
    weights: Annotated[Tensor, "same [m] if ray_offsets else [r, s]"]


def check_ray_offsets(op: str, ray_offsets: Tensor, m: int) -> None:
    """Raises ValueError, as the kernels do, for CPU offsets that do not ascend within 0 to m."""
    traced = torch.compiler.is_compiling() or type(ray_offsets) is not Tensor  # a traced tensor has no values
    if traced or ray_offsets.device.type != "cpu":
        return
    values = ray_offsets.numpy()  # ten times as fast as torch for some hundred rays
    if len(values) == 0 or (values[0] >= 0 and values[-1] <= m and (values[1:] >= values[:-1]).all()):
        return
    wrong = (ray_offsets < 0) | (ray_offsets > m)
    wrong[1:] |= ray_offsets[1:] < ray_offsets[:-1]
    if bool(wrong.any()):
        ray = int(wrong.nonzero()[0])
        raise ValueError(
            f"{op}: ray_offsets must ascend within 0 to {m} (the number of samples), got "
            f"{int(ray_offsets[ray])} for ray {ray}"
        )


def composite(
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor | None = None,
    background: Tensor | None = None,
) -> Composite:
    """Renders absorption and emission along rays; see ``voronerf.ops.composite``."""
    storage = rgb.dtype
    wide = torch.promote_types(storage, torch.float32)
    sigma, rgb, depths, deltas = (tensor.to(wide) for tensor in (sigma, rgb, depths, deltas))
    optical = optical_depth(sigma, deltas)
    if ray_offsets is None:
        weights = _in_front(optical) * -torch.expm1(-optical)
        colour = (weights[:, :, None] * rgb).sum(dim=1)  # autocast would round a matrix product
        opacity = weights.sum(dim=1)
        depth = (weights * depths).sum(dim=1)
    else:
        check_ray_offsets("composite", ray_offsets, sigma.shape[0])
        rays = ray_offsets.shape[0] - 1
        light, ray = packed_light(optical, ray_offsets)
        weights = light * -torch.expm1(-optical)
        weights = torch.where((ray > 0) & (ray <= rays), weights, 0)
        # One sum over adjacent columns computes colour, opacity and depth.
        columns = torch.cat([rgb, torch.ones_like(depths)[:, None], depths[:, None]], dim=1) * weights[:, None]
        total = ray_sums(columns, ray, ray_offsets)
        colour, opacity, depth = total[:, :-2], total[:, -2], total[:, -1]
    if background is not None:
        colour = colour + (1 - opacity)[:, None] * background.to(wide)
    return Composite(colour.to(storage), opacity.to(storage), depth.to(storage), weights.to(storage))


def saveable(value: Any) -> Any:
    """Returns the value, or its copy if it is an inference tensor, which autograd cannot save."""
    return value.clone() if isinstance(value, Tensor) and value.is_inference() else value


def optical_depth(sigma: Tensor, deltas: Tensor) -> Tensor:
    """Returns density times length, also for infinite density."""
    return sigma.clamp(max=_OPAQUE) * deltas


def packed_light(optical: Tensor, ray_offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the transmittance in front of each packed sample [m], and the index of its ray plus 1, int64 [m].

    The index of samples outside all rays is 0 or r + 1.
    """
    ray, first, last = ray_spans(ray_offsets, optical.shape[0])
    return _packed_in_front(optical, first, last), ray


def ray_spans(ray_offsets: Tensor, m: int) -> tuple[Tensor, Tensor, Tensor]:
    """Returns for each packed sample the index of its ray plus 1, and the first and last sample of its ray, int64 [m].

    The index of samples outside all rays is 0 or r + 1; such a sample is a ray of its own. The last index is exclusive.
    """
    rays, row = ray_offsets.shape[0] - 1, torch.arange(m, device=ray_offsets.device)
    ray = torch.searchsorted(ray_offsets.long(), row, right=True)
    inside = (ray > 0) & (ray <= rays)
    first = torch.where(inside, ray_offsets[(ray - 1).clamp(0, rays)], row)
    last = torch.where(inside, ray_offsets[ray.clamp(0, rays)], row + 1)
    return ray, first, last


def ray_sums(values: Tensor, ray: Tensor, ray_offsets: Tensor) -> Tensor:
    """Returns the sums of values [m, ...] over each ray, [r, ...]; ``ray`` is the first result of `ray_spans`."""
    sums: Tensor = _RayTotal.apply(values, ray, ray_offsets)
    return sums


class _RayTotal(torch.autograd.Function):
    """Sums over rays. ``index_add`` took 5.1 ms of a training step of 9.5 ms on an H200, and its order varied."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, ray: Tensor, ray_offsets: Tensor) -> Tensor:
        ctx.save_for_backward(ray)
        return torch.segment_reduce(values, "sum", offsets=ray_offsets, unsafe=True)

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor, None, None]:
        (ray,) = ctx.saved_tensors
        none = g.new_zeros(1, *g.shape[1:])
        return torch.cat([none, g, none])[ray], None, None


def _in_front(optical: Tensor) -> Tensor:
    """Returns the transmittance in front of each sample, [r, s]: exp of minus the optical depth in front.

    The terms are shifted before the cumulative sum, to exclude each sample's own term: subtracting it afterwards would
    give inf - inf for an opaque sample.
    """
    before = torch.nn.functional.pad(optical[:, :-1], (1, 0))
    return torch.exp(-before.cumsum(dim=1))


def _packed_in_front(optical: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """Returns the transmittance in front of each packed sample [m], whose ray has samples ``first`` to ``last``.

    The optical depth of a sample is clamped to ``limit``, at which no light passes, so that an opaque ray does not
    reduce the precision of the running sum for later rays.
    """
    limit = 128.0 if optical.dtype == torch.float32 else 768.0
    before = sums_in_front(optical.clamp(max=limit), first, last)
    return torch.exp(-before).to(optical.dtype)


def sums_in_front(values: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """Returns the sums of values [m] over the samples in front of each sample on its ray, float64 [m].

    ``first`` and ``last`` are results of `ray_spans`. A value that is not finite spoils only its own ray.
    """
    sums: Tensor = _RaySum.apply(values.double(), first, last, False)
    return sums


class _RaySum(torch.autograd.Function):
    """The sum over the samples in front of each sample on its ray or, if ``behind``, over the samples behind it.

    The two sums are each other's adjoints. One running sum over all rays, minus its value at the ray's start or end, is
    precise enough in float64 for millions of samples. A value that is not finite is excluded from the running sum;
    instead, the results that contain this value are set to NaN, so other rays stay finite. The same holds for the
    gradients.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, first: Tensor, last: Tensor, behind: bool) -> Tensor:
        ctx.save_for_backward(first, last)
        ctx.behind = behind
        bad = ~x.isfinite()
        running = torch.nn.functional.pad(x.masked_fill(bad, 0).cumsum(dim=0), (1, 0))
        spoiled = torch.nn.functional.pad(bad.cumsum(dim=0), (1, 0))
        if behind:
            return (running[last] - running[1:]).masked_fill(spoiled[last] > spoiled[1:], torch.nan)
        return (running[:-1] - running[first]).masked_fill(spoiled[:-1] > spoiled[first], torch.nan)

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor, None, None, None]:
        first, last = ctx.saved_tensors
        return _RaySum.apply(g, first, last, not ctx.behind), None, None, None
