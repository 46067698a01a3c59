"""A scene: images with their cameras, and its space.

c images of h x w pixels. World units and axes as in `voronerf.nerf.cameras`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.store import check_mapped
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.volume import Space

#: The kinds of scenes: an object on white; cameras that look the same way; cameras that look outwards; cameras that
#: look at one place with surroundings.
KINDS = ("object", "forward", "inside-out", "unbounded")


class KnownDepths(NamedTuple):
    """The pixels that show points of a sparse model, and these points' distances.

    Attributes:
        pixels: int64 [s], flat indices over all images: image * h * w + row * w + column.
        distances: float32 [s], distances from the camera in world units.
    """

    pixels: Tensor
    distances: Tensor


@dataclass(frozen=True, eq=False)
class Split:
    """The images of one part of a scene.

    Attributes:
        cameras: c cameras.
        images: uint8 [c, h, w, 3] opaque, or [c, h, w, 4] with straight (not premultiplied) alpha. Images smaller than
            h x w, see `Cameras.size`, lie in the upper left corner, padded with zeros.
        names: names of the images, for tables and file names.
        masks: bool [c, h, w], False for pixels that are neither trained nor scored, or None.
        on_disk: whether images and masks are read-only and mapped from files, for scenes larger than the memory.
        sparse_depth: the distances of a sparse model's points, or None.

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
    sparse_depth: KnownDepths | None = None

    def __len__(self) -> int:
        return len(self.names)

    def truth(self, index: int, background: Tensor | None) -> Tensor:
        """Returns one image over `background` ([3]; None is black, as in rendering), float32 [h, w, 3] in 0..1."""
        if self.on_disk:
            check_mapped()
        width, height = self.cameras.size(index)
        image = self.images[index, :height, :width].float() / 255
        if image.shape[-1] == 3:
            return image
        colour = image[..., :3] * image[..., 3:]
        return colour if background is None else colour + background.to(colour) * (1 - image[..., 3:])

    def mask(self, index: int) -> Tensor | None:
        """Returns bool [h, w], False for pixels of an image that are neither trained nor scored; None if all count."""
        width, height = self.cameras.size(index)
        return None if self.masks is None else self.masks[index, :height, :width]


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """Training and test views of the same space.

    Attributes:
        name: a short name that is a valid folder name.
        train: views for training.
        test: held-out views for testing.
        near: distance along a ray at which the scene begins.
        far: distance along a ray at which the scene ends.
        box: float32 [2, 3], lowest and highest corner of an axis-aligned box around the scene, or None if unknown.
        background: the colour behind transparent pixels, "white"; None for opaque images.
        kind: "object" on white, "forward" (cameras look the same way), "inside-out" or "unbounded", see `KINDS`.
        contraction: the contraction of a scene without a box, or around a region of a scene; None to derive a sphere
            from the box or the cameras, see :meth:`space`.
        region: float32 [2, 3], the box that the rays of all trained pixels meet; None for the whole scene.
        transform: float64 [4, 4], transform from the files' coordinates to the scene's.
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
    region: Tensor | None = None
    transform: Tensor = field(default_factory=lambda: torch.eye(4, dtype=torch.float64, device="cpu"))
    notes: tuple[str, ...] = ()

    @property
    def spacing(self) -> str:
        """The spacing of samples along a ray: "linear" through an object, otherwise "disparity"."""
        return "linear" if self.kind == "object" else "disparity"

    def background_colour(self, device: torch.device | str = "cpu") -> Tensor | None:
        """Returns the background as float32 [3] in 0..1, or None."""
        return None if self.background is None else torch.ones(3, dtype=torch.float32, device=device)

    def space(self, contraction: str = "auto", *, cones: bool = False, device: torch.device | str = "cpu") -> Space:
        """Returns the space in which a field is evaluated.

        Args:
            contraction: "none"; "sphere"; "ndc" for forward-facing cameras; or "auto", which is none for a scene with
                a box and without a contraction, otherwise ndc or sphere. The sphere belongs to the scene's contraction,
                or else goes around the scene's box, or else around the origin and all cameras.
            cones: Whether the field takes cones instead of points.
            device: The device of the contraction's tensors.

        Raises:
            SceneError: For ndc without forward-facing cameras, or for a sphere if all cameras are at the origin.
        """
        default, chosen = self.contraction, contraction
        if contraction == "auto":
            is_boxed = self.box is not None and default is None
            chosen = "none" if is_boxed else "ndc" if isinstance(default, Perspective) else "sphere"
        if chosen == "none":
            return Space(None, self.spacing, cones)
        if chosen == "ndc":
            if not isinstance(default, Perspective):
                raise SceneError(f"{self.name}: contraction ndc needs forward-facing cameras, the scene is {self.kind}")
            return Space(
                replace(default, centre=default.centre.to(device), axes=default.axes.to(device)), self.spacing, cones
            )
        if default is not None:
            sphere = Contraction(
                default.centre.to(device), default.near if isinstance(default, Perspective) else default.radius
            )
        elif self.box is not None:
            sphere = Contraction(self.box.mean(0).to(device), float((self.box[1] - self.box[0]).norm()) / 2)
        else:
            radius = float(self.train.cameras.origins.norm(dim=-1).max())
            if radius == 0:
                raise SceneError(f"{self.name}: contraction sphere needs cameras in several places, got one place")
            sphere = Contraction(torch.zeros(3, dtype=torch.float32, device=device), radius)
        return Space(sphere, self.spacing, cones, sphere.radius if self.kind == "unbounded" else None)

    def cube(self, space: Space) -> tuple[tuple[float, ...], ...]:
        """Returns the corners of the networks' input space: a cube around the box, or the cube of the contraction.

        In a box with unequal sides, the cells of a hash grid would be finer along the short sides; in a city, five
        times finer. This would cost table entries, although the images have no finer details there.

        Raises:
            SceneError: If there is neither a box nor a contraction.
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
        """Returns the width of a training pixel at the scene's middle: distance / focal length, in scene units.

        The distance is the mean over all cameras, or over the cameras around a region. In normalised device coordinates
        the width is the same at all distances.
        """
        cameras = self.train.cameras
        focal = float(cameras.intrinsics[:, :2].mean())
        if isinstance(space.contraction, Perspective):
            return 1 / (focal * max(space.contraction.slopes))
        if self.kind in ("forward", "inside-out"):
            return 2 / (1 / self.near + 1 / self.far) / focal
        centre = cameras.origins.new_zeros(3) if self.contraction is None else self.contraction.centre
        if self.box is not None and self.region is None:
            centre = self.box.mean(0)
        distances = (cameras.origins - centre).norm(dim=-1)
        if self.region is not None:  # far cameras see little of it
            reach = max(float((self.region[1] - self.region[0]).norm()) / 2, 1.5 * float(distances.min()))
            distances = distances[distances <= reach]
        return (float(distances.mean()) or self.near) / focal  # the distance is 0 for panoramas from one place
