"""The options of every command that opens a trained run."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from torch import Tensor, float64, tensor

from voronerf.app.cli.display import busy
from voronerf.app.run import Run, open_run, read_crop
from voronerf.app.scenes import Scene
from voronerf.app.scenes.record import read_scene
from voronerf.app.train.config import ConfigError, check_backend_name
from voronerf.editing.run import has_parts
from voronerf.editing.run import open_run as open_parts

#: Six numbers of a box, or the box that the viewer has saved.
Crop = tuple[float, float, float, float, float, float] | Literal["saved"] | None


@dataclass(frozen=True)
class Opening:
    """The settings with which a run is opened; None keeps the setting of the training."""

    data: str | None = None
    """Scene folder; default: the folder of the training, if it lies in the run directory, the working directory or
    VORONERF_DATA, or if you have passed it to a training yourself. A run of another person could name any folder."""
    downscale: int | None = None
    """Factor by which images and the frames of a camera path are reduced; default as in training, 1 for a path."""
    allow_outside: bool = False
    """Also read images that lie outside of the scene folder."""
    samples: tuple[int, ...] | None = None
    """Samples per ray of each pass; default as in training."""
    occupancy: bool = False
    """Skip empty space, which is found by evaluating the field once. A run trained with --occupancy always uses its
    grid."""
    device: str = "cpu"
    """cpu, cuda, cuda:1, ...; auto is a GPU for which this package has kernels, else the CPU."""
    backend: str = "auto"
    """Backend of the operations."""

    def open_without_images(self, run: Path) -> Run:
        """Opens the run with the cameras in its scene.json, unless ``data`` or ``downscale`` is set."""
        record = run / "scene.json"
        use_record = self.data is None and self.downscale is None and record.is_file()
        return self.open(run, scene=read_scene(record) if use_record else None)

    def open(self, run: Path, *, scene: Scene | None = None) -> Run:
        """Opens a run of any kind."""
        check_counts(downscale=self.downscale)
        check_backend_name(self.backend)
        opener: Callable[..., Run] = open_parts if has_parts(run) else open_run
        accepted = inspect.signature(opener).parameters
        with busy(f"opening {run}"):
            return opener(run, scene=scene, **{name: value for name, value in vars(self).items() if name in accepted})


AS_IN_TRAINING = Opening()


def check_counts(**counts: int | None) -> None:
    """Raises ConfigError for an option below 1; None stands for its default."""
    for name, value in counts.items():
        if value is not None and value < 1:
            raise ConfigError(f"--{name.replace('_', '-')} must be at least 1, got {value}")


def crop_box(run: Run, crop: Crop) -> Tensor | None:
    """Returns the box [2, 3] of --crop, or None.

    Raises:
        ConfigError: No crop was saved with the run.
    """
    if crop != "saved":
        return None if crop is None else tensor(crop, dtype=float64).view(2, 3)
    box = read_crop(run.path)
    if box is None:
        raise ConfigError(f"--crop saved needs a crop that the viewer has saved in the run: {run.path} has none")
    return box
