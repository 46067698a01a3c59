"""Stand-ins of other codebases' fields are fused, whole or in runs, and give what a loop over masks gives."""

from __future__ import annotations

import pytest
import torch
from ops import cases_foreign as cases

from voronerf import VoronoiRouter

NAMES = [name for name in cases.FIELDS if "2^19" not in name and "torch-ngp" not in name]


@pytest.mark.parametrize("name", NAMES)
def test_fused_equals_the_loop(name: str) -> None:
    """Values and gradients of every parameter; of those with second derivatives those too."""
    batch = cases.Batch(cases.FIELDS[name], 300, 4, cases.BACKWARD)
    field = batch.field
    router = VoronoiRouter.from_modules(
        batch.modules, batch.centres, coords="first3", share=field.share, fuse=True, way="fused"
    )
    found = batch.step(router, list(router.parameters()), 0)
    assert router.explain().startswith("forward: fused")
    assert batch.error(found) < 1e-3


def test_runs_are_explained() -> None:
    """The lines between runs are named."""
    batch = cases.Batch(cases.FIELDS["k-planes"], 64, 2, cases.FORWARD)
    router = VoronoiRouter.from_modules(batch.modules, batch.centres, coords="first3", fuse=True, way="fused")
    with torch.no_grad():
        router(*batch.arguments[0])
    assert "fused in runs: 1 run, between them torch.nn.functional.grid_sample (foreign_fields.py:" in router.explain()
