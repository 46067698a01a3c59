"""A training: its settings, the state that `build` makes, the loop, and callbacks."""

from voronerf.app.train.build import build
from voronerf.app.train.callbacks import Checkpoints, Divergence, Scores, TensorBoard
from voronerf.app.train.checkpoint import Checkpoint, CheckpointError, last_checkpoint
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.loop import Callback, TrainingError, run, train
from voronerf.app.train.resume import load, snapshot
from voronerf.app.train.state import State

__all__ = [
    "Callback",
    "Checkpoint",
    "CheckpointError",
    "Checkpoints",
    "ConfigError",
    "Divergence",
    "Scores",
    "State",
    "TensorBoard",
    "TrainConfig",
    "TrainingError",
    "build",
    "last_checkpoint",
    "load",
    "run",
    "snapshot",
    "train",
]
