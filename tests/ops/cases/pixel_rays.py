"""Draws valid arguments of ``pixel_rays`` for the tests, and lists invalid arguments."""

from __future__ import annotations

import torch

from cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    c, h, w = draw.number("cameras", 3, 1, 4), draw.number("height", 5, 1, 9), draw.number("width", 7, 1, 9)
    images = draw.integers(0, 256, c, h, w, draw.among("channels", 4, 3), dtype=torch.uint8)
    intrinsics = torch.cat([30 + 10 * draw.uniform(c, 2), 4 * draw.uniform(c, 2)], dim=1)
    call: Arguments = {"poses": torch.eye(4).repeat(c, 1, 1), "intrinsics": intrinsics, "images": images}
    if draw.among("bent", True, False):  # camera 0 has no table
        call |= {"lens": torch.arange(c, dtype=torch.int32) - 1, "tables": 0.1 * draw.normal(c, h, w, 2)}
    call |= {"near": 0.2, "far": 3.0, "background": draw.uniform(n, 3)}
    call["box"] = draw.among("box", torch.tensor([[-1.0] * 3, [1.0] * 3]), None)
    return {**call, "index": draw.integers(0, c * h * w, n, dtype=torch.int64)}


CASE = Case(
    _make,
    refused={
        "far must be a number, got NoneType": {"far": None},
        "far must be at most 3.4e+38 or infinite, got 1e+39": {"far": 1e39},
    },
    on_devices=({"bent": False},),
    hostile="indices",
)
