"""The pixels of a training step, drawn with replacement. n runs of pixels, b pixels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops.march_rays.reference import hashed_uniforms


class Runs(NamedTuple):
    """Pixels to draw from, in rising runs: few entries where most of a row counts.

    Attributes:
        ends: int64 [n], how many pixels the runs up to each have.
        shift: int64 [n], what is added to a place in all runs, one after another, to get the pixel.
        first: int32, the first run that ends behind place 0, 2^bits, 2 * 2^bits and so on, up to all pixels.
        bits: of `first`: about as many places as a run has.
        total: the pixels of all runs.

    Examples:
        >>> import torch
        >>> from voronerf.ops import Runs
        >>> Runs.of(torch.tensor([10, 50]), torch.tensor([5, 3])).total  # pixels 10 to 14 and 50 to 52
        8
    """

    ends: Tensor
    shift: Tensor
    first: Tensor
    bits: int
    total: int

    @staticmethod
    def of(start: Tensor, length: Tensor) -> Runs:
        """Runs from their first pixels, int64 [n], and how many each has, int64 [n], >= 1; n >= 1."""
        ends = length.cumsum(0)
        total = int(ends[-1])
        bits = max(total // len(ends), 1).bit_length()
        places = torch.arange(0, total, 1 << bits, device=ends.device)
        first = torch.searchsorted(ends, places, right=True).int()
        return Runs(ends, start - (ends - length), first, bits, total)


def draw_pixels(seed: Tensor, count: int, below: int, runs: Runs | None) -> tuple[Tensor, Tensor]:
    """Pixels, and three uniform numbers for each; see ``voronerf.ops.draw_pixels``."""
    numbers = hashed_uniforms(seed, count, 5)
    place = ((numbers[:, 0].double() + numbers[:, 1].double() / 2**24) * below).long()
    if runs is not None:
        run = torch.searchsorted(runs.ends, place, right=True).clamp(max=len(runs.ends) - 1)
        place = place + runs.shift[run]
    return place, numbers[:, 2:].contiguous()
