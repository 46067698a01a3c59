"""The axis of samples of the tensors in a ``forward``.

One run cannot tell whether a size counts samples, since another size may have the same value. A module therefore runs
with two numbers of samples: a size that counts samples is the same multiple of both numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Axis(NamedTuple):
    """The dimension ``dim`` of the samples; its size is n * m, with the m entries of each of n samples adjacent."""

    dim: int
    m: int = 1


class SampleCount(int):
    """An integer argument of a function that is a multiple of the number of samples, such as n in ``zeros(n, 4)``."""


def multiple(sizes: Sequence[int], counts: Sequence[int]) -> int:
    """Returns m if the two sizes are m times the two numbers of samples, else 0."""
    m = sizes[0] // counts[0]
    return m if (m * counts[0], m * counts[1]) == tuple(sizes) else 0


def axis_of(shape: Sequence[int], other: Sequence[int], counts: Sequence[int]) -> Axis | None:
    """Returns the axis of samples of a tensor from its shapes in two runs; None unless exactly one axis has samples."""
    if len(shape) != len(other):
        return None
    axes = [Axis(dim, m) for dim, sizes in enumerate(zip(shape, other)) if (m := multiple(sizes, counts))]
    return axes[0] if len(axes) == 1 else None
