"""Draws the pixels of a step, with replacement. n runs of pixels, p pixels of known distance, b drawn pixels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops.march_rays.reference import hashed_uniforms


class _PixelRuns(NamedTuple):
    ends: Tensor
    shift: Tensor
    first: Tensor
    bits: int
    total: int


class PixelRuns(_PixelRuns):
    """The pixels to draw from, as ascending runs of consecutive pixels: compact if most pixels of a row are included.

    A place is an index into the pixels of all runs, one run after another.

    Attributes:
        ends: int64 [n], the inclusive cumulative sum of the lengths of the runs.
        shift: int64 [n], pixel minus place in each run.
        first: int32, a lookup table for the search in ``ends``: first[i] is the first run that ends after the place
            i * 2^bits. The table has an entry for each such place below ``total``.
        bits: log2 of the spacing of the places in ``first``; 2^bits is about the length of a run.
        total: the number of pixels in all runs.

    Raises:
        ValueError: the attributes do not match each other (checked on construction).

    Examples:
        >>> import torch
        >>> from voronerf.ops import PixelRuns
        >>> PixelRuns.of(torch.tensor([10, 50]), torch.tensor([5, 3])).total  # pixels 10 to 14 and 50 to 52
        8
    """

    __slots__ = ()

    def __new__(cls, ends: Tensor, shift: Tensor, first: Tensor, bits: int, total: int) -> PixelRuns:
        """Checks that the attributes match each other; ``draw_pixels`` checks their dtypes and shapes."""
        plain = all(type(part) is Tensor and part.dim() == 1 and not part.is_meta for part in (ends, shift, first))
        if plain and len(ends) and 0 <= bits <= 48 and 1 <= total <= 2**48:
            if int(ends[0]) < 1 or int(ends[-1]) != total or not bool((ends[1:] > ends[:-1]).all()):
                raise ValueError(
                    f"PixelRuns: ends must ascend from at least 1 to the total, {total}, got {ends.tolist()!r:.60}"
                )
            wanted = _first_runs(ends, bits, total)
            if first.shape != wanted.shape or not torch.equal(first.to(wanted), wanted):
                raise ValueError(
                    f"PixelRuns: first must hold the run of every {1 << bits}th of the {total} pixels, got "
                    f"{first.tolist()!r:.60}"
                )
        return super().__new__(cls, ends, shift, first, bits, total)

    @staticmethod
    def of(start: Tensor, length: Tensor) -> PixelRuns:
        """Returns runs from their first pixels, int64 [n], and their lengths, int64 [n], >= 1; n >= 1."""
        ends = length.cumsum(0)
        total = int(ends[-1])
        bits = max(total // len(ends), 1).bit_length()
        return PixelRuns(ends, start - (ends - length), _first_runs(ends, bits, total), bits, total)


def _first_runs(ends: Tensor, bits: int, total: int) -> Tensor:
    """Returns the table ``first`` of `PixelRuns`, int32: entry i is the first run that ends after place i * 2^bits."""
    places = torch.arange(0, total, 1 << bits, device=ends.device)
    return torch.searchsorted(ends, places, right=True).int()


class KnownPixels(NamedTuple):
    """Pixels that show a point at a known distance, and the number of pixels to draw from them.

    Attributes:
        pixels: int64 [p], the indices of the pixels, p >= 1.
        distances: float32 [p], the distance of the point in each pixel.
        draws: the number of leading pixels of a batch that are drawn from these pixels.

    Examples:
        >>> import torch
        >>> from voronerf.ops import KnownPixels, draw_pixels
        >>> known = KnownPixels(torch.tensor([60, 70]), torch.tensor([1.5, 2.5]), draws=3)
        >>> pixels, _, distances = draw_pixels(torch.tensor([7], dtype=torch.int32), 5, 50, known_pixels=known)
        >>> bool((pixels[:3] >= 60).all()), bool((pixels[3:] < 50).all()), distances.shape
        (True, True, torch.Size([3]))
    """

    pixels: Tensor
    distances: Tensor
    draws: int


def draw_pixels(
    seed: Tensor, count: int, below: int, runs: PixelRuns | None, known_pixels: KnownPixels | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Draws pixels, uniform numbers and known distances; see ``voronerf.ops.draw_pixels``."""
    numbers = hashed_uniforms(seed, count, 5)
    fraction = numbers[:, 0].double() + numbers[:, 1].double() / 2**24
    place = (fraction * below).long()
    if runs is not None:
        run = torch.searchsorted(runs.ends, place, right=True).clamp(max=len(runs.ends) - 1)
        place = place + runs.shift[run]
    distances = numbers.new_empty(0)
    if known_pixels is not None:
        chosen = (fraction[: known_pixels.draws] * len(known_pixels.pixels)).long()
        place = torch.cat((known_pixels.pixels[chosen], place[known_pixels.draws :]))
        distances = known_pixels.distances[chosen]
    return place, numbers[:, 2:].contiguous(), distances
