"""A split of the training: the kept samples, the diagram they balance, and what is written of them."""

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
    """The planned split of a diagram into cells of k children, by points [m, 3] and their importance [m].

    Returns:
        None where there are fewer than k samples in all.
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
    """The median, the lower of two; None of nothing."""
    return float(torch.tensor(values).median()) if values else None


def save_samples(path: Path, points: Tensor, importance: Tensor) -> None:
    """Writes the samples that a split was made from, for a later look (and ``benchmarks/balance.py``)."""
    buffer = io.BytesIO()
    np.savez(buffer, points=points.cpu().numpy(), importance=importance.cpu().numpy())
    write_bytes(path, buffer.getvalue())
