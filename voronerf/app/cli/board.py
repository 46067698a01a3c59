"""The figures of a training for TensorBoard."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from voronerf.app.train.progress import Progress
from voronerf.app.train.trainer import Trainer

#: Steps between two losses.
EVERY = 10


class Board:
    """Writes the figures of a training for TensorBoard.

    Args:
        folder: Of the event files.
        trainer: Whose evaluations are written. What an earlier part of its run has written of later steps is hidden.

    Raises:
        ImportError: TensorBoard is not installed.
    """

    def __init__(self, folder: Path, trainer: Trainer) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise ImportError("--tensorboard needs tensorboard: pip install 'voronerf[tensorboard]'") from None
        self.writer: Any = SummaryWriter(str(folder), purge_step=trainer.step + 1)
        self.trainer = trainer
        self.written = len(trainer.metrics)

    def on_step(self, now: Progress) -> None:
        """Writes the state after a step, and the evaluations since the step before."""
        if now.step % EVERY == 0:
            for name, value in (("loss", now.loss), ("rays_per_second", now.rays_per_second), ("cells", now.cells)):
                self.writer.add_scalar(f"train/{name}", value, now.step)
        self._write_scores()

    def close(self) -> None:
        """Writes the evaluations since the last step, and ends the file."""
        self._write_scores()
        self.writer.close()

    def _write_scores(self) -> None:
        for line in self.trainer.metrics[self.written :]:
            for name in ("psnr", "ssim", "lpips", "learning_rate"):
                if line.get(name) is not None:
                    self.writer.add_scalar(f"test/{name}", line[name], line["step"])
        self.written = len(self.trainer.metrics)
