"""What a training run says of itself: its stages, its progress, and why it stopped."""

from __future__ import annotations

from dataclasses import dataclass


class TrainingError(RuntimeError):
    """Training cannot go on; the message says why and what is left on disk."""


@dataclass(frozen=True)
class Stage:
    """A period of training on one diagram.

    ``balance_before`` and ``balance_after`` are std(W / max W) over the new cells of one parent, the median over the
    parents that were split; None for the coarse stage.
    """

    cells: int
    started_at_second: float
    started_at_step: int
    balance_before: float | None
    balance_after: float | None
    split_cells: int


@dataclass(frozen=True)
class Progress:
    """What a display shows of a running training; one is passed to the caller's callback after every step."""

    step: int
    seconds: float
    fraction: float
    loss: float
    rays_per_second: float
    cells: int
    psnr: float | None
