"""The errors of training views, painted on what another camera sees.

h x w pixels. A pixel of a free camera shows a place of the scene; the training view that is nearest to the camera shows
the same place at another pixel, where there is a photograph to compare with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from voronerf.app.evaluate.panels import picture_of_error
from voronerf.app.scenes import Scene
from voronerf.app.viewer.cameras import nearest_view
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.renderer import RenderedImage

#: Pixels along the longer side of a training view that is compared.
LARGEST = 256
#: A place counts as seen by a view if it is at most this much farther than what the view shows there.
BEHIND = 0.03
#: Colour of the places that the nearest view does not see.
UNSEEN = (150, 160, 175)


@dataclass(frozen=True, eq=False)
class ViewError:
    """A training view beside its picture."""

    number: int  # of the view
    camera: Cameras  # of the reduced view
    error: Tensor  # [h, w, 3], rendered minus true colour
    image: RenderedImage  # what was rendered


class ViewErrors:
    """Compares training views when they are asked for, and keeps the last one.

    Args:
        scene: with the views.
        render: renders a camera, with the place that each pixel shows.
    """

    def __init__(self, scene: Scene, render: Callable[[Cameras], RenderedImage]) -> None:
        self.scene, self.render = scene, render
        self.last: ViewError | None = None

    def forget(self) -> None:
        """Compares anew at the next use: the weights have changed."""
        self.last = None

    def nearest(self, camera: Cameras) -> ViewError | None:
        """The comparison of the training view that is nearest to a camera; None while there are no images."""
        if not len(self.scene.train.images):
            return None
        number = nearest_view(self.scene.train.cameras, camera.origins[0], camera.forward[0])
        if self.last is None or self.last.number != number:
            self.last = self._compare(number)
        return self.last

    def _compare(self, number: int) -> ViewError:
        train = self.scene.train
        truth = train.truth(number, self.scene.background_colour())
        factor = -(-max(truth.shape[:2]) // LARGEST)
        width, height = train.cameras.size(number)
        camera = replace(train.cameras[[number]], width=width, height=height, sizes=None).downscaled(factor)
        truth = torch.nn.functional.avg_pool2d(truth.movedim(-1, 0), factor).movedim(0, -1)
        image = self.render(camera)
        return ViewError(number, camera, image.colour.clamp(0, 1) - truth, image)

    def picture(self, camera: Cameras, image: RenderedImage) -> Tensor:
        """The errors of the nearest view, at the places that another camera sees; grey where that view does not.

        Args:
            camera: of the picture.
            image: what it sees.
        """
        view = self.nearest(camera)
        if view is None:
            return torch.tensor(UNSEEN, dtype=torch.uint8).repeat(*image.opacity.shape, 1)
        rays = camera.image_rays(0)
        places = rays.origins + self._depth(image).reshape(-1, 1) * rays.directions
        pixels, ahead = view.camera.project(places, 0)
        inside = (ahead > 0) & (pixels >= 0).all(-1)
        inside &= (pixels[:, 0] < view.camera.width) & (pixels[:, 1] < view.camera.height)
        column, row = torch.where(inside[:, None], pixels, 0).long().unbind(-1)
        distance = (places - view.camera.origins[0]).norm(dim=-1)
        seen = distance <= self._depth(view.image)[row, column] * (1 + BEHIND)
        seen |= (image.opacity.reshape(-1) < 0.5) & (view.image.opacity[row, column] < 0.5)
        seen &= inside
        shape = image.opacity.shape
        picture = picture_of_error(view.error[row, column].reshape(*shape, 3), torch.zeros(()))
        picture[~seen.reshape(shape)] = torch.tensor(UNSEEN, dtype=torch.uint8)
        return picture

    def _depth(self, image: RenderedImage) -> Tensor:
        """Distances [h, w]; the far bound of the scene where a pixel is at least half empty."""
        return torch.where(image.opacity > 0.5, image.depth, self.scene.far)

    def psnr(self, camera: Cameras, shows: Callable[[Tensor], Tensor]) -> tuple[str, float | None] | None:
        """The PSNR in dB of some pixels of the nearest view.

        Args:
            camera: whose nearest view it is.
            shows: which of the places [h, w, 3] of pixels count, bool [h, w].

        Returns:
            The name of the view, and the PSNR, which is None if none of its pixels counts; None without images.
        """
        view = self.nearest(camera)
        if view is None:
            return None
        counted = shows(view.image.heaviest) & (view.image.opacity > 0.5)
        name = self.scene.train.names[view.number]
        if not counted.any():
            return name, None
        return name, float(-10 * view.error[counted].square().mean().clamp_min(1e-10).log10())
