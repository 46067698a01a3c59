"""Random batches of training rays with the colours of their pixels. r rays of a batch; colours are in 0..1."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from voronerf.nerf.cameras import Cameras, Rays
from voronerf.nerf.distributed import ALONE
from voronerf.nerf.occupancy import draw_seed
from voronerf.nerf.replay import replayed
from voronerf.nerf.volume import Batch
from voronerf.ops._core.rows import following_count
from voronerf.ops.draw_pixels import KnownPixels, PixelRuns, draw_pixels
from voronerf.ops.unseen_rays import unseen_rays

#: The fraction of rays that are drawn through the points of a sparse model, if there is one.
SPARSE = 0.25
#: Unseen rays start beside a camera, so no pixel shows their colour; they come in triples of neighbours
#: (`voronerf.ops.unseen_rays`). UNSEEN is the number of triples per ray of a batch. TILT is the largest difference
#: between the directions of a middle ray and its neighbours, along each axis.
UNSEEN, TILT = 1 / 12, 0.15


class RaySource(Protocol):
    """A source of training rays; a `TrainingStep` calls it once at the start of each step.

    Attributes:
        device: The device of the rays.
        ranks: A `Ranks`, set by a `TrainingStep` with several processes: each process should draw different rays.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Batch, Rays
        >>> class Sphere:  # rays from a sphere towards its centre; all targets are white
        ...     device = torch.device("cpu")
        ...     def draw(self, count, generator):
        ...         inwards = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
        ...         ends = torch.full((count,), 2.0), torch.full((count,), 6.0)
        ...         return Batch(Rays(-4 * inwards, inwards), *ends, torch.ones(count, 3))
        >>> len(Sphere().draw(5, torch.Generator()).rays)
        5
    """

    device: torch.device

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        """Returns the rays of a step, and their colours.

        Args:
            count: The requested number of rays, at least 1.
            generator: Random generator on the device.

        Returns:
            The batch; its number of rays may differ from ``count`` and from step to step.
        """


@replayed
class RayBatches:
    """A source of random rays through pixels of pictures; all these rays meet the box of the scene.

    The networks learn nothing from a ray that misses the box, since its pixel shows the background. Masked pixels are
    not drawn either. All other pixels are equally likely.

    Args:
        cameras: c cameras.
        images: uint8 [c, h, w, 3] opaque, or [c, h, w, 4] with straight alpha, on the device where pixels are drawn.
        near: The distance along a ray at which the scene begins.
        far: The distance along a ray at which the scene ends.
        box: [2, 3], the box of the scene; None for no box.
        region: [2, 3], a box that the rays must meet, too; it does not change their near and far. None for no such box.
        background: [3], the colour behind the scene; None for black.
        random_background: Whether to draw a background colour for each ray, for images with alpha, and for opaque
            images if ``background`` is None. A translucent surface then never has the right colour, so surfaces learn
            to be opaque.
        masks: bool [c, h, w], False for pixels that are never drawn; None for no masks.
        sparse: The pixels that show points of a sparse model (int64 [s], flat indices over all images), and the
            distances of the points (float32 [s]). The fraction `SPARSE` of the rays is drawn from these pixels. None
            for no sparse model.
        unseen: The largest offset of an unseen ray's origin from a camera, along each axis; 0 for no unseen rays.
            Unseen rays have no target colour; they serve loss terms such as `SmoothDepth`. The last rays of a batch of
            n rays are n * `UNSEEN` triples of neighbouring unseen rays. Must be 0 with a box.
        cones: Whether the rays have radii.
        fetch: Function that is called with the pixels, int64 [r], of a batch before they are read; for images on disk.
        device: The device of the batches; None for the device of the images.
        backend: The backend of the ops.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import RayBatches, orbit_cameras
        >>> cameras = orbit_cameras(2, radius=2.0, elevation=0.0, width=4, height=3, focal=4.0)
        >>> images = torch.zeros(2, 3, 4, 3, dtype=torch.uint8)
        >>> rays = RayBatches(cameras, images, near=1.0, far=3.0)
        >>> len(rays), rays.draw(5, torch.Generator().manual_seed(0)).target.shape
        (24, torch.Size([5, 3]))
    """

    def __init__(
        self,
        cameras: Cameras,
        images: Tensor,
        *,
        near: float,
        far: float,
        box: Tensor | None = None,
        region: Tensor | None = None,
        background: Tensor | None = None,
        random_background: bool = True,
        masks: Tensor | None = None,
        sparse: tuple[Tensor, Tensor] | None = None,
        unseen: float = 0.0,
        cones: bool = False,
        fetch: Callable[[Tensor], None] | None = None,
        device: torch.device | str | None = None,
        backend: str = "auto",
    ) -> None:
        self.place = images.device
        self.device = torch.device(self.place if device is None else device)
        self.cameras, self.images, self.near, self.far = cameras.to(self.place), images, float(near), float(far)
        self.box, self.background = (None if each is None else each.to(self.place) for each in (box, background))
        self.random_background = random_background and (images.shape[-1] == 4 or background is None)
        self.cones, self.backend = cones, backend
        self.ranks = ALONE
        if fetch is not None:
            self.fetch = fetch  # type: ignore[method-assign, assignment]
        if unseen and box is not None:
            message = "RayBatches: unseen must be 0 with a box, since unseen rays may miss it"
            raise ValueError(f"{message}, got {unseen}")
        self.unseen = unseen
        self.useful = self._useful_pixels(masks, [each for each in (self.box, region) if each is not None])
        self.sparse = None
        if sparse is not None:
            pixels, distances = (tensor.to(self.place) for tensor in sparse)
            self.sparse = (pixels, distances) if len(pixels) else None

    def _useful_pixels(self, masks: Tensor | None, boxes: Sequence[Tensor]) -> PixelRuns | None:
        """Returns the pixels to draw from; None for all pixels."""
        cameras = self.cameras
        if not boxes and masks is None and cameras.sizes is None:
            return None
        runs = []
        for image in range(len(cameras)):
            width, height = cameras.size(image)
            chosen = torch.ones(height, width, dtype=torch.bool, device=self.place)
            if masks is not None:
                chosen &= masks[image, :height, :width].to(self.place)
            for box in boxes:
                bounds: dict[str, Any] = {"near": self.near, "far": self.far, "box": box.to(self.place)}
                _, first, last = cameras.image_rays_between(image, backend=self.backend, **bounds)
                chosen &= (last > first).reshape(height, width)
            edges = torch.nn.functional.pad(chosen.to(torch.int8), (1, 1)).diff(dim=1)
            row, column = (edges == 1).nonzero(as_tuple=True)
            last = (edges == -1).nonzero(as_tuple=True)[1]
            runs.append(torch.stack(((image * cameras.height + row) * cameras.width + column, last - column)))
        start, length = torch.cat(runs, dim=1)
        if not (count := int(length.sum())):
            raise ValueError("RayBatches: masks and boxes must leave pixels to draw rays of, got none")
        return PixelRuns.of(start, length) if count < self._pixel_count else None

    @property
    def _pixel_count(self) -> int:
        return self.images.numel() // self.images.shape[-1]

    def __len__(self) -> int:
        """Returns the number of pixels that rays are drawn from."""
        return self._pixel_count if self.useful is None else self.useful.total

    def stop_unseen_rays(self) -> None:
        """Stops drawing unseen rays."""
        self.unseen = 0.0

    def fetch(self, pixels: Tensor) -> None:
        """Prepares the pixels, int64 [r], that a batch reads next; does nothing without the argument ``fetch``."""

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        """Draws ``count`` rays with replacement; the first rays go through points of the sparse model."""
        seed = self.ranks.seed(draw_seed(self.place, generator))
        known = None
        if self.sparse is not None and (several := following_count(count, lambda rays: int(SPARSE * rays))):
            known = KnownPixels(*self.sparse, several)
        index, uniforms, distances = draw_pixels(
            seed, count, len(self), runs=self.useful, known_pixels=known, backend=self.backend
        )
        depths = None if known is None else distances.to(self.device)
        self.fetch(index)
        background = uniforms if self.random_background else self.background
        cameras = self.cameras
        rays_seen = cameras.pixel_rays(
            self.images,
            index,
            near=self.near,
            far=self.far,
            box=self.box,
            background=background,
            backend=self.backend,
        )
        triples = following_count(count, lambda rays: int(UNSEEN * rays)) if self.unseen else 0
        if triples:
            origins, directions = rays_seen.origins, rays_seen.directions
            unseen_rays(origins, directions, seed, triples=triples, move=self.unseen, tilt=TILT, backend=self.backend)
        radii = None
        if self.cones:
            radii = cameras.radii(rays_seen.directions, index // (cameras.width * cameras.height)).to(self.device)
        origins, directions, near, far, colour = rays_seen
        if self.device != self.place:
            origins, directions, near, far, colour = (tensor.to(self.device) for tensor in rays_seen)
            background = None if background is None else background.to(self.device)
        return Batch(Rays(origins, directions, radii), near, far, colour, background, depths, triples)
