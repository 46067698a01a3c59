"""Draws the pixels of a step, with replacement. n runs of pixels, p pixels of known distance, b drawn pixels."""

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
    """The pixels to draw from, as ascending runs. This form is compact if most pixels of a row are included.

    A place is an index into the pixels of all runs, one run after another.

    Attributes:
        ends: int64 [n], the inclusive cumulative sum of the lengths of the runs.
        shift: int64 [n], pixel minus place in each run.
        first: int32, for each of the places 0, 2^bits, 2 * 2^bits and so on up to ``total``, the first run that ends
            after it.
        bits: the binary logarithm of the step between the places of ``first``; 2^bits is about the length of a run.
        total: the number of pixels in all runs.

    Raises:
        ValueError: the attributes do not match each other (checked on construction).

    Examples:
        >>> import torch
        >>> from voronerf.ops import Runs
        >>> Runs.of(torch.tensor([10, 50]), torch.tensor([5, 3])).total  # pixels 10 to 14 and 50 to 52
        8
    """

    __slots__ = ()

    def __new__(cls, ends: Tensor, shift: Tensor, first: Tensor, bits: int, total: int) -> Runs:
        """Checks that the attributes match each other; ``draw_pixels`` checks their dtypes and shapes."""
        plain = all(type(part) is Tensor and part.dim() == 1 and not part.is_meta for part in (ends, shift, first))
        if plain and len(ends) and 0 <= bits <= 48 and 1 <= total <= 2**48:
            if int(ends[0]) < 1 or int(ends[-1]) != total or not bool((ends[1:] > ends[:-1]).all()):
                raise ValueError(
                    f"Runs: ends must ascend from at least 1 to the total, {total}, got {ends.tolist()!r:.60}"
                )
            wanted = _first_runs(ends, bits, total)
            if first.shape != wanted.shape or not torch.equal(first.to(wanted), wanted):
                raise ValueError(
                    f"Runs: first must hold the run of every {1 << bits}th of the {total} pixels, got "
                    f"{first.tolist()!r:.60}"
                )
        return super().__new__(cls, ends, shift, first, bits, total)

    @staticmethod
    def of(start: Tensor, length: Tensor) -> Runs:
        """Returns runs from their first pixels, int64 [n], and their lengths, int64 [n], >= 1; n >= 1."""
        ends = length.cumsum(0)
        total = int(ends[-1])
        bits = max(total // len(ends), 1).bit_length()
        return Runs(ends, start - (ends - length), _first_runs(ends, bits, total), bits, total)


def _first_runs(ends: Tensor, bits: int, total: int) -> Tensor:
    """Returns int32, for each of the places 0, 2^bits, 2 * 2^bits and so on, the first run that ends after it."""
    places = torch.arange(0, total, 1 << bits, device=ends.device)
    return torch.searchsorted(ends, places, right=True).int()


class Known(NamedTuple):
    """Pixels that show a point at a known distance, and the number of pixels to draw from them.

    Attributes:
        pixels: int64 [p], p >= 1.
        distances: float32 [p], the distance of the point in each pixel.
        several: the number of leading pixels of a batch that are drawn from these pixels.

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
    """Draws pixels, uniform numbers and known distances; see ``voronerf.ops.draw_pixels``."""
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
