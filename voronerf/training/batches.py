"""Random batches of training rays with the colours of their pixels.

Letters: r rays of a batch. Colours are in 0..1.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from voronerf.data import Scene
from voronerf.ops.pixel_rays import pixel_rays
from voronerf.rendering.cameras import Rays
from voronerf.rendering.rays import intersect_box


@dataclass(frozen=True)
class Batch:
    """Rays [r], where they enter and leave the scene, and the colours to learn.

    Attributes:
        rays: Origins and unit directions.
        near: [r] depth at which each ray enters the scene.
        far: [r] depth at which it leaves the scene.
        target: [r, 3], the colour of each ray's pixel over the background.
        background: [3], or [r, 3] where it was drawn; None for none.
    """

    rays: Rays
    near: Tensor
    far: Tensor
    target: Tensor
    background: Tensor | None


class RayBatches:
    """Draws rays uniformly from those pixels of the training views whose ray meets the box of the scene.

    A ray that misses the box shows the background whatever the networks are, so there is nothing to learn from it.
    Pixels that a mask leaves out are not drawn either.

    Args:
        scene: The scene; its training views are used.
        device: Where images, cameras and batches live.
        cones: Whether the rays have radii.
    """

    def __init__(self, scene: Scene, device: torch.device, *, cones: bool = False) -> None:
        self.scene = scene
        self.cones = cones
        self.device = device
        self.cameras = scene.train.cameras.to(device)
        self.images = scene.train.images.to(device)
        self.background = scene.background_colour(device)
        self.box = None if scene.box is None else scene.box.to(device)
        self.useful = self._useful_pixels()

    def _useful_pixels(self) -> Tensor | None:
        """Flat indices of the pixels to draw from; None when that is all of them."""
        cameras, masks = self.cameras, self.scene.train.masks
        if self.box is None and masks is None and cameras.sizes is None:
            return None
        found = []
        for image in range(len(cameras)):
            width, height = cameras.size(image)
            chosen = torch.ones(height, width, dtype=torch.bool, device=self.device)
            if masks is not None:
                chosen &= masks[image, :height, :width].to(self.device)
            if self.box is not None:
                rays = cameras.image_rays(image)
                _, _, hit = intersect_box(rays.origins, rays.directions, self.box, self.scene.near, self.scene.far)
                chosen &= hit.reshape(height, width)
            row, column = chosen.nonzero(as_tuple=True)
            found.append((image * cameras.height + row) * cameras.width + column)
        useful = torch.cat(found)
        if not 0 < useful.numel() < self.images[..., 0].numel():
            return None
        return useful

    def __len__(self) -> int:
        """Number of rays to draw from."""
        return self.images[..., 0].numel() if self.useful is None else self.useful.shape[0]

    def draw(self, count: int, generator: torch.Generator, *, random_background: bool = True) -> Batch:
        """A batch of ``count`` rays, drawn with replacement.

        Images with an alpha channel lie over a colour that is drawn for each ray, or over that of the scene.
        """
        index = torch.randint(len(self), (count,), generator=generator, device=generator.device).to(self.device)
        if self.useful is not None:
            index = self.useful[index]
        background = self.background
        if random_background and self.images.shape[-1] == 4:
            background = torch.rand(count, 3, generator=generator, device=generator.device).to(self.device)
        cameras = self.cameras
        found = pixel_rays(
            cameras.poses,
            cameras.intrinsics,
            self.images,
            index,
            near=float(self.scene.near),
            far=float(self.scene.far),
            box=self.box,
            distortion=cameras.distortion,
            fisheye=cameras.fisheye,
            background=background,
        )
        radii = None
        if self.cones:
            radii = cameras.radii(found.directions, index // (cameras.width * cameras.height))
        return Batch(Rays(found.origins, found.directions, radii), found.near, found.far, found.colour, background)
