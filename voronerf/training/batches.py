"""Random batches of training rays with the colours of their pixels.

Letters: r rays of a batch. Colours are in 0..1, straight (not premultiplied) where there is an alpha channel.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from voronerf.data import Scene
from voronerf.rendering.cameras import Rays
from voronerf.rendering.rays import intersect_box


@dataclass(frozen=True)
class Batch:
    """Rays [r], where they enter and leave the scene, and the colours of their pixels.

    Attributes:
        rays: Origins and unit directions.
        near: [r] depth at which each ray enters the scene.
        far: [r] depth at which it leaves the scene.
        colour: [r, 3], straight.
        alpha: [r, 1], or None for opaque images.
    """

    rays: Rays
    near: Tensor
    far: Tensor
    colour: Tensor
    alpha: Tensor | None

    def target(self, background: Tensor | None) -> Tensor:
        """The colour to learn: that of the images over ``background`` ([3] or [r, 3])."""
        if self.alpha is None or background is None:
            return self.colour
        return self.colour * self.alpha + background * (1 - self.alpha)


class RayBatches:
    """Draws rays uniformly from those pixels of the training views whose ray meets the box of the scene.

    A ray that misses the box shows the background whatever the networks are, so there is nothing to learn from it.

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
        images = scene.train.images.to(device)
        self.pixels = images.reshape(-1, images.shape[-1])
        self.box = None if scene.box is None else scene.box.to(device)
        self.useful = None if self.box is None else self._rays_that_meet(self.box)

    def _rays_that_meet(self, box: Tensor) -> Tensor | None:
        """Flat indices of the pixels whose rays meet the box; None when that is all of them."""
        found = []
        per_image = self.cameras.width * self.cameras.height
        for image in range(self.cameras.poses.shape[0]):
            rays = self.cameras.image_rays(image)
            _, _, hit = intersect_box(rays.origins, rays.directions, box, self.scene.near, self.scene.far)
            found.append(hit.nonzero()[:, 0] + image * per_image)
        useful = torch.cat(found)
        if not 0 < useful.numel() < self.pixels.shape[0]:
            return None
        return useful

    def __len__(self) -> int:
        """Number of rays to draw from."""
        return self.pixels.shape[0] if self.useful is None else self.useful.shape[0]

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        """A batch of ``count`` rays, drawn with replacement."""
        index = torch.randint(len(self), (count,), generator=generator, device=generator.device).to(self.device)
        if self.useful is not None:
            index = self.useful[index]
        width = self.cameras.width
        per_image = width * self.cameras.height
        pixel = index % per_image
        rays = self.cameras.rays(index // per_image, pixel % width, pixel // width, cones=self.cones)
        near = torch.full((count,), float(self.scene.near), device=self.device)
        far = torch.full((count,), float(self.scene.far), device=self.device)
        if self.box is not None:
            near, far, _ = intersect_box(rays.origins, rays.directions, self.box, self.scene.near, self.scene.far)
        values = self.pixels[index].float() / 255
        return Batch(rays, near, far, values[:, :3], values[:, 3:] if values.shape[1] == 4 else None)
