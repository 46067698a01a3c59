"""Draws the pixels of a step, with replacement. n runs of pixels, p pixels of known distance, b drawn pixels."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, PLAIN, Implementation
from voronerf.ops._core.checks import INDEX, TensorRule, check_integer, check_rules
from voronerf.ops._core.declare import declare
from voronerf.ops.draw_pixels.reference import KnownPixels, PixelRuns

_SEED = TensorRule("seed", INDEX, (1,))


def _of_known() -> list[TensorRule]:
    return [_SEED, TensorRule("pixels", (torch.int64,), ("p",)), TensorRule("distances", (torch.float32,), ("p",))]


def _of_runs() -> list[TensorRule]:
    of_pixels = [TensorRule(name, (torch.int64,), ("n",)) for name in ("ends", "shift")]
    return [_SEED, *of_pixels, TensorRule("first", INDEX, ("p",))]


def _prepare(arguments: Any) -> Any:
    runs, below, known = arguments.runs, arguments.below, arguments.known_pixels
    if known is not None:
        sizes = check_rules("draw_pixels", _of_known, [arguments.seed, known.pixels, known.distances], smooth=False)
        if not sizes["p"]:
            raise ValueError("draw_pixels: known_pixels must hold at least one pixel, got none")
        check_integer("draw_pixels", "draws", known.draws, 0, arguments.count)
    if runs is not None:
        sizes = check_rules("draw_pixels", _of_runs, [arguments.seed, runs.ends, runs.shift, runs.first], smooth=False)
        if not (sizes["n"] and sizes["p"]):
            raise ValueError("draw_pixels: runs must hold at least one run, got none")
        check_integer("draw_pixels", "bits", runs.bits, 0, 48)
        check_integer("draw_pixels", "total", runs.total, 1, 2**48)
        if below != runs.total:
            raise ValueError(f"draw_pixels: below must be the {runs.total} pixels of the runs, got {below}")
    return arguments


@declare(
    native=Implementation(EVERYWHERE, (torch.int32,)),
    warp=PLAIN,
    sizes={"draws": lambda arguments: 0 if arguments.known_pixels is None else arguments.known_pixels.draws},
    prepare=_prepare,
)
def draw_pixels(
    seed: Annotated[Tensor, "int32 [1]"],
    count: Annotated[int, "1..134217728"],
    below: Annotated[int, "1..281474976710656"],
    *,
    runs: PixelRuns | None = None,
    known_pixels: KnownPixels | None = None,
    backend: str = "auto",
) -> tuple[
    Annotated[Tensor, "int64 [count]"],
    Annotated[Tensor, "float32 [count, 3]"],
    Annotated[Tensor, "float32 [draws]"],
]:
    """Draws pixels with replacement, and three uniform numbers for each pixel.

    All results are hashes of the seed and of the index in the batch, the same on every backend and on any number of
    threads. Not differentiable.

    Args:
        seed: the seed of the hashes.
        count: the number of pixels to draw, b, 1 to 2**27.
        below: the number of pixels to draw from, 1 to 2**48; with ``runs``, it equals ``runs.total``.
        runs: the pixels to draw from; None for 0 to ``below`` - 1.
        known_pixels: pixels of known distance, from which the first pixels of the batch are drawn; None for none.

    Returns:
        int64 [b], the pixels; float32 [b, 3], uniform in [0, 1); and float32 [known_pixels.draws], the known distances
        of the first pixels of the batch (shape [0] without ``known_pixels``).

    Examples:
        >>> import torch
        >>> from voronerf.ops import draw_pixels
        >>> pixels, uniforms, _ = draw_pixels(torch.tensor([7], dtype=torch.int32), 1000, 50)
        >>> int(pixels.min()), int(pixels.max()), uniforms.shape
        (0, 49, torch.Size([1000, 3]))
    """
