"""Lenses by the names of COLMAP's camera models, and whether a lens gives a position a ray.

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
    """Intrinsics (fx, fy, cx, cy) in pixels, the coefficients of `Cameras.distortion`, and of `Cameras.models` one."""

    intrinsics: tuple[float, ...]
    coefficients: tuple[float, ...]
    model: int


#: COLMAP's number of each model, its name and what its parameters are. f stands for fx and fy, w and h for the size of
#: the picture.
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
#: The numbers and names of the models that are not read: no lens of `Cameras` is equal to one of them.
OTHER_MODELS = {11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION", 13: "DIVISION", 16: "EUCM"}
#: The names of the coefficients in `Cameras.distortion`.
COEFFICIENTS = {
    PERSPECTIVE: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    FISHEYE: ("k1", "k2", "p1", "p2", "k3", "k4", "s1", "s2"),
    FOV: ("omega", *7 * ("",)),
    EQUIRECTANGULAR: 8 * ("",),
}


def colmap_lens(model: str, parameters: Sequence[float]) -> Lens:
    """The lens of a camera model of COLMAP, with its parameters in COLMAP's order."""
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
    """Which of the positions [n] in an image its lens gives a ray to, bool [n].

    A model that folds over inside the image leaves out its corners.
    """
    if cameras.distortion is None:
        return torch.ones_like(x, dtype=torch.bool)
    model = PERSPECTIVE if cameras.models is None else int(cameras.models[index])
    return unproject(x, y, cameras.intrinsics[index], cameras.distortion[index], model)[1]
