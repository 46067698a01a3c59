"""Draws valid arguments of ``render_loss`` for the tests, and lists invalid arguments."""

from __future__ import annotations

from cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    r = draw.among("rays", 9, 0, 1, 2, 33)
    call: Arguments = {"raw": draw.normal(n, 4), "deltas": draw.uniform(n)}
    if n > 40 * r:  # short strata, so light reaches the end of a long ray
        call["deltas"] = 0.01 * call["deltas"]
    call |= {"ray_offsets": draw.offsets(n, r), "target": draw.uniform(r, 3)}
    if draw.among("activated", False, True):
        call["activated"] = True
        call["raw"][:, 3].relu_()
    else:
        call["density_scale"] = 3.0
    triples = min(draw.number("triples", 0, 0, r // 3), r // 3)
    of_all, of_rays = draw.uniform(3), draw.uniform(r, 3)
    return {
        **call,
        "background": draw.among("background", of_rays, of_all, None),
        "hidden": draw.among("hidden", 1e-3, 0.5),
        "robust": draw.among("robust", 0.0, 0.05),
        "triples": triples,
    }


CASE = Case(
    _make,
    {"": {}, "activated": {"activated": True}, "unseen": {"triples": 2}},
    refused={
        "density_scale must be given unless the values are activated, got None": {"density_scale": None},
        "density_scale must not be given for activated values, got 3.0": {"activated": True},
        "density_scale must be positive, got 0.0": {"density_scale": 0.0},
        "hidden must lie in [0, 1), got 1.0": {"hidden": 1.0},
        "triples must be at most a third of the 9 rays, got 4": {"triples": 4},
    },
    traced=False,
    hostile="numbers",
)
