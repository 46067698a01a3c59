from __future__ import annotations

import pytest
import torch
from helpers import refuses

from voronerf.nerf.cameras import Cameras, look_at
from voronerf.ops.pixel_rays.lens import camera_rays

LENS = torch.tensor([0.05, 0.02, 0.005, 0.005, 0.01, 0.01, 0.005, 0.005])


def cameras(count, lens):
    poses = look_at(torch.randn(count, 3) * 3, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    intrinsics = torch.tensor([[80.0, 75.0, 31.0, 25.0]]) + torch.rand(count, 4)
    bent = None if lens is None else torch.randn(count, 8) * LENS
    models = None
    if lens == "mixed":
        models = torch.arange(count, dtype=torch.int32) % 3
        bent[2::3, 0] = 0.9  # of FOV
    return Cameras(poses, intrinsics, 64, 48, bent, models)


@pytest.mark.parametrize("lens", [None, "bent", "mixed"])
@pytest.mark.parametrize("b", [0, 1, 300])
def test_rays_pass_through_their_pixels(b, lens):
    some = cameras(3, lens)
    camera = torch.randint(0, 3, (b,), dtype=torch.int32)
    x, y = 64 * torch.rand(b), 48 * torch.rand(b)

    def run(given, index):
        return camera_rays(given.poses, given.intrinsics, x, y, index, given.distortion, given.models)

    origins, directions = run(some, camera)
    assert origins.shape == directions.shape == (b, 3)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(b))
    for number in range(3):
        mine = camera == number
        assert torch.equal(origins[mine], some.origins[number].expand(int(mine.sum()), 3))
        pixels, depth = some.project(origins[mine] + 2 * directions[mine], number)
        assert bool((depth > 0).all())
        torch.testing.assert_close(pixels, torch.stack((x, y), dim=-1)[mine], atol=2e-4, rtol=0)
    expected = run(some, torch.full((b,), 2, dtype=torch.int32))
    for found, want in zip(run(some[2:], None), expected):
        torch.testing.assert_close(found, want, atol=1e-6, rtol=0)


def test_cameras_out_of_range_are_refused():
    some, x, wrong = cameras(2, "bent"), torch.rand(3), torch.tensor([0, 1, 2], dtype=torch.int32)
    given = some.poses, some.intrinsics, x, x, wrong, some.distortion, None
    refuses("camera_rays: camera must lie in 0 to 1, got values from 0 to 2", camera_rays, *given)
