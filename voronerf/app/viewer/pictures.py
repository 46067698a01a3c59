"""What a viewer shows: the panes of a rendered camera, hidden cells, the cell behind a pixel.

h x w pixels, k cells. Pictures are uint8 [h, w, 3].
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from voronerf.app.evaluate.panels import (
    picture_of_cells,
    picture_of_colour,
    picture_of_depth,
)
from voronerf.app.run import Run
from voronerf.app.scenes import Scene
from voronerf.app.train.config import ConfigError
from voronerf.app.viewer.cameras import crop_camera
from voronerf.app.viewer.errors import ViewErrors
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.field import Field
from voronerf.nerf.renderer import RenderedImage, Renderer, render_camera
from voronerf.router import VoronoiRouter
from voronerf.town import editing
from voronerf.town.parts import Parts, Solid

PANES = ("colour", "depth", "opacity", "error", "cells")


@dataclass(frozen=True)
class Look:
    """What one browser shows, besides its camera.

    Attributes:
        pane: one of `PANES`.
        level: of a nested diagram whose cells are shown, 1 is the coarsest.
        hidden: leaves that are not rendered.
        crop: lowest and highest corner of the box that is rendered, or None for the scene's.
    """

    pane: str = "colour"
    level: int = 1
    hidden: frozenset[int] = frozenset()
    crop: tuple[tuple[float, ...], tuple[float, ...]] | None = None


@dataclass
class Subject:
    """What is viewed: a trained run, or one in training.

    Attributes:
        name: for titles.
        folder: the run directory.
        scene: images and cameras.
        router: its diagram has the cells.
        renderer: how rays become colours.
        weights: a context in which the networks have the weights to show.
        run: what can be exported and trained further; None for a run in training.
    """

    name: str
    folder: Path
    scene: Scene
    router: VoronoiRouter | Parts
    renderer: Renderer
    weights: Callable[[], AbstractContextManager[None]] = nullcontext
    run: Run | None = None

    @classmethod
    def of(cls, run: Run, scene: Scene | None = None) -> Subject:
        """A run; the scene may have the images that the run's own lacks."""
        return cls(run.path.resolve().name, run.path, scene or run.scene, run.router, run.renderer, run=run)

    @property
    def diagram(self) -> VoronoiDiagram:
        """The cells, which a split replaces."""
        return self.router.diagram


class VisibleCells(nn.Module):
    """A field without the density of hidden cells.

    Args:
        field: the whole field.
        diagram: of its cells.
        hidden: bool [k].
        backend: of the look-up.
    """

    def __init__(self, field: Field, diagram: VoronoiDiagram, hidden: Tensor, backend: str) -> None:
        super().__init__()
        self.field, self.diagram, self.hidden, self.backend = field, diagram, hidden, backend

    def forward(self, positions: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`voronerf.nerf.Field`."""
        colour, density = self.field(positions, directions, ray_index)
        cells = self.diagram.locate(positions[:, :3].contiguous(), backend=self.backend)
        return colour, density.masked_fill(self.hidden[cells.long()], 0)


def groups_of(diagram: VoronoiDiagram, level: int) -> Tensor:
    """int64 [k]: the cell of a level, 1 being the coarsest, that each leaf lies in; numbered in the order of leaves."""
    paths = diagram.paths()[:, : max(1, level)].cpu()
    starts = torch.ones(len(paths), dtype=torch.bool)
    starts[1:] = (paths[1:] != paths[:-1]).any(1)
    return starts.cumsum(0) - 1


def space_from(scene: Scene, camera: Cameras) -> Scene:
    """A scene for a camera that may be anywhere: its box, where it has one, is seen from outside and from inside."""
    if scene.box is None:
        return scene
    diagonal = float((scene.box[1] - scene.box[0]).norm())
    away = float((camera.origins[0] - scene.box.mean(0)).norm())
    return replace(scene, near=0.01 * diagonal, far=away + diagonal)


def render_bands(subject: Subject, camera: Cameras, look: Look, rows: int) -> Iterator[RenderedImage]:
    """Renders a camera in bands of `rows` rows from top to bottom, with what a look hides and crops."""
    renderer, scene = subject.renderer, space_from(subject.scene, camera)
    if look.hidden:
        hidden = torch.zeros(subject.diagram.num_cells, dtype=torch.bool)
        hidden[list(look.hidden)] = True
        hidden = hidden.to(renderer.device)
        parts = subject.router
        fields: dict[str, Field] = {
            name: VisibleCells(field, subject.diagram, hidden, renderer.backend)
            if not isinstance(parts, Parts)
            else parts.without(hidden)
            for name, field in renderer.fields.items()
        }
        renderer = copy.copy(renderer)
        renderer.fields = fields
    if look.crop is not None:
        scene = replace(scene, box=torch.tensor(look.crop))
    heaviest = look.pane in ("cells", "error")
    for top in range(0, camera.height, rows):
        band = crop_camera(camera, 0, top, camera.width, min(rows, camera.height - top))
        with subject.weights():
            yield render_camera(renderer, scene, band, 0, heaviest=heaviest)


def stack_bands(bands: list[RenderedImage]) -> RenderedImage:
    """The image that bands make, on the CPU."""
    return RenderedImage(*(torch.cat(parts).cpu() for parts in zip(*bands)))


def render_look(subject: Subject, camera: Cameras, look: Look) -> RenderedImage:
    """Renders a camera at once; see :func:`render_bands`."""
    return stack_bands(list(render_bands(subject, camera, look, camera.height)))


def cells_of(subject: Subject, places: Tensor) -> Tensor:
    """The leaves int64 [...] of places [..., 3], as `RenderedImage.heaviest` has them."""
    where = places.to(subject.renderer.device)
    if isinstance(subject.router, Parts):  # where no part speaks there is nothing to see, in the last of the cells
        return subject.router.assign(where.reshape(-1, 3)).reshape(where.shape[:-1]).cpu().long()
    return subject.diagram.locate(where, backend=subject.renderer.backend).cpu().long()


def picture_of(subject: Subject, camera: Cameras, image: RenderedImage, look: Look, errors: ViewErrors) -> Tensor:
    """The picture of a pane.

    Args:
        subject: what is viewed.
        camera: that was rendered.
        image: what it saw.
        look: whose pane is drawn.
        errors: of the training views, for the error pane.
    """
    if look.pane == "depth":
        return picture_of_depth(image.depth, image.opacity)
    if look.pane == "opacity":
        return picture_of_colour(image.opacity[..., None].expand(*image.opacity.shape, 3))
    if look.pane == "error":
        return errors.picture(camera, image)
    if look.pane == "cells":
        groups = groups_of(subject.diagram, look.level)[cells_of(subject, image.heaviest)]
        return picture_of_cells(groups, image.opacity, image.colour)
    return picture_of_colour(image.colour)


def cell_at(subject: Subject, camera: Cameras, look: Look, x: float, y: float) -> int | None:
    """The leaf that a pixel shows, or None if it shows nothing.

    Args:
        subject: what is viewed.
        camera: of the whole picture.
        look: hidden cells are not found.
        x: position from the left, 0..1.
        y: position from the top, 0..1.
    """
    sides = ((x, camera.width), (y, camera.height))
    left, top = (min(int(max(0.0, min(share, 1.0)) * size), size - 1) for share, size in sides)
    image = render_look(subject, crop_camera(camera, left, top, 1, 1), replace(look, pane="cells"))
    return int(cells_of(subject, image.heaviest)) if float(image.opacity) > 0.5 else None


def save_shown(run: Run, look: Look) -> Path:
    """Writes what a look shows of a run as a run beside it; returns the folder.

    Raises:
        ConfigError: nothing is hidden, or nothing is left.
        OSError: it cannot be written.
    """
    if not look.hidden and look.crop is None:
        raise ConfigError("everything is shown: hide cells or crop first")
    source = run.source
    if look.hidden:
        shown = torch.ones(source.parts.num_cells, dtype=torch.bool)
        shown[list(look.hidden)] = False
        source = editing.cut(source, shown)
    if look.crop is not None:
        source = editing.cut(source, Solid.box(*look.crop))
    folder = run.path.resolve()
    names = (f"{folder.name}-cut", *(f"{folder.name}-cut-{i}" for i in range(2, 1000)))
    out = next(path for name in names if not (path := folder.parent / name).exists())
    editing.write(source, out)
    return out
