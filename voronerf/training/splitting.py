"""A split during training: the new diagram from the kept samples, and the file of these samples."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.subdivision import Split, split_diagram
from voronerf.files import write_bytes
from voronerf.training.config import TrainConfig
from voronerf.training.schedule import PlannedSplit


def split_by_samples(
    config: TrainConfig,
    planned: PlannedSplit,
    diagram: VoronoiDiagram,
    k: int,
    points: Tensor,
    importance: Tensor,
    generator: torch.Generator,
) -> Split | None:
    """Makes a planned split of a diagram, k children a cell, from points [m, 3] and their importance [m].

    Returns:
        The split; None if there are fewer than k samples in all.
    """
    if points.shape[0] < k:
        return None
    return split_diagram(
        diagram,
        points,
        importance,
        k,
        cells=planned.cells,
        centres=config.centres,
        uniform_scale=config.uniform_scale,
        method=config.balance,
        min_samples=0 if diagram.num_cells == 1 else config.min_cell_samples,
        generator=generator,
        backend=config.backend,
    )


def median(values: list[float]) -> float | None:
    """The median, of an even number the lower middle value; None for an empty list."""
    return float(torch.tensor(values).median()) if values else None


def save_samples(path: Path, points: Tensor, importance: Tensor) -> None:
    """Writes the samples that a split was made from, which ``benchmarks/balance.py`` can read."""
    buffer = io.BytesIO()
    np.savez(buffer, points=points.cpu().numpy(), importance=importance.cpu().numpy())
    write_bytes(path, buffer.getvalue())
