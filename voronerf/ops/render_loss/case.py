"""The case of ``render_loss``."""

from __future__ import annotations

import torch

from voronerf.ops._core.cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    r, dtype = draw.among("rays", 9, 0, 1, 2, 33), draw.dtype()
    wide = torch.promote_types(dtype, torch.float32)
    call: Arguments = {"raw": draw.normal(n, 4, dtype=dtype), "deltas": draw.uniform(n, dtype=wide)}
    call |= {"ray_offsets": draw.offsets(n, r), "target": draw.uniform(r, 3, dtype=wide), "density_scale": 3.0}
    of_all, of_rays = draw.uniform(3, dtype=wide), draw.uniform(r, 3, dtype=wide)
    return {
        **call,
        "background": draw.among("background", of_rays, of_all, None),
        "hidden": draw.among("hidden", 1e-3, 0.5),
    }


def _make_plain(draw: Draw, n: int) -> Arguments:
    return _make(Draw(n, dtype=torch.float32), n)


CASE = Case(_make, differentiable=True, hostile="numbers")
CASES = {"render_loss": CASE, "render_loss_gradient": Case(_make_plain, traced=False)}
