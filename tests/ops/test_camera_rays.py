from __future__ import annotations

import pytest
import torch
from op_cases import refusals, strided

from voronerf.ops import camera_rays
from voronerf.rendering.cameras import Cameras, look_at

LENS = torch.tensor([0.05, 0.02, 0.005, 0.005, 0.01, 0.01, 0.005, 0.005])
pytestmark = pytest.mark.op("camera_rays")


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
def test_rays_pass_through_their_pixels(device, backend, b, lens):
    some = cameras(3, lens)
    camera = torch.randint(0, 3, (b,), dtype=torch.int32)
    x, y = 64 * torch.rand(b), 48 * torch.rand(b)

    def run(given, index):
        tensors = (strided(tensor.to(device)) for tensor in (given.poses, given.intrinsics, x, y))
        bent = None if given.distortion is None else strided(given.distortion.to(device))
        models = None if given.models is None else strided(given.models.to(device))
        which = None if index is None else strided(index.to(device))
        options = {"camera": which, "distortion": bent, "models": models, "backend": backend}
        return [part.cpu() for part in camera_rays(*tensors, **options)]

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


def test_refuses_what_makes_no_sense():
    some, x = cameras(2, "bent"), torch.rand(5)
    refuses = refusals(camera_rays, poses=some.poses, intrinsics=some.intrinsics, x=x, y=x)
    wrong = torch.tensor([0, 1, 2, 0, 0], dtype=torch.int32)
    refuses("camera must lie in 0 to 1, got values from 0 to 2", camera=wrong)
    models = torch.tensor([0, 2], dtype=torch.int32)
    refuses("distortion must be given with models, got None", models=models)
    refuses("models must lie in 0 to 2, got values from 1 to 3", models=models + 1)
    refuses("poses must hold at least one camera, got none", poses=some.poses[:0], intrinsics=some.intrinsics[:0])
