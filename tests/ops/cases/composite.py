"""Draws valid arguments of ``composite`` for the tests, and lists invalid arguments."""

from __future__ import annotations

from cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    dtype, s, c = draw.dtype(), draw.among("s", 5, 0, 1, 7, 16, 33, 64), draw.among("channels", 3, 3, 1, 5)
    packed = draw.among("packed", False, True)
    shape = (n * s,) if packed else (n, s)
    r = n if not packed or n < 64 else n // 64  # few, long rays if packed
    call: Arguments = {name: draw.uniform(*shape, dtype=dtype) for name in ("sigma", "depths", "deltas")}
    if packed:  # low density, so light reaches the end of a long ray
        call["sigma"] = 0.05 * call["sigma"]
    call["rgb"] = draw.uniform(*shape, c, dtype=dtype)
    if packed:
        call["ray_offsets"] = draw.offsets(n * s, r)
    if draw.among("background", True, False):
        call["background"] = draw.uniform(*draw.among("backgrounds", (c,), (r, c)), dtype=dtype)
    return call


CASE = Case(
    _make,
    {"": {}, "packed": {"packed": True}},
    refused={"background must be a tensor, got str": {"background": "x"}},
    differentiable=True,
    hostile="numbers",
)
