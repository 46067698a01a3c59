"""``pixel_rays`` of the compiled module. c images of h x w pixels, b rays."""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.checks import check_range
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops.pixel_rays.reference import Pixels


@custom_op("pixel_rays_native")
def pixel_rays(pixels: Pixels) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]:
    """Rays, where they meet the box, and colours; see ``voronerf.ops.pixel_rays``."""
    poses, intrinsics, images, index, box, lens, tables, background, near, far = pixels
    b = index.shape[0]
    origins, directions, colour = poses.new_empty(b, 3), poses.new_empty(b, 3), poses.new_empty(b, 3)
    first, last = poses.new_empty(b), poses.new_empty(b)
    yield origins, directions, first, last, colour
    compiled = native.compiled
    c, h, w, channels = images.shape
    given = compiled.PixelRaysInputs(
        poses=poses,
        intrinsics=intrinsics,
        lens=lens,
        tables=tables,
        images=images,
        pixels=index,
        box=box,
        background=background,
        background_per_ray=background is not None and background.dim() == 2,
        c=c,
        h=h,
        w=w,
        channels=channels,
        b=b,
        l=0 if tables is None else len(tables),
        near=near,
        far=far,
    )
    results = compiled.PixelRaysOutputs(origins=origins, directions=directions, near=first, far=last, colour=colour)
    machine = native.machine(poses)
    if isinstance(machine, compiled.Cuda):
        compiled.pixel_rays(given, results, machine)
    elif not compiled.pixel_rays(given, results, machine):
        check_range("pixel_rays", "index", index, c * h * w)
