"""Nested Voronoi cells of a picture: networks from pixel positions to colours, split where the error is large.

The library's cells have points with three coordinates, so pixel (x, y) lies at (x, y, 0) with x and y in -1..1. The
importance of a pixel is its squared error, since every sample has weight 1.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from turns import take_turns

from paper.figures import stacked
from paper.looks import held_out_view
from paper.runs import Settings, default_scenes, open_scene
from voronerf import NeRF, SampleReservoir, VoronoiDiagram, VoronoiRouter, frequency_encode, split_diagram
from voronerf.app.evaluate.panels import contact_sheet, palette, picture_of_colour, picture_of_error, save_picture

CHILDREN, LEVELS = 4, 3
SPLITS = (0.15, 0.35, 0.55)  # fractions of the budget, one per split
WIDTH, DEPTH = 16, 3
BATCH = 4096
RATE, RATE_FINAL = 0.01, 0.05  # learning rate for the width WIDTH, and its final fraction
LEAST_SAMPLES = 16
EVALUATIONS = 20
ONE, MATCHED, NESTED = "one network", "one network, as many parameters", "nested Voronoi cells"


class ImageField(nn.Module):
    """A network from encoded positions to colours, with ReLU layers.

    Args:
        width: The width of the hidden layers.
        depth: The number of hidden layers.
        octaves: The number of frequencies of the encoding.
    """

    def __init__(self, width: int, depth: int, octaves: int) -> None:
        super().__init__()
        self.octaves = octaves
        sizes = [3 + 6 * octaves, *[width] * depth]
        self.hidden = nn.ModuleList(nn.Linear(i, o) for i, o in itertools.pairwise(sizes))
        self.colour = nn.Linear(width, 3)

    def forward(self, positions: Tensor) -> Tensor:
        """Returns colours [n, 3] in 0..1 at positions [n, 3]."""
        x = frequency_encode(positions, self.octaves)
        for layer in self.hidden:
            x = torch.relu(layer(x))
        return torch.sigmoid(self.colour(x))


def parameters(width: int, octaves: int) -> int:
    """Returns the number of parameters of a field with ``DEPTH`` layers."""
    return (3 + 6 * octaves) * width + (DEPTH - 1) * width * width + DEPTH * width + 3 * width + 3


def matching_width(total: int, octaves: int) -> int:
    """Returns the largest width of one network with at most ``total`` parameters."""
    width = 1
    while parameters(width + 1, octaves) <= total:
        width += 1
    return width


@dataclass(frozen=True)
class Level:
    """The final fit on one diagram: number of cells, the picture, each pixel's cell, and the balance."""

    cells: int
    picture: Tensor
    cell_of: Tensor
    imbalance: tuple[float, float] | None


class ImageFit:
    """A fit of a picture that trains for a number of seconds.

    Args:
        image: The picture [h, w, 3] in 0..1.
        budget: The training seconds.
        width: The width of the networks.
        splits: The fractions of the budget at which each cell is split into ``CHILDREN`` cells.
        seed: The seed of all random choices.
        backend: The backend of the operations.
    """

    def __init__(
        self, image: Tensor, *, budget: float, width: int, splits: tuple[float, ...], seed: int, backend: str
    ) -> None:
        height, wide = image.shape[:2]
        y, x = torch.meshgrid(_places(height), _places(wide), indexing="ij")
        self.points = torch.stack((x, y, torch.zeros_like(x)), -1).reshape(-1, 3)
        self.image, self.colours = image, image.reshape(-1, 3)
        self.budget, self.splits, self.backend = budget, splits, backend
        self.generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            field = ImageField(width, DEPTH, octaves_of(image))
        self.router = VoronoiRouter(field, VoronoiDiagram(torch.zeros(1, 3)), coords="first3", backend=backend)
        # The learning rate depends on the width as in `voronerf train`.
        self.rate = RATE * NeRF.learning_rate(width) / NeRF.learning_rate(WIDTH)
        self.optimizer = torch.optim.Adam(self.router.parameters(), lr=self.rate, betas=(0.9, 0.99), eps=1e-15)
        self.reservoir = SampleReservoir(10_000, 100)
        self.seconds, self.step = 0.0, 0
        self.curve: list[tuple[float, float]] = []
        self.levels: list[Level] = []
        self.imbalance: tuple[float, float] | None = None

    def advance(self, until: float) -> None:
        """Trains until ``until`` training seconds or the end of the budget."""
        while self.seconds < min(until, self.budget):
            started = time.perf_counter()
            share = self.seconds / self.budget
            if len(self.levels) < len(self.splits) and share >= self.splits[len(self.levels)]:
                self.levels.append(self.level())
                started = time.perf_counter()
                self._split()
            self._step(share)
            self.seconds += time.perf_counter() - started
            if self.seconds * EVALUATIONS >= self.budget * (len(self.curve) + 1):
                self.curve.append((self.seconds, self.psnr()))

    def _step(self, share: float) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate * math.exp(math.log(RATE_FINAL) * share)
        rows = torch.randint(len(self.points), (BATCH,), generator=self.generator)
        points = self.points[rows]
        error = (self.router(points) - self.colours[rows]).square()
        self.optimizer.zero_grad(set_to_none=True)
        error.mean().backward()
        self.optimizer.step()
        self.step += 1
        if len(self.levels) < len(self.splits):
            self.reservoir.add(points, error.detach().sum(-1))

    def _split(self) -> None:
        points, importance = self.reservoir.samples()
        split = split_diagram(
            self.router.diagram,
            points,
            importance,
            CHILDREN,
            centres="balanced",
            min_samples=LEAST_SAMPLES,
            generator=self.generator,
            backend=self.backend,
        )
        self.router.subdivide(split.diagram, split.parents, optimizer=self.optimizer)
        self.reservoir = SampleReservoir(10_000, 100)
        pairs = [(b.imbalance_before, b.imbalance_after) for b in split.balances.values()]
        self.imbalance = None
        if pairs:
            before, after = torch.tensor(pairs).median(0).values.tolist()
            self.imbalance = (before, after)

    @torch.no_grad()
    def picture(self) -> Tensor:
        """Renders the fitted picture [h, w, 3]."""
        return self.router(self.points).reshape(self.image.shape)

    def psnr(self) -> float:
        """Returns the PSNR of the whole picture in dB."""
        return float(-10 * torch.log10((self.picture() - self.image).square().mean()))

    def level(self) -> Level:
        """Returns the current fit."""
        cells = self.router.diagram.locate(self.points).reshape(self.image.shape[:2])
        return Level(self.router.num_cells, self.picture(), cells, self.imbalance)


def _places(count: int) -> Tensor:
    return (2 * torch.arange(count) + 1) / count - 1


def octaves_of(image: Tensor) -> int:
    """Returns the number of frequencies whose finest wavelength is two pixels."""
    return max(1, math.ceil(math.log2(math.pi * max(image.shape[:2]) / 2)))


def nested(settings: Settings, say: Callable[[str], None] = print) -> list[dict[str, Any]]:
    """Fits a held-out view of each scene with three contenders and draws the cells; returns the rows."""
    rows, pictures = [], []
    scenes = settings.scene or default_scenes()
    for name in scenes:
        found, picture = fitted_view(name, settings, say)
        rows += found
        pictures.append(picture)
    save_picture(settings.out / "nested-2d-pictures.png", stacked(pictures))
    return rows


def fitted_view(name: str, settings: Settings, say: Callable[[str], None]) -> tuple[list[dict[str, Any]], Tensor]:
    """Fits one scene's view; returns a row per contender and seed, and the sheet of pictures of seed 0."""
    # A single picture is easy to learn, so it has four times the scene's resolution.
    scene = open_scene(name, replace(settings, downscale=max(1, settings.downscale // 4)))
    image = scene.test.truth(held_out_view(scene), torch.ones(3))
    octaves = octaves_of(image)
    total = CHILDREN**LEVELS * parameters(WIDTH, octaves)
    widths = {ONE: WIDTH, MATCHED: matching_width(total, octaves), NESTED: WIDTH}
    fits = {
        (variant, seed): ImageFit(
            image,
            budget=settings.budget,
            width=width,
            splits=SPLITS if variant == NESTED else (),
            seed=seed,
            backend=settings.backend,
        )
        for variant, width in widths.items()
        for seed in range(settings.seeds)
    }
    take_turns(fits.values(), budget=settings.budget, turn=settings.turn)
    results = []
    for (variant, seed), fit in fits.items():
        fit.levels.append(fit.level())
        row = {
            "variant": variant,
            "scene": Path(name).name,
            "seed": seed,
            "psnr": fit.psnr(),
            "cells": fit.router.num_cells,
            "width": widths[variant],
            "parameters": sum(p.numel() for p in fit.router.parameters()),
            "steps": fit.step,
            "seconds": fit.seconds,
            "curve": [{"seconds": second, "psnr": psnr} for second, psnr in fit.curve],
            "levels": [{"cells": level.cells, "imbalance": level.imbalance} for level in fit.levels],
        }
        results.append(row)
        say(f"{variant:34} seed {seed}  {row['cells']:4d} cells  {row['steps']:6d} steps  psnr {row['psnr']:.2f}")
    return results, drawn(image, {variant: fits[variant, 0] for variant in widths})


def drawn(image: Tensor, fits: dict[str, ImageFit]) -> Tensor:
    """Draws the truth, one network, and the nested fit on each level with its cells."""
    pictures = {"truth": picture_of_colour(image), ONE: picture_of_colour(fits[ONE].levels[-1].picture)}
    for level in fits[NESTED].levels[1:]:
        borders = outlined(level.cell_of)
        pictures[f"{level.cells} cells"] = (0.55 * borders + 0.45 * picture_of_colour(level.picture)).to(torch.uint8)
    pictures["nested"] = picture_of_colour(fits[NESTED].levels[-1].picture)
    pictures["error, one"] = picture_of_error(fits[ONE].levels[-1].picture, image)
    pictures["error, nested"] = picture_of_error(fits[NESTED].levels[-1].picture, image)
    return contact_sheet(pictures)


def outlined(cells: Tensor) -> Tensor:
    """Draws each pixel of the cells [h, w] in its cell's colour, with dark borders: uint8 [h, w, 3]."""
    picture = palette(int(cells.max()) + 1)[cells.long()]
    border = torch.zeros_like(cells, dtype=torch.bool)
    border[1:] |= cells[1:] != cells[:-1]
    border[:, 1:] |= cells[:, 1:] != cells[:, :-1]
    picture[border] = 20
    return picture
