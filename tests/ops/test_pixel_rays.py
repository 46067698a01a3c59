from __future__ import annotations

import pytest
import torch
from helpers import all_pairs
from op_cases import refusals, refused

from voronerf.nerf import intersect_box
from voronerf.nerf.cameras import Cameras, look_at
from voronerf.ops import pixel_rays

pytestmark = pytest.mark.op("pixel_rays")
HEIGHT, WIDTH = 12, 17
LENS = torch.tensor([0.05, 0.02, 0.005, 0.005, 0.01, 0.01, 0.005, 0.005])
BOX = torch.tensor([[-1.0, -0.8, -0.5], [0.9, 1.0, 0.7]])


def scene(channels, lens):
    poses = look_at(3 * torch.nn.functional.normalize(torch.randn(4, 3), dim=1), torch.zeros(3), torch.eye(3)[2])
    intrinsics = torch.tensor([[15.0, 16.0, 8.2, 6.1]]) + torch.rand(4, 4)
    bent = None if lens is None else torch.randn(4, 8) * LENS
    models = None
    if lens == "mixed":
        models = torch.arange(4, dtype=torch.int32) % 3
        bent[2, 0] = 0.9  # an FOV lens
        bent[3] = 0  # no distortion
    images = torch.randint(0, 256, (4, HEIGHT, WIDTH, channels), dtype=torch.uint8)
    return Cameras(poses, intrinsics, WIDTH, HEIGHT, bent, models), images


SIZES = {"b": [0, 1, 63, 300], "background": [None, "one", "per ray"], "channels": [3, 4]}
LENSES = {"lens": [None, "bent", "mixed"], "boxed": [False, True]}


@pytest.mark.parametrize(*all_pairs({**SIZES, **LENSES}))
def test_is_what_cameras_boxes_and_colours_give_one_by_one(device, backend, channels, b, background, lens, boxed):
    cameras, images = scene(channels, lens)
    index = torch.randint(0, images[..., 0].numel(), (b,))
    behind = {None: None, "one": torch.rand(3), "per ray": torch.rand(b, 3)}[background]
    box = BOX if boxed else None
    on = lambda tensor: None if tensor is None else tensor.to(device)  # noqa: E731
    options = {"near": 2.5, "far": 4.0, "box": on(box), "background": on(behind), "backend": backend}
    actual = cameras.to(device).pixel_rays(on(images), on(index), **options)
    pixel = index % (HEIGHT * WIDTH)
    rays = cameras.rays(index // (HEIGHT * WIDTH), pixel % WIDTH, pixel // WIDTH)
    near, far, hit = intersect_box(rays.origins, rays.directions, box, 2.5, 4.0)
    colour = images.reshape(-1, channels)[index] / 255
    if channels == 4 and behind is not None:
        colour = colour[:, :3] * colour[:, 3:] + behind * (1 - colour[:, 3:])
    assert b < 300 or not boxed or 0 < int(hit.sum()) < b
    for part, expected in zip(actual, (rays.origins, rays.directions, near, far, colour[:, :3]), strict=True):
        torch.testing.assert_close(part.cpu(), expected, atol=2e-6, rtol=2e-6)


def test_rays_along_an_axis_are_in_a_slab_or_not(device, backend):
    """A ray with a zero direction component lies entirely inside or entirely outside the slab of this axis."""
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[:, :3, 3] = torch.tensor([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [-1.0, 1.0, 9.0]])
    lens, images = torch.tensor([[1.0, 1.0, 0.5, 0.5]]).repeat(3, 1), torch.zeros(3, 1, 1, 3, dtype=torch.uint8)
    box = torch.tensor([[-1.0, -1.0, -3.0], [1.0, 1.0, -2.0]])
    tensors = (tensor.to(device) for tensor in (poses, lens, images, torch.arange(3)))
    result = pixel_rays(*tensors, near=1.0, far=20.0, box=box.to(device), backend=backend)
    assert result.near.tolist()[::2] == [2.0, 11.0] and result.far.tolist()[::2] == [3.0, 12.0]
    assert result.near[1] == result.far[1]


def test_refuses_what_makes_no_sense():
    cameras, images = scene(4, "bent")
    index = torch.tensor([3, 0, 5])
    good = {"poses": cameras.poses, "intrinsics": cameras.intrinsics, "images": images, "index": index}
    last = images[..., 0].numel() - 1
    for backend in ("reference", "native"):
        for bad in (-1, last + 1):
            low, high = min(bad, 0), max(bad, 5)
            with refused(ValueError, f"pixel_rays: index must lie in 0 to {last}, got values from {low} to {high}"):
                pixel_rays(**{**good, "index": torch.tensor([0, bad, 5])}, near=0.0, far=1.0, backend=backend)
    refuses = refusals(pixel_rays, **good, near=0.0, far=1.0)
    refuses("images must have 3 or 4 channels, got 2", images=images[..., :2])
    refuses("lens and tables must be given together, got one", lens=torch.zeros(4, dtype=torch.int32))
    refuses(
        "tables must have shape [l, h, w, 2] with h = 12, w = 17, got [1, 12, 16, 2]", tables=torch.zeros(1, 12, 16, 2)
    )
    refuses("near and far must satisfy 0 <= near < far, got 1.0 and 1.0", near=1.0)
