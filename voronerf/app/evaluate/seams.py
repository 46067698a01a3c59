"""How much a picture jumps across the borders of cells.

A border shows where the networks on its two sides disagree about one and the same place. So the test views are rendered
twice, with every sample in its own cell (colour C) and with neighbouring cells blended within a narrow margin of their
borders (colour B, see `voronerf.diagram`), where a pixel's own cell gives the share s of its answer to its neighbours.
Over the pixels p that show a place in a margin (opacity above 1/2, the heaviest sample in a margin, s its share times
the opacity),

    seam = sum_p |C_p - B_p| / sum_p s_p

with |.| the mean over the channels: the step in colour, density's effect on it included, that one sees per share handed
over, which is the colour of one side less that of the other. Detail of the scene itself does not count, unlike in
gradients of the picture, so the measure needs no truth and is as good at 100 x 100 pixels after a minute of training.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from voronerf.app.evaluate.scores import view_numbers
from voronerf.app.scenes import Scene
from voronerf.diagram.blending import Mixture
from voronerf.nerf.renderer import RenderedImage
from voronerf.router import VoronoiRouter

#: The margin as a part of the diagonal of the scene's box: 0.04 of a Blender scene, a pixel and a half at 100 x 100.
MARGIN = 0.01


@torch.no_grad()
def seam(
    router: VoronoiRouter,
    scene: Scene,
    picture: Callable[[int], RenderedImage],
    *,
    views: int | None = None,
    margin: float | None = None,
) -> float:
    """The mean step in colour across visible borders of cells, in 0..1; 0 for one network, NaN where no border shows.

    Args:
        router: whose `blend` is changed while this runs.
        scene: its test views are rendered.
        picture: renders a test view through the router, without randomness.
        views: evenly spread test views; None for all.
        margin: in the units of the space that the cells live in; None for a hundredth of the diagonal of the scene's
            box, or of the centres'.

    Raises:
        ValueError: a margin that is not positive.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF, VoronoiRouter
        >>> from voronerf.app.scenes import load_scene
        >>> from voronerf.app.evaluate import seam
        >>> from voronerf.nerf import Renderer, Stratified
        >>> scene = load_scene("builtin", downscale=20)
        >>> field = NeRF(width=16, depth=2)
        >>> _ = torch.nn.init.ones_(field.density.bias)  # opaque, so that borders show
        >>> router = VoronoiRouter(field, 0.1 * torch.eye(3))  # three cells that are copies
        >>> renderer = Renderer({"field": router}, Stratified(8))
        >>> cameras = scene.test.cameras
        >>> def picture(view):
        ...     return renderer.image(cameras, view, near=scene.near, far=scene.far, box=scene.box)
        >>> seam(router.eval(), scene, picture, views=1) < 1e-3
        True
    """
    if margin is not None and not 0 < margin < float("inf"):
        raise ValueError(f"seam: margin must be positive and finite, got {margin}")
    if router.num_cells == 1:
        return 0.0
    if margin is None:
        centres = router.diagram.centres
        box = torch.stack((centres.amin(0), centres.amax(0))) if scene.box is None else scene.box
        margin = MARGIN * float((box[1] - box[0]).norm())
    before, change, given = router.blend, 0.0, 0.0
    try:
        for view in view_numbers(len(scene.test), views):
            router.blend = 0.0
            hard = picture(view)
            router.blend = margin
            soft = picture(view)
            mixture = Mixture.of(router.diagram, hard.heaviest, margin, router.backend)
            if mixture is None:
                continue
            share = (1 - mixture.kept.reshape(hard.opacity.shape)) * hard.opacity
            shown = (share > 0) & (hard.opacity > 0.5)
            change += float((hard.colour - soft.colour).abs().mean(-1)[shown].double().sum())
            given += float(share[shown].double().sum())
    finally:
        router.blend = before
    return change / given if given > 0 else math.nan
