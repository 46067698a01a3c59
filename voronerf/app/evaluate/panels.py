"""Pictures of a rendered view: truth, render, error, depth and cells, side by side.

h x w pixels, k cells. Pictures are uint8 [h, w, 3].
"""

from __future__ import annotations

import colorsys
import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from voronerf.app.evaluate.scores import Track, in_silence, view_numbers
from voronerf.app.files import write_bytes
from voronerf.app.render.camera import render_camera
from voronerf.app.scenes import Scene
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.renderer import RenderedImage, Renderer

# Steps of hue, saturation and value. The multiples of a step modulo 1 fill 0..1 evenly for any count (Roberts 2018).
HUE_STEP, SATURATION_STEP, VALUE_STEP = 0.6180339887498949, 0.7548776662466927, 0.5698402909980532
ERROR_SCALE = 0.3  # mean absolute error over the channels at the end of the colour map
SOLID = 0.5  # opacity above which a pixel's depth counts for the range of the colours
PICTURE_HEIGHT, PICTURE_WIDTH = 240, 1200  # pictures are enlarged to about this height, at most to this width
CAPTION, FONT, GAP = 24, 16, 6


def palette(count: int) -> Tensor:
    """Returns the colours of cells, uint8 [k, 3], all different; the colour of cell i is independent of the count.

    Hues follow the golden ratio, so that cells with close numbers (the children of one cell) look different.
    """
    colours: dict[tuple[int, int, int], None] = {}
    index = 0
    while len(colours) < count:
        saturation = 0.85 - 0.45 * (index * SATURATION_STEP % 1)
        value = 0.98 - 0.40 * (index * VALUE_STEP % 1)
        red, green, blue = colorsys.hsv_to_rgb(index * HUE_STEP % 1, saturation, value)
        colours.setdefault((round(red * 255), round(green * 255), round(blue * 255)))
        index += 1
    return torch.tensor(list(colours), dtype=torch.uint8, device="cpu").reshape(count, 3)


def picture_of_colour(colour: Tensor) -> Tensor:
    """Draws colours [h, w, 3], clipped to 0..1."""
    return (colour.clamp(0, 1) * 255).round().to(torch.uint8)


def picture_of_error(colour: Tensor, truth: Tensor) -> Tensor:
    """Draws the mean absolute error over the channels, black (0) to pale yellow (0.3 and above)."""
    return mapped((colour - truth).abs().mean(-1) / ERROR_SCALE, "inferno")


def picture_of_depth(depth: Tensor, opacity: Tensor, among: Tensor | None = None) -> Tensor:
    """Draws depth [h, w] from near (yellow) to far (dark blue), fading to white with the opacity.

    The colours span the 1 % to 99 % quantiles of the depths ``among`` [n], by default the solid pixels' depths.
    """
    solid = depth[opacity > SOLID] if among is None else among
    solid = solid[:: 1 + solid.numel() // 2**20]  # torch.quantile takes at most 2^24 values
    low, high = (solid.quantile(0.01), solid.quantile(0.99)) if solid.numel() else (depth.min(), depth.max())
    near_to_far = (depth - low) / (high - low).clamp_min(1e-6)
    return _on_white(mapped(1 - near_to_far, "viridis"), opacity)


def picture_of_cells(cells: Tensor, opacity: Tensor, colour: Tensor | None = None) -> Tensor:
    """Draws each pixel in the colour of its cell, fading to white with the opacity (figure 1 of the paper).

    Args:
        cells: integer [h, w].
        opacity: [h, w].
        colour: [h, w, 3], or None; its lightness shades the cells, so that shapes stay visible.
    """
    picture = palette(int(cells.max()) + 1 if cells.numel() else 0)[cells.long()]
    if colour is not None:
        lightness = (colour.clamp(0, 1) @ colour.new_tensor((0.299, 0.587, 0.114)))[..., None]
        picture = (picture * (0.4 + 0.6 * lightness)).round().to(torch.uint8)
    return _on_white(picture, opacity)


def contact_sheet(pictures: Mapping[str, Tensor]) -> Tensor:
    """Arranges pictures of one size in a row with captions; small pictures are enlarged by a whole factor.

    Args:
        pictures: the pictures by caption.

    Raises:
        ValueError: there are no pictures, or their sizes differ.
    """
    sizes = {tuple(picture.shape) for picture in pictures.values()}
    if len(sizes) != 1:
        raise ValueError(f"contact_sheet: pictures must have one size [h, w, 3], got {sorted(sizes)}")
    height, width, _ = sizes.pop()
    zoom = max(1, min(-(-PICTURE_HEIGHT // height), PICTURE_WIDTH // width))
    step = width * zoom + GAP
    sheet = Image.new("RGB", (len(pictures) * step + GAP, GAP + CAPTION + height * zoom + GAP), "white")
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(FONT)
    for index, (caption, picture) in enumerate(pictures.items()):
        left, top = GAP + index * step, GAP
        enlarged = Image.fromarray(picture.numpy()).resize((width * zoom, height * zoom), Image.Resampling.NEAREST)
        sheet.paste(enlarged, (left, top + CAPTION))
        draw.text((left, top + 2), caption, fill="black", font=font)
    return torch.from_numpy(np.array(sheet))


def save_picture(path: Path, picture: Tensor) -> None:
    """Writes a picture as PNG, atomically; makes its folder.

    Raises:
        OSError: it cannot be written.
    """
    data = io.BytesIO()
    Image.fromarray(picture.cpu().numpy()).save(data, format="PNG")
    write_bytes(path, data.getvalue())


def save_panel(path: Path, truth: Tensor, image: RenderedImage, cells: Tensor) -> None:
    """Writes truth [h, w, 3], render, error, depth and cells, int [h, w], of a view side by side as PNG.

    All tensors are on the CPU.
    """
    pictures = {
        "truth": picture_of_colour(truth),
        "render": picture_of_colour(image.colour),
        "error": picture_of_error(image.colour, truth),
        "depth": picture_of_depth(image.depth, image.opacity),
        "cells": picture_of_cells(cells, image.opacity, image.colour),
    }
    save_picture(path, contact_sheet(pictures))


def mapped(values: Tensor, name: str) -> Tensor:
    """Draws values [h, w], clipped to 0..1, in a colour map of matplotlib; NaN counts as 0."""
    import matplotlib  # imported here, so that the viewer's first picture does not wait for it

    table = torch.from_numpy((matplotlib.colormaps[name](np.arange(256))[:, :3] * 255).round().astype(np.uint8))
    return table[(values.nan_to_num(0).clamp(0, 1) * 255).round().long()]


def _on_white(picture: Tensor, opacity: Tensor) -> Tensor:
    share = opacity.clamp(0, 1)[..., None]
    return (picture * share + 255 * (1 - share)).round().to(torch.uint8)


def write_panels(
    renderer: Renderer, diagram: VoronoiDiagram, scene: Scene, folder: Path, *, views: int, track: Track = in_silence
) -> list[Path]:
    """Draws truth, render, error, depth and cells of evenly spread test views, a PNG for each; returns the paths."""
    paths = []
    for view in track(view_numbers(len(scene.test), views), "panels"):
        image = render_camera(renderer, scene, scene.test.cameras, view)
        # A pixel shows the cell of its heaviest sample, as in figure 1 of the paper.
        cells = diagram.locate(image.heaviest.reshape(-1, 3), backend=renderer.backend)
        paths.append(folder / f"{scene.test.names[view]}.png")
        truth = scene.test.truth(view, scene.background_colour())
        parts = RenderedImage(*(part.cpu() for part in image))
        save_panel(paths[-1], truth, parts, cells.reshape(image.opacity.shape).cpu())
    return paths
