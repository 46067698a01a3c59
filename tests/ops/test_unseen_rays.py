"""Tests of triples of neighbouring rays from places without a camera."""

from __future__ import annotations

import pytest
import torch
from op_cases import need

from voronerf.ops import unseen_rays

pytestmark = pytest.mark.op("unseen_rays")
SEED = torch.tensor([-7], dtype=torch.int32)


def test_triples_begin_around_the_cameras_and_lie_on_a_line(device, backend):
    need("unseen_rays", backend, device, torch.float32)
    cameras = torch.randn(5500, 3)
    ahead = torch.nn.functional.normalize(torch.randn(5500, 3), dim=1)
    origins, directions = cameras.to(device, copy=True), ahead.to(device, copy=True)
    rule = {"triples": 1500, "move": 0.25, "tilt": 0.1, "backend": backend}
    unseen_rays(origins, directions, SEED.to(device), **rule)
    origins, directions = origins.cpu(), directions.cpu()
    assert torch.equal(origins[:1000], cameras[:1000]) and torch.equal(directions[:2500], ahead[:2500])
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(5500))
    middle, one, other = (origins[1000:].view(3, 1500, 3)).unbind()
    assert torch.equal(middle, one) and torch.equal(middle, other)
    moved = middle - cameras[1000:2500]
    assert float(moved.abs().max()) < 0.25001 and float(moved.mean(0).abs().max()) < 0.025
    assert bool((moved.std(0) > 0.1).all())  # uniform numbers give 0.144
    middle, one, other = (directions[1000:].view(3, 1500, 3)).unbind()
    torch.testing.assert_close(one + other, middle * (one + other).norm(dim=1, keepdim=True))  # equal angles
    apart = ((one - other) / (one + other).norm(dim=1, keepdim=True)).norm(dim=1)  # tangents of half the angles
    assert float(apart.min()) > 0 and float(apart.max()) < 0.1 * 3**0.5
    assert 0.01 < float(apart.median()) < 0.03  # the expected median is 0.1 / 4 * 0.8
