"""The pixels of a training step, drawn with replacement. n runs of pixels, b pixels."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, Implementation
from voronerf.ops._core.checks import INDEX, Checked, check_integer, check_same_device
from voronerf.ops.draw_pixels.reference import Runs

_OP = backends.declare("draw_pixels", native=Implementation(EVERYWHERE, (torch.int32,)))


def draw_pixels(
    seed: Tensor, count: int, below: int, *, runs: Runs | None = None, backend: str = "auto"
) -> tuple[Tensor, Tensor]:
    """Pixels, and three uniform numbers for each; all are hashes of the seed and of the number in the batch.

    The same on every backend and on any number of threads. Not differentiable.

    Args:
        seed: int32 [1].
        count: Of pixels, b, at least 1.
        below: Pixels to draw from, 1 to 2**48; with runs as many as they have.
        runs: The pixels to draw from; None for 0 to ``below`` - 1.
        backend: "auto", "reference" or "native".

    Returns:
        int64 [b], and float32 [b, 3] in [0, 1).

    Examples:
        >>> import torch
        >>> from voronerf.ops import draw_pixels
        >>> pixels, uniforms = draw_pixels(torch.tensor([7], dtype=torch.int32), 1000, 50)
        >>> int(pixels.min()), int(pixels.max()), uniforms.shape
        (0, 49, torch.Size([1000, 3]))
    """
    Checked(_OP).tensor("seed", seed, INDEX, 1)
    check_integer(_OP, "count", count, 1)
    check_integer(_OP, "below", below, 1, 2**48)
    if runs is not None:
        if not isinstance(runs, Runs):
            raise TypeError(f"{_OP}: runs must be Runs, got {type(runs).__name__}")
        check_same_device(_OP, seed=seed, ends=runs.ends, shift=runs.shift, first=runs.first)
        if below != runs.total:
            raise ValueError(f"{_OP}: below must be the {runs.total} pixels of the runs, got {below}")
    run = backends.resolve(_OP, backend=backend, device=seed.device, dtype=seed.dtype)
    pixels, uniforms = run(seed, count, below, runs)
    return pixels, uniforms
