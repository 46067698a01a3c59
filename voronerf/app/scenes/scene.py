"""A scene: images with their cameras, and the space that it fills.

c images of h x w pixels. World units and axes as in `voronerf.nerf.cameras`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.store import check_mapped
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.volume import Space

#: An object on white; cameras that look the same way; that look outwards; that look at one place with surroundings.
KINDS = ("object", "forward", "inside-out", "unbounded")


class SparseDepth(NamedTuple):
    """The pixels that show points of a sparse model, and the distances of these points.

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
        sparse_depth: of the points of a sparse model, or None.

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
    sparse_depth: SparseDepth | None = None

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


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """Training and test views of the same space.

    Attributes:
        name: short, fit for the name of a folder.
        train: views for training.
        test: views held out for testing.
        near: distance along a ray at which the scene begins.
        far: distance along a ray at which the scene ends.
        box: float32 [2, 3], lowest and highest corner of an axis-aligned box around everything, or None if unknown.
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
    box: Tensor | None = None
    background: str | None = None
    kind: str = "object"
    contraction: Contraction | Perspective | None = None
    transform: Tensor | None = None
    notes: tuple[str, ...] = ()

    @property
    def spacing(self) -> str:
        """How samples are spaced along a ray: "linear" through an object, else by "disparity"."""
        return "linear" if self.kind == "object" else "disparity"

    def background_colour(self, device: torch.device | str = "cpu") -> Tensor | None:
        """The background as float32 [3] in 0..1, or None."""
        return None if self.background is None else torch.ones(3, device=device)

    def space(self, contraction: str = "auto", *, cones: bool = False, device: torch.device | str = "cpu") -> Space:
        """How a field sees the scene.

        Args:
            contraction: "none"; "sphere", that around the scene's box, or without one the scene's own, or that around
                the origin and all cameras; "ndc" for cameras that face forward; or "auto", which is none for a scene
                with a box, else ndc or sphere.
            cones: Whether the field is asked about cones.
            device: Of the tensors of the contraction.

        Raises:
            SceneError: For ndc without forward-facing cameras, or when all cameras are at the origin, so that there is
                no sphere.
        """
        known, chosen = self.contraction, contraction
        if contraction == "auto":
            chosen = "none" if self.box is not None else "ndc" if isinstance(known, Perspective) else "sphere"
        if chosen == "none":
            return Space(None, self.spacing, cones)
        if chosen == "ndc":
            if not isinstance(known, Perspective):
                raise SceneError(f"{self.name}: contraction ndc needs forward-facing cameras, the scene is {self.kind}")
            return Space(
                replace(known, centre=known.centre.to(device), axes=known.axes.to(device)), self.spacing, cones
            )
        if self.box is not None:
            sphere = Contraction(self.box.mean(0).to(device), float((self.box[1] - self.box[0]).norm()) / 2)
        elif known is not None:
            sphere = Contraction(
                known.centre.to(device), known.near if isinstance(known, Perspective) else known.radius
            )
        else:
            radius = float(self.train.cameras.origins.norm(dim=-1).max())
            if radius == 0:
                raise SceneError(f"{self.name}: contraction sphere needs cameras in several places, all are in one")
            sphere = Contraction(torch.zeros(3, device=device), radius)
        return Space(sphere, self.spacing, cones, sphere.radius if self.kind == "unbounded" else None)

    def cube(self, space: Space) -> tuple[tuple[float, ...], ...]:
        """The corners of the space that networks see: a cube around the box, or that of a contraction.

        In a box with unequal sides, the cells of a hash grid would be as much finer along the short ones, where the
        images show nothing finer: in a city five times, at the cost of entries.

        Raises:
            SceneError: For a scene without a box that is not contracted.
        """
        if space.contraction is not None:
            box = space.contraction.cube
        elif self.box is not None:
            middle, half = self.box.mean(0), (self.box[1] - self.box[0]).amax() / 2
            box = torch.stack((middle - half, middle + half))
        else:
            raise SceneError(f"{self.name}: has no box, a field that covers space needs contraction sphere or auto")
        return tuple(tuple(round(x, 6) for x in corner) for corner in box.tolist())

    def pixel(self, space: Space) -> float:
        """Width of a pixel of the training views at the middle of the scene: distance / focal length, in scene units.

        In normalised device coordinates it is the same at all distances.
        """
        cameras = self.train.cameras
        focal = float(cameras.intrinsics[:, :2].mean())
        if isinstance(space.contraction, Perspective):
            return 1 / (focal * max(space.contraction.slopes))
        if self.kind in ("forward", "inside-out"):
            return 2 / (1 / self.near + 1 / self.far) / focal
        centre = torch.zeros(3) if self.contraction is None else self.contraction.centre
        centre = centre if self.box is None else self.box.mean(0)
        distance = float((cameras.origins - centre).norm(dim=-1).mean()) or self.near  # of a panorama from one place
        return distance / focal
