"""Rays through pixels. c cameras, b pixels. Frames and the lens model are those of ``voronerf.rendering.cameras``."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import backends
from voronerf.backends import EVERYWHERE, Implementation
from voronerf.checks import INDEX, LIKE_FIRST, Checked, check_range

_OP = backends.declare(
    "camera_rays",
    warp=Implementation(EVERYWHERE, (torch.float32,)),
)


def camera_rays(
    poses: Tensor,
    intrinsics: Tensor,
    x: Tensor,
    y: Tensor,
    *,
    camera: Tensor | None = None,
    distortion: Tensor | None = None,
    models: Tensor | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """Rays through positions in images. Lens distortion is undone by Newton's method in float64.

    Not differentiable.

    Args:
        poses: float32 [c, 4, 4], camera to world, OpenGL axes.
        intrinsics: float32 [c, 4], (fx, fy, cx, cy) in pixels.
        x: float32 [b], to the right, in pixels; the centre of the first column is at 0.5.
        y: float32 [b], downwards.
        camera: int32 [b], the camera of each position, 0 to c - 1; None for the first camera. Others are an error on
            the CPU, and undefined on CUDA, where they are not checked.
        distortion: float32 [c, 8], (k1, k2, p1, p2, k3, k4, k5, k6) of OpenCV's rational model, or None for none.
        models: int32 [c], the camera model of each, which comes with distortion; None is 0 for all. 0 is perspective.
            1 is a fisheye, and distortion is (k1, k2, p1, p2, k3, k4, s1, s2) of COLMAP's THIN_PRISM_FISHEYE, whose k1
            to k4 are those of OpenCV's fisheye model. 2 is COLMAP's FOV, and distortion is (omega, 0, ...). Others are
            an error on the CPU, and perspective on CUDA.
        backend: "auto", "reference" or "warp".

    Returns:
        (origins float32 [b, 3], directions float32 [b, 3] of unit length).

    Raises:
        ValueError: on the CPU cameras out of range.

    Examples:
        >>> import torch
        >>> from voronerf.ops import camera_rays
        >>> poses = torch.eye(4)[None]  # at the origin, looking along -z
        >>> intrinsics = torch.tensor([[100.0, 100.0, 50.0, 50.0]])
        >>> x, y = torch.tensor([50.0, 150.0]), torch.tensor([50.0, 50.0])
        >>> origins, directions = camera_rays(poses, intrinsics, x, y)
        >>> directions.round(decimals=4)
        tensor([[ 0.0000,  0.0000, -1.0000],
                [ 0.7071,  0.0000, -0.7071]])
    """
    given = Checked(_OP)
    given.tensor("poses", poses, (torch.float32,), "c", 4, 4)
    given.tensor("intrinsics", intrinsics, LIKE_FIRST, "c", 4)
    given.tensor("x", x, LIKE_FIRST, "b")
    given.tensor("y", y, LIKE_FIRST, "b")
    given.optional("camera", camera, INDEX, "b")
    check_lenses(given, distortion, models)
    if given.sizes["c"] < 1:
        raise ValueError(f"{_OP}: poses must hold at least one camera, got none")
    if camera is not None:
        check_range(_OP, "camera", camera, given.sizes["c"])
    run = backends.resolve(_OP, backend=backend, device=poses.device, dtype=poses.dtype)
    poses, intrinsics, x, y = (tensor.detach() for tensor in (poses, intrinsics, x, y))
    origins, directions = run(poses, intrinsics, x, y, camera, distortion, models)
    return origins, directions


def check_lenses(given: Checked, distortion: Tensor | None, models: Tensor | None) -> None:
    """Checks what `camera_rays` and `pixel_rays` take of lenses."""
    given.optional("distortion", distortion, LIKE_FIRST, "c", 8)
    given.optional("models", models, INDEX, "c")
    if models is not None:
        check_range(given.op, "models", models, 3)
        if distortion is None:
            raise ValueError(f"{given.op}: distortion must be given with models, got None")
