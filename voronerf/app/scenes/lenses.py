"""Lenses by the names of COLMAP's camera models, and a check of which pixels of a lens have rays.

Source: COLMAP, "Camera Models", and `src/colmap/sensor/models.h`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.nerf.cameras import Cameras
from voronerf.nerf.lenses import EQUIRECTANGULAR, FISHEYE, FOV, PERSPECTIVE, unproject


class Lens(NamedTuple):
    """A lens: intrinsics (fx, fy, cx, cy) in pixels, a row of `Cameras.distortion`, an entry of `Cameras.models`."""

    intrinsics: tuple[float, ...]
    coefficients: tuple[float, ...]
    model: int


#: The name and the parameters of each camera model, by COLMAP's numbers. f stands for fx and fy, w and h for the
#: picture's size.
MODELS: dict[int, tuple[str, str]] = {
    0: ("SIMPLE_PINHOLE", "f cx cy"),
    1: ("PINHOLE", "fx fy cx cy"),
    2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"),
    4: ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    6: ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    7: ("FOV", "fx fy cx cy omega"),
    8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    10: ("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s2"),
    14: ("SIMPLE_FISHEYE", "f cx cy"),
    15: ("FISHEYE", "fx fy cx cy"),
    17: ("EQUIRECTANGULAR", "w h"),
}
#: The numbers and names of unsupported models, for which `Cameras` has no equivalent lens.
OTHER_MODELS = {11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION", 13: "DIVISION", 16: "EUCM"}
#: The names of the coefficients in `Cameras.distortion`.
COEFFICIENTS = {
    PERSPECTIVE: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    FISHEYE: ("k1", "k2", "p1", "p2", "k3", "k4", "s1", "s2"),
    FOV: ("omega", *7 * ("",)),
    EQUIRECTANGULAR: 8 * ("",),
}


def colmap_lens(model: str, parameters: Sequence[float]) -> Lens:
    """Returns the lens of a COLMAP camera model, given its parameters in COLMAP's order."""
    names = {name: text.split() for name, text in MODELS.values()}
    if model not in names:
        raise ValueError(
            f"camera model {model!s:.60} is not supported (colmap image_undistorter makes PINHOLE pictures of it), "
            f"only {', '.join(names)}"
        )
    if len(parameters) != len(names[model]):
        raise ValueError(f"{model} must have {len(names[model])} parameters, got {len(parameters)}")
    values = dict(zip(names[model], parameters))
    if model == "EQUIRECTANGULAR":
        width, height = parameters
        return Lens((width / math.tau, height / math.pi, width / 2, height / 2), 8 * (0.0,), EQUIRECTANGULAR)
    kind = FISHEYE if "FISHEYE" in model else FOV if model == "FOV" else PERSPECTIVE
    focal = values.get("f", 0)
    intrinsics = (values.get("fx", focal), values.get("fy", focal), values["cx"], values["cy"])
    return Lens(intrinsics, tuple(values.get(key, 0.0) for key in COEFFICIENTS[kind]), kind)


def have_rays(cameras: Cameras, index: int, x: Tensor, y: Tensor) -> Tensor:
    """Returns bool [n]: whether the lens has a ray for each position [n] of an image.

    Corners have no ray if the distortion model folds over inside the image.
    """
    if cameras.distortion is None:
        return torch.ones_like(x, dtype=torch.bool)
    model = PERSPECTIVE if cameras.models is None else int(cameras.models[index])
    return unproject(x, y, cameras.intrinsics[index], cameras.distortion[index], model)[1]
