"""``draw_pixels`` of the compiled module: no custom op, because nothing is traced or differentiated through a draw."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops.draw_pixels.reference import Runs


def draw_pixels(seed: Tensor, count: int, below: int, runs: Runs | None) -> tuple[Tensor, Tensor]:
    """Pixels, and three uniform numbers for each; see ``voronerf.ops.draw_pixels.reference``."""
    pixels, uniforms = seed.new_empty(count, dtype=torch.int64), seed.new_empty(count, 3, dtype=torch.float32)
    ends, shift, first, bits, _ = (None, None, None, 0, below) if runs is None else runs
    given = native.compiled.DrawPixelsInputs(
        seed=seed, ends=ends, shift=shift, first=first, bits=bits, below=below, b=count
    )
    native.compiled.draw_pixels(given, pixels, uniforms, native.machine(seed))
    return pixels, uniforms
