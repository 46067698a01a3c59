"""The pixels of a training step, drawn with replacement. n runs of pixels, p known pixels, b pixels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops.march_rays.reference import hashed_uniforms


class _Runs(NamedTuple):
    ends: Tensor
    shift: Tensor
    first: Tensor
    bits: int
    total: int


class Runs(_Runs):
    """Pixels to draw from, in rising runs: few entries where most of a row counts.

    Attributes:
        ends: int64 [n], how many pixels the runs up to each have.
        shift: int64 [n], what is added to a place in all runs, one after another, to get the pixel.
        first: int32, the first run that ends behind place 0, 2^bits, 2 * 2^bits and so on, up to all pixels.
        bits: of `first`: about as many places as a run has.
        total: the pixels of all runs.

    Raises:
        ValueError: Where these do not fit each other, which is looked at when runs are made.

    Examples:
        >>> import torch
        >>> from voronerf.ops import Runs
        >>> Runs.of(torch.tensor([10, 50]), torch.tensor([5, 3])).total  # pixels 10 to 14 and 50 to 52
        8
    """

    __slots__ = ()

    def __new__(cls, ends: Tensor, shift: Tensor, first: Tensor, bits: int, total: int) -> Runs:
        """Runs that fit each other; dtypes and shapes are left to ``draw_pixels``."""
        plain = all(type(each) is Tensor and each.dim() == 1 and not each.is_meta for each in (ends, shift, first))
        if plain and len(ends) and 0 <= bits <= 48 and 1 <= total <= 2**48:
            if int(ends[0]) < 1 or int(ends[-1]) != total or not bool((ends[1:] > ends[:-1]).all()):
                raise ValueError(
                    f"Runs: ends must rise from 1 or more to the total, {total}, got {ends.tolist()!r:.60}"
                )
            wanted = _first_runs(ends, bits, total)
            if first.shape != wanted.shape or not torch.equal(first.to(wanted), wanted):
                raise ValueError(
                    f"Runs: first must hold the run of each {1 << bits}th of {total} pixels, got {first.tolist()!r:.60}"
                )
        return super().__new__(cls, ends, shift, first, bits, total)

    @staticmethod
    def of(start: Tensor, length: Tensor) -> Runs:
        """Runs from their first pixels, int64 [n], and how many each has, int64 [n], >= 1; n >= 1."""
        ends = length.cumsum(0)
        total = int(ends[-1])
        bits = max(total // len(ends), 1).bit_length()
        return Runs(ends, start - (ends - length), _first_runs(ends, bits, total), bits, total)


def _first_runs(ends: Tensor, bits: int, total: int) -> Tensor:
    """int32, the first run that ends behind place 0, 2^bits, 2 * 2^bits and so on."""
    places = torch.arange(0, total, 1 << bits, device=ends.device)
    return torch.searchsorted(ends, places, right=True).int()


class Known(NamedTuple):
    """Pixels that show what lies at a known distance, and how many of a batch are drawn from them.

    Attributes:
        pixels: int64 [p], p >= 1.
        distances: float32 [p].
        several: the first so many of a batch.

    Examples:
        >>> import torch
        >>> from voronerf.ops import Known, draw_pixels
        >>> known = Known(torch.tensor([60, 70]), torch.tensor([1.5, 2.5]), several=3)
        >>> pixels, _, distances = draw_pixels(torch.tensor([7], dtype=torch.int32), 5, 50, known=known)
        >>> bool((pixels[:3] >= 60).all()), bool((pixels[3:] < 50).all()), distances.shape
        (True, True, torch.Size([3]))
    """

    pixels: Tensor
    distances: Tensor
    several: int


def draw_pixels(
    seed: Tensor, count: int, below: int, runs: Runs | None, known: Known | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels, three uniform numbers for each, and distances of the first; see ``voronerf.ops.draw_pixels``."""
    numbers = hashed_uniforms(seed, count, 5)
    fraction = numbers[:, 0].double() + numbers[:, 1].double() / 2**24
    place = (fraction * below).long()
    if runs is not None:
        run = torch.searchsorted(runs.ends, place, right=True).clamp(max=len(runs.ends) - 1)
        place = place + runs.shift[run]
    distances = numbers.new_empty(0)
    if known is not None:
        chosen = (fraction[: known.several] * len(known.pixels)).long()
        place = torch.cat((known.pixels[chosen], place[known.several :]))
        distances = known.distances[chosen]
    return place, numbers[:, 2:].contiguous(), distances
