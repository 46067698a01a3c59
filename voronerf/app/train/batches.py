"""Random batches of training rays with the colours of their pixels.

Letters: r rays of a batch. Colours are in 0..1.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from voronerf.app.scenes import Scene
from voronerf.app.scenes.scene import Sightings
from voronerf.app.scenes.store import Pages
from voronerf.app.train.appearance import Appearance
from voronerf.app.train.refinement import Refinement
from voronerf.nerf import Batch
from voronerf.nerf.cameras import Rays
from voronerf.nerf.occupancy import draw_seed
from voronerf.nerf.rays import intersect_box
from voronerf.ops.draw_pixels import Runs, draw_pixels

#: Share of the rays that are drawn from the sightings of points, where these are learnt from.
SEEN = 0.25


class RayBatches:
    """Draws rays uniformly from those pixels of the training views whose ray meets the box of the scene.

    A ray that misses the box shows the background whatever the networks are, so there is nothing to learn from it.
    Pixels that a mask leaves out are not drawn either. Images on disk stay there; their batches are the same.

    Args:
        scene: The scene; its training views are used.
        device: Where batches live, and images that are in memory.
        cones: Whether the rays have radii.
        sightings: Whether a share of the rays, `SEEN`, are through sightings of points.
        views: int64, the training views to draw from; None for all.
        appearance: Of the pictures; batches have their colours without it.
        refinement: Of the cameras, which change.
        backend: Of the ops.
    """

    def __init__(
        self,
        scene: Scene,
        device: torch.device,
        *,
        cones: bool = False,
        sightings: bool = False,
        views: Tensor | None = None,
        appearance: Appearance | None = None,
        refinement: Refinement | None = None,
        backend: str = "auto",
    ) -> None:
        self.scene, self.views, self.backend = scene, views, backend
        self.cones, self.appearance, self.refinement = cones, appearance, refinement
        self.device = device
        self.place = torch.device("cpu") if scene.train.on_disk else device
        self.cameras = (scene.train.cameras if refinement is None else refinement.cameras).to(self.place)
        self.images = scene.train.images.to(self.place)
        self.pages = Pages(self.images) if scene.train.on_disk else None
        self.background = scene.background_colour(self.place)
        self.box = None if scene.box is None else scene.box.to(self.place)
        self.useful = self._useful_pixels(self.box)
        self.sightings = None
        if sightings and scene.train.sightings is not None:
            self.sightings = Sightings(*(tensor.to(self.place) for tensor in scene.train.sightings))
            if views is not None:
                size = self.cameras.width * self.cameras.height
                own = torch.isin(self.sightings.pixels // size, views.to(self.place))
                self.sightings = Sightings(*(tensor[own] for tensor in self.sightings))
                self.sightings = self.sightings if own.any() else None

    def _useful_pixels(self, box: Tensor | None) -> Runs | None:
        """The pixels to draw from; None when that is all of them."""
        cameras, masks = self.cameras, self.scene.train.masks
        if box is None and masks is None and cameras.sizes is None and self.views is None:
            return None
        found = []
        for image in range(len(cameras)) if self.views is None else self.views.tolist():
            width, height = cameras.size(image)
            chosen = torch.ones(height, width, dtype=torch.bool, device=self.place)
            if masks is not None:
                chosen &= masks[image, :height, :width].to(self.place)
            if box is not None:
                rays = cameras.image_rays(image, backend=self.backend)
                _, _, hit = intersect_box(rays.origins, rays.directions, box, self.scene.near, self.scene.far)
                chosen &= hit.reshape(height, width)
            edges = torch.nn.functional.pad(chosen.to(torch.int8), (1, 1)).diff(dim=1)
            row, column = (edges == 1).nonzero(as_tuple=True)
            last = (edges == -1).nonzero(as_tuple=True)[1]
            found.append(torch.stack(((image * cameras.height + row) * cameras.width + column, last - column)))
        start, length = torch.cat(found, dim=1)
        return Runs.of(start, length) if 0 < int(length.sum()) < self._pixels else None

    @property
    def _pixels(self) -> int:
        return self.images.numel() // self.images.shape[-1]

    def __len__(self) -> int:
        """Number of rays to draw from."""
        return self._pixels if self.useful is None else self.useful.total

    def draw(self, count: int, generator: torch.Generator, *, random_background: bool = True) -> Batch:
        """A batch of ``count`` rays, drawn with replacement.

        Where sightings are learnt from, the last `SEEN` of them are drawn from these. Images with an alpha channel lie
        over a colour that is drawn for each ray, or over that of the scene.
        """
        several = 0 if self.sightings is None else int(SEEN * count)
        seed = draw_seed(self.place, generator)
        index, uniforms = draw_pixels(seed, count, len(self), runs=self.useful, backend=self.backend)
        seen = None
        if several and self.sightings is not None:
            seed = draw_seed(self.place, generator)
            chosen, _ = draw_pixels(seed, several, len(self.sightings.pixels), backend=self.backend)
            index[count - several :] = self.sightings.pixels[chosen]
            seen = self.sightings.distances[chosen].to(self.device)
        if self.pages is not None:
            self.pages.fetch(index)
        background = uniforms if random_background and self.images.shape[-1] == 4 else self.background
        cameras = self.cameras
        found = cameras.pixel_rays(
            self.images,
            index,
            near=float(self.scene.near),
            far=float(self.scene.far),
            box=self.box,
            background=background,
            backend=self.backend,
        )
        radii = None
        if self.cones:
            radii = cameras.radii(found.directions, index // (cameras.width * cameras.height))
        origins, directions, near, far, colour = (tensor.to(self.device) for tensor in found)
        radii = None if radii is None else radii.to(self.device)
        background = None if background is None else background.to(self.device)
        batch = Batch(Rays(origins, directions, radii), near, far, colour, background, seen)
        if self.appearance is None and self.refinement is None:
            return batch
        view = (index // (cameras.width * cameras.height)).to(self.device)
        batch = replace(batch, view=view)
        return batch if self.appearance is None else self.appearance.neutral(batch)
