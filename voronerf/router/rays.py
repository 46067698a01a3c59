"""Whether a module called with samples along rays treats them one by one, and what it does with their dimensions.

A router gives a module [n, 1, f] for [rays, samples, f]. That is right if the samples of a ray do not meet in it, which
is tried once for each kind of call: on a few samples of two rays, as rays and as samples alone.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.router.arguments import RAY, Layout, Reordering, tensors_of
from voronerf.router.loop import NoRandomness, same
from voronerf.router.parameters import in_place_of_parameters, owned_parameters

_RAYS, _SAMPLES = 2, 6


class _Excerpt(Reordering):
    """A few samples of a call's arguments, as rays (``whole``) or as samples alone."""

    def __init__(self, layout: Layout, samples: int, whole: bool) -> None:
        super().__init__(layout, None, lambda _: None)
        *outer, rays, along = layout.lead
        self.lead = (*[1] * len(outer), min(rays, _RAYS), min(along, samples))
        self.whole, self.n = whole, math.prod(self.lead)
        first = torch.arange(self.lead[-2])
        self.rays, self.picked = first, (first[:, None] * along + torch.arange(self.lead[-1])).flatten()

    def rows(self, tensor: Tensor, kind: str) -> Tensor:
        flat = self.layout.flatten(tensor.detach(), kind)
        if self.whole:
            lead = self.lead[:-1] if kind == RAY else self.lead
            picked = self.rays if kind == RAY else self.picked
            return flat[picked.to(flat.device)].reshape(*lead, *flat.shape[1:])
        picked = self.rays.repeat_interleave(self.lead[-1]) if kind == RAY else self.picked
        return self.layout.arrange(flat[picked.to(flat.device)], kind)

    def _batch(self, value: Any) -> Any:
        shape, lead = tuple(value.shape), self.layout.lead
        if shape not in (lead, lead[:-1]):
            return value
        ray = shape != lead
        device = next((tensor.device for tensor in tensors_of(value)), torch.device("cpu"))
        picked = self.rays if ray else self.picked
        if not self.whole and ray:
            picked = picked.repeat_interleave(self.lead[-1])
        flat = value.flatten()[picked.to(device)]
        if self.whole:
            return flat.reshape(self.lead[:-1] if ray else self.lead)
        return flat.reshape((self.n, *[1] * (len(shape) - 1)))


def flattens(module: nn.Module, call: Any, layout: Layout) -> list[bool] | None:
    """For each tensor that a call returns, whether the module itself makes [rays * samples, ...] of it.

    Args:
        module: with stacked parameters; those of the first cell are used.
        call: of a method of it, see ``voronerf.router.calls``.
        layout: of its arguments, with rays.

    Returns:
        None where it cannot be told, since the module fails on an excerpt.

    Raises:
        TypeError: when samples of a ray meet in the module.
    """
    for samples in (_SAMPLES, layout.lead[-1]):  # a module may be made for a number of samples
        whole, alone = _Excerpt(layout, samples, True), _Excerpt(layout, samples, False)
        try:
            rays, single = [tensors_of(_run(module, call, excerpt)) for excerpt in (whole, alone)]
        except Exception:
            continue
        if len(rays) != len(single) or not all(
            a.numel() == b.numel() and a.dtype == b.dtype and same(a.flatten(), b.flatten())
            for a, b in zip(rays, single, strict=True)
        ):
            raise TypeError(
                f"VoronoiRouter: module must treat samples one by one, but {type(module).__name__} gives other results "
                "for a sample when those along its ray are left out: it mixes the samples of a ray"
            )
        d = len(layout.lead)
        return [tuple(a.shape[:d]) != whole.lead and a.shape[:1] == (whole.n,) for a in rays]
    return None


def _run(module: nn.Module, call: Any, excerpt: _Excerpt) -> Any:
    args, kwargs = call.arranged(excerpt)
    first = {id(parameter): parameter.detach()[0] for _, _, parameter in owned_parameters(module)}
    with torch.no_grad(), NoRandomness(), in_place_of_parameters(module, first):
        return call.function(*args, **kwargs)
