"""A scene: images with their cameras, and the space that it fills.

c images of h x w pixels. World units and axes as in `voronerf.nerf.cameras`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.app.scenes.store import check_mapped
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.contraction import Contraction, Perspective

#: An object on white; cameras that look the same way; that look outwards; that look at one place with surroundings.
KINDS = ("object", "forward", "inside-out", "unbounded")


class Sightings(NamedTuple):
    """Where images show points that are known, and how far from the camera they are.

    Attributes:
        pixels: int64 [s], numbered through all images: image * h * w + row * w + column.
        distances: float32 [s], world units.
    """

    pixels: Tensor
    distances: Tensor


@dataclass(frozen=True, eq=False)
class Split:
    """The images of one part of a scene.

    Attributes:
        cameras: c cameras.
        images: uint8 [c, h, w, 3] opaque, or [c, h, w, 4] with straight (not premultiplied) alpha. Those that are
            smaller than h x w, see `Cameras.size`, lie in the upper left corner, with zeros around them.
        names: of the images, for tables and file names.
        masks: bool [c, h, w], False for pixels that are neither trained nor scored, or None.
        on_disk: images and masks are mapped from files, since they may not fit into memory; they are not written to.
        sightings: of the points of a sparse model, or None.

    Examples:
        >>> from voronerf.app.scenes import load_scene
        >>> test = load_scene("builtin", downscale=20).test
        >>> image = test.truth(0, background=None)  # float32 in 0..1
        >>> image.shape, len(test) == len(test.names)
        (torch.Size([5, 5, 3]), True)
    """

    cameras: Cameras
    images: Tensor
    names: tuple[str, ...]
    masks: Tensor | None = None
    on_disk: bool = False
    sightings: Sightings | None = None

    def __len__(self) -> int:
        return len(self.names)

    def truth(self, index: int, background: Tensor | None) -> Tensor:
        """One image in 0..1 over `background` ([3]; None is black, as in rendering), float32 [h, w, 3]."""
        if self.on_disk:
            check_mapped()
        width, height = self.cameras.size(index)
        image = self.images[index, :height, :width].float() / 255
        if image.shape[-1] == 3:
            return image
        colour = image[..., :3] * image[..., 3:]
        return colour if background is None else colour + background.to(colour) * (1 - image[..., 3:])

    def mask(self, index: int) -> Tensor | None:
        """Which pixels of one image count, bool [h, w]; None for all."""
        width, height = self.cameras.size(index)
        return None if self.masks is None else self.masks[index, :height, :width]


@dataclass(frozen=True, eq=False)
class Scene:
    """Training and test views of the same space.

    Attributes:
        name: short, fit for the name of a folder.
        train: views for training.
        test: views held out for testing.
        near: distance along a ray at which the scene begins.
        far: distance along a ray at which the scene ends.
        box: float32 [2, 3], lowest and highest corner of an axis-aligned box around everything, or None if unknown.
        spacing: of the samples along a ray, "linear" or "disparity".
        background: "white" behind transparent pixels; None for an opaque capture without a background.
        kind: one of `KINDS`.
        contraction: what makes the space of a scene without a box finite, or None: the sphere around the origin and all
            cameras.
        transform: float64 [4, 4], from the coordinates of the scene's files to those of the scene, or None if it was
            not moved.
        notes: lines about how the files were read.

    Examples:
        >>> from voronerf.app.scenes import load_scene
        >>> scene = load_scene("builtin", downscale=20)
        >>> scene.box.shape, scene.spacing, scene.background
        (torch.Size([2, 3]), 'linear', 'white')
    """

    name: str
    train: Split
    test: Split
    near: float
    far: float
    box: Tensor | None
    spacing: str
    background: str | None
    kind: str = "object"
    contraction: Contraction | Perspective | None = None
    transform: Tensor | None = None
    notes: tuple[str, ...] = ()

    def background_colour(self, device: torch.device | str = "cpu") -> Tensor | None:
        """The background as float32 [3] in 0..1, or None."""
        return None if self.background is None else torch.ones(3, device=device)
