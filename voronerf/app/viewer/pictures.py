"""The pictures of a viewer: colour, depth, opacity and cells, without hidden cells; and the cell that a pixel shows.

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

from voronerf.app.evaluate.panels import picture_of_cells, picture_of_colour, picture_of_depth
from voronerf.app.render.camera import crop_camera, render_camera
from voronerf.app.run import HasCells, Run
from voronerf.app.scenes import Scene
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.field import Field
from voronerf.nerf.renderer import RenderedImage, Renderer

PANES = ("colour", "depth", "opacity", "cells")
#: Grey values of the backgrounds.
BACKGROUNDS = {"white": 1.0, "grey": 0.5, "black": 0.0}


#: Colour of the outline around the picked cell; the palette does not have it.
OUTLINE = (255, 0, 255)


@dataclass(frozen=True)
class Look:
    """The choices of one browser, besides its camera.

    Attributes:
        pane: One of `PANES`.
        background: One of `BACKGROUNDS`, behind the colours.
        level: The level of a nested diagram whose cells are shown; 1 is the coarsest.
        hidden: The leaves that are not rendered.
        crop: Lowest and highest corner of the rendered box, or None for the scene's box.
        picked: The leaf that was clicked on, whose cell gets an outline, or None.
    """

    pane: str = "colour"
    background: str = "white"
    level: int = 1
    hidden: frozenset[int] = frozenset()
    crop: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    picked: int | None = None


@dataclass(frozen=True)
class Subject:
    """A run in a viewer, trained or in training.

    Attributes:
        name: The name in titles.
        folder: The run directory.
        scene: The cameras, and the images if they are loaded.
        router: The field with its cells, which has the diagram and assigns positions to cells.
        renderer: The renderer of the run.
        weights: Returns a context in which the networks have the weights to show.
    """

    name: str
    folder: Path
    scene: Scene
    router: HasCells
    renderer: Renderer
    weights: Callable[[], AbstractContextManager[None]] = nullcontext

    @classmethod
    def of(cls, run: Run) -> Subject:
        """Returns the subject of a trained run."""
        return cls(run.path.resolve().name, run.path, run.scene, run.router, run.renderer)

    @property
    def diagram(self) -> VoronoiDiagram:
        """The current diagram; a split replaces it."""
        return self.router.diagram


class VisibleCells(nn.Module):
    """A field that sets the density in hidden cells, bool [k], to 0."""

    def __init__(self, field: Field, router: HasCells, hidden: Tensor) -> None:
        super().__init__()
        self.field, self.router, self.hidden = field, router, hidden

    def forward(self, positions: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """Evaluates the field; see :class:`voronerf.nerf.Field`."""
        colour, density = self.field(positions, directions, ray_index)
        cells = self.router.assign(positions[:, :3].contiguous())
        return colour, density.masked_fill(self.hidden[cells.long()], 0)


def groups_of(diagram: VoronoiDiagram, level: int) -> Tensor:
    """Returns int64 [k], the number of each leaf's cell on a level; 1 is the coarsest level.

    The cells of a level are numbered in the order of their leaves.
    """
    paths = diagram.paths()[:, : max(1, level)].cpu()
    starts = paths.new_ones(len(paths), dtype=torch.bool)
    starts[1:] = (paths[1:] != paths[:-1]).any(1)
    return starts.cumsum(0) - 1


def space_from(scene: Scene, camera: Cameras) -> Scene:
    """Returns the scene with near and far bounds for a camera at any place, even inside the scene's box.

    A scene without a box is returned unchanged.
    """
    if scene.box is None:
        return scene
    diagonal = float((scene.box[1] - scene.box[0]).norm())
    distance = float((camera.origins[0] - scene.box.mean(0)).norm())
    return replace(scene, near=0.01 * diagonal, far=distance + diagonal)


def render_bands(subject: Subject, camera: Cameras, look: Look, rows: int) -> Iterator[RenderedImage]:
    """Renders a camera in bands of `rows` rows from top to bottom, with the hidden cells and the crop of a look."""
    renderer, scene = subject.renderer, space_from(subject.scene, camera)
    if look.hidden:
        hidden = torch.zeros(subject.diagram.num_cells, dtype=torch.bool, device="cpu")
        hidden[list(look.hidden)] = True
        hidden = hidden.to(renderer.device)
        renderer = copy.copy(renderer)
        renderer.fields = {name: VisibleCells(field, subject.router, hidden) for name, field in renderer.fields.items()}
    if look.crop is not None:
        scene = replace(scene, box=torch.tensor(look.crop, dtype=torch.float32, device="cpu"))
    for top in range(0, camera.height, rows):
        band = crop_camera(camera, 0, top, camera.width, min(rows, camera.height - top))
        with subject.weights():
            heaviest = look.pane == "cells" or look.picked is not None
            yield render_camera(renderer, scene, band, 0, heaviest=heaviest, fill=False)


def stack_bands(bands: list[RenderedImage]) -> RenderedImage:
    """Joins bands into an image on the CPU."""
    return RenderedImage(*(torch.cat(parts).cpu() for parts in zip(*bands)))


def render_look(subject: Subject, camera: Cameras, look: Look) -> RenderedImage:
    """Renders a camera in one band; see :func:`render_bands`."""
    return stack_bands(list(render_bands(subject, camera, look, camera.height)))


def cells_of(subject: Subject, places: Tensor) -> Tensor:
    """Returns the leaves, int64 [...], of places [..., 3] such as `RenderedImage.heaviest`."""
    where = places.to(subject.renderer.device).reshape(-1, 3)
    return subject.router.assign(where).reshape(places.shape[:-1]).cpu().long()


def picture_of(subject: Subject, image: RenderedImage, look: Look) -> Tensor:
    """Draws the pane of a look, with an outline around the picked cell."""
    picture = _picture_of_pane(subject, image, look)
    if look.picked is None:
        return picture
    groups = groups_of(subject.diagram, look.level)
    inside = (groups[cells_of(subject, image.heaviest)] == groups[look.picked]) & (image.opacity > 0.5)
    outside = torch.nn.functional.max_pool2d((~inside)[None].float(), 3, 1, 1)[0] > 0
    picture[inside & outside] = picture.new_tensor(OUTLINE)
    return picture


def _picture_of_pane(subject: Subject, image: RenderedImage, look: Look) -> Tensor:
    if look.pane == "depth":
        return picture_of_depth(image.depth, image.opacity)
    if look.pane == "opacity":
        return picture_of_colour(image.opacity[..., None].expand(*image.opacity.shape, 3))
    if look.pane == "cells":
        groups = groups_of(subject.diagram, look.level)[cells_of(subject, image.heaviest)]
        return picture_of_cells(groups, image.opacity, image.colour)
    background = subject.scene.background_colour()
    other = BACKGROUNDS[look.background] - (image.colour.new_zeros(3) if background is None else background)
    return picture_of_colour(image.colour + (1 - image.opacity)[..., None] * other)


def cell_at(subject: Subject, camera: Cameras, look: Look, x: float, y: float) -> int | None:
    """Returns the leaf that a pixel shows, or None if it shows nothing.

    Args:
        subject: The viewed run.
        camera: The camera of the whole picture.
        look: The hidden cells and the crop.
        x: Position from the left, 0..1.
        y: Position from the top, 0..1.
    """
    sides = ((x, camera.width), (y, camera.height))
    left, top = (min(int(max(0.0, min(share, 1.0)) * size), size - 1) for share, size in sides)
    image = render_look(subject, crop_camera(camera, left, top, 1, 1), replace(look, pane="cells"))
    return int(cells_of(subject, image.heaviest)) if float(image.opacity) > 0.5 else None


def describe_cell(diagram: VoronoiDiagram, leaf: int, level: int) -> str:
    """Describes a leaf's cell on a level, by number, path and centre, as Markdown."""
    groups = groups_of(diagram, level)
    number, count = int(groups[leaf]), int((groups == groups[leaf]).sum())
    path = " / ".join(str(step) for step in diagram.paths()[leaf].tolist()[:level] if step >= 0)
    title = f"**Cell {number}** of {int(groups[-1]) + 1}" + (f" (path {path})" if diagram.depth > 1 else "")
    centre = ", ".join(f"{value:.3f}" for value in diagram.leaf_centres[leaf].tolist())
    return title + (f"  \n{count} cells of the finest level" if count > 1 else f"  \ncentre {centre}")
