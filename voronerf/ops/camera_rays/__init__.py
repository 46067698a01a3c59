"""Rays through pixels. c cameras, b pixels. Frames and the lens model are those of ``voronerf.rendering.cameras``."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import backends
from voronerf.backends import EVERYWHERE, Implementation
from voronerf.checks import (
    INDEX,
    check_count,
    check_dtype,
    check_range,
    check_same_device,
    check_same_dtype,
    check_shape,
)

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
        ValueError: shapes, devices or an unknown backend; on the CPU also cameras out of range.
        TypeError: dtypes.
        BackendUnavailable: the named backend cannot run here.

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
    sizes: dict[str, int] = {}
    check_shape(_OP, "poses", poses, ("c", 4, 4), sizes)
    check_shape(_OP, "intrinsics", intrinsics, ("c", 4), sizes)
    check_shape(_OP, "x", x, ("b",), sizes)
    check_shape(_OP, "y", y, ("b",), sizes)
    check_dtype(_OP, "poses", poses, (torch.float32,))
    if camera is not None:
        check_shape(_OP, "camera", camera, ("b",), sizes)
        check_dtype(_OP, "camera", camera, INDEX)
        check_range(_OP, "camera", camera, sizes["c"])
    check_lenses(_OP, distortion, models, sizes)
    check_same_dtype(_OP, poses=poses, intrinsics=intrinsics, x=x, y=y, distortion=distortion)
    check_same_device(
        _OP, poses=poses, intrinsics=intrinsics, x=x, y=y, camera=camera, distortion=distortion, models=models
    )
    check_count(_OP, "x", sizes["b"])
    if sizes["c"] < 1:
        raise ValueError(f"{_OP}: poses must hold at least one camera, got none")
    run = backends.resolve(_OP, backend=backend, device=poses.device, dtype=poses.dtype)
    tensors = (tensor.detach() for tensor in (poses, intrinsics, x, y))
    origins, directions = run(*tensors, camera=camera, distortion=distortion, models=models)
    return origins, directions


def check_lenses(op: str, distortion: Tensor | None, models: Tensor | None, sizes: dict[str, int]) -> None:
    """Checks what `camera_rays` and `pixel_rays` take of lenses; `sizes` as in `check_shape`, with c."""
    if distortion is not None:
        check_shape(op, "distortion", distortion, ("c", 8), sizes)
    if models is not None:
        check_shape(op, "models", models, ("c",), sizes)
        check_dtype(op, "models", models, INDEX)
        check_range(op, "models", models, 3)
        if distortion is None:
            raise ValueError(f"{op}: distortion must be given with models, got None")
