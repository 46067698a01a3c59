"""Pairs of neighbouring rays from where no camera was."""

from __future__ import annotations

import pytest
import torch
from op_cases import need

from voronerf.ops import unseen_rays

pytestmark = pytest.mark.op("unseen_rays")
SEED = torch.tensor([-7], dtype=torch.int32)


def test_pairs_begin_around_the_cameras_and_lie_close_together(device, backend):
    need("unseen_rays", backend, device, torch.float32)
    cameras = torch.randn(4000, 3)
    ahead = torch.nn.functional.normalize(torch.randn(4000, 3), dim=1)
    origins, directions = cameras.to(device, copy=True), ahead.to(device, copy=True)
    rule = {"pairs": 1500, "move": 0.25, "tilt": 0.01, "backend": backend}
    unseen_rays(origins, directions, SEED.to(device), **rule)
    origins, directions = origins.cpu(), directions.cpu()
    assert torch.equal(origins[:1000], cameras[:1000]) and torch.equal(directions[:2500], ahead[:2500])
    assert torch.equal(origins[1000:2500], origins[2500:])
    moved = origins[1000:2500] - cameras[1000:2500]
    turned = directions[2500:] - directions[1000:2500]
    for numbers, most in ((moved, 0.25), (turned, 0.01)):
        assert float(numbers.abs().max()) < 1.3 * most and float(numbers.mean(0).abs().max()) < 0.1 * most
        assert bool((numbers.std(0) > 0.4 * most).all())  # 0.58 of uniform numbers
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(4000))
