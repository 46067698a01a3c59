"""The messages of a training run: its stages, its progress, and the error that stops it."""

from __future__ import annotations

from dataclasses import dataclass


class TrainingError(RuntimeError):
    """Training cannot continue; the message gives the reason and what is left on disk."""


@dataclass(frozen=True)
class Stage:
    """A period of training on one diagram.

    ``balance_before`` and ``balance_after`` are std(W / max W) over the new cells of a parent, and of these the median
    over the parents that were split; None for the coarse stage.
    """

    cells: int
    started_at_second: float
    started_at_step: int
    balance_before: float | None
    balance_after: float | None
    split_cells: int


@dataclass(frozen=True)
class Progress:
    """The state of a training after a step, for a display; see ``Trainer``'s ``on_step``."""

    step: int
    seconds: float
    fraction: float
    loss: float
    rays_per_second: float
    cells: int
    psnr: float | None
