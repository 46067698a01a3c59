"""A split during training: the new diagram from the kept samples, the file of these samples, and the line about it."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.subdivision import Split, split_diagram
from voronerf.files import write_bytes
from voronerf.training.average import drop_averages
from voronerf.training.config import TrainConfig
from voronerf.training.progress import Stage, TrainingError
from voronerf.training.schedule import PlannedSplit

if TYPE_CHECKING:
    from voronerf.training.trainer import Trainer


def split_cells(trainer: Trainer) -> bool:
    """Makes the split that is due, as far as the cells hold enough samples; False to try again later.

    Raises:
        TrainingError: When the first split has more cells than samples; after a checkpoint.
    """
    config, level, planned = trainer.config, trainer.level, trainer.plan[trainer.level]
    k = planned.children
    if planned.most is not None:
        k = min(k, planned.most - trainer.diagram.num_cells + 1)
    points, importance = trainer.reservoir.samples()
    if level == 0 and points.shape[0] < k:
        trainer.save()
        raise TrainingError(
            f"{trainer.out}: more cells than samples: --cells asks for {k}, {points.shape[0]} samples were kept in "
            f"{trainer.step} steps; in another --out, split later or keep more a batch (--reservoir, "
            "--reservoir-batches)"
        )
    split = trainer.find_split(k, points, importance)
    balances = [] if split is None else list(split.balances.values())
    if planned.most is not None and not balances:
        return False
    if trainer.writes:
        save_samples(trainer.out / "samples" / f"level-{level + 1}.npz", points, importance)
    if split is not None and balances:
        trainer.divide(split)
    if config.init == "random":  # the averages are of other networks
        drop_averages(trainer.optimizer)
    before = median([balance.imbalance_before for balance in balances])
    after = median([balance.imbalance_after for balance in balances])
    cells = trainer.diagram.num_cells
    trainer.stages.append(Stage(cells, trainer.seconds, trainer.step, before, after, len(balances)))
    when = f"at {trainer.seconds:.0f} s, step {trainer.step}"
    if balances:
        trainer.say(f"{cells} cells {when}, imbalance of their importance {before:.3f} -> {after:.4f}")
    else:
        need = max(k, config.min_cell_samples)
        trainer.say(f"no cell split {when}: none holds {need} of the {points.shape[0]} samples kept")
    return True


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
