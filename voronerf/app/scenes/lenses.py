"""Lenses by the names of COLMAP's camera models, and whether a lens gives every pixel a ray.

Source: COLMAP, "Camera Models", and `src/colmap/sensor/models.h`.
"""

from __future__ import annotations

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


#: COLMAP's number of each model, its name and what its parameters are. f stands for fx and fy.
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
}
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
        raise ValueError(f"camera model {model!s:.60} is not supported, only {', '.join(names)}")
    if len(parameters) != len(names[model]):
        raise ValueError(f"{model} must have {len(names[model])} parameters, got {len(parameters)}")
    values = dict(zip(names[model], parameters))
    kind = FISHEYE if "FISHEYE" in model else FOV if model == "FOV" else PERSPECTIVE
    focal = values.get("f", 0)
    intrinsics = (values.get("fx", focal), values.get("fy", focal), values["cx"], values["cy"])
    return Lens(intrinsics, tuple(values.get(key, 0.0) for key in COEFFICIENTS[kind]), kind)


def lens_inverts(cameras: Cameras) -> Tensor:
    """Which cameras have a ray for every pixel of the border, bool [c].

    A lens model that folds over inside the image has none there.
    """
    edge = torch.linspace(0, 1, 33, dtype=torch.float64)
    low, high = torch.zeros(33), torch.ones(33)
    x, y = torch.cat((edge, edge, low, high)), torch.cat((low, high, edge, edge))
    inverts = torch.ones(len(cameras), dtype=torch.bool)
    for index in range(len(cameras)):
        width, height = cameras.size(index)
        inverts[index] = _has_ray(cameras, index, x * width, y * height).all()
    return inverts


def pixels_with_rays(cameras: Cameras, index: int) -> Tensor:
    """The pixels of an image whose centre the lens model reaches, bool [h, w]; a fisheye may leave out the corners."""
    width, height = cameras.size(index)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return _has_ray(cameras, index, x, y)


def _has_ray(cameras: Cameras, index: int, x: Tensor, y: Tensor) -> Tensor:
    if cameras.distortion is None:
        return torch.ones_like(x, dtype=torch.bool)
    model = PERSPECTIVE if cameras.models is None else int(cameras.models[index])
    return unproject(x, y, cameras.intrinsics[index], cameras.distortion[index], model)[1]
