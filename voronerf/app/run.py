"""Opens a trained run from its directory, to render it and to score it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from voronerf.app.evaluate.lpips import Lpips, find_lpips
from voronerf.app.evaluate.scores import score_views
from voronerf.app.files import json_text, read_json, write_text
from voronerf.app.scenes import Scene, load_scene
from voronerf.app.train.checkpoint import last_checkpoint
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.config_checks import check_device
from voronerf.app.train.networks import check_shapes, make_routers, parameter_groups, restore_routers
from voronerf.app.train.renderers import make_picture_grid, make_renderer, through_grid
from voronerf.app.train.run_directory import TOWN, check_folders, check_stored_paths
from voronerf.app.train.state import stored_values
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.average import load_averages
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.renderer import RenderedImage, Renderer, render_camera
from voronerf.router import VoronoiRouter

#: File of a run's crop: the lowest and the highest corner.
CROP = "crop.json"


@dataclass(frozen=True)
class Run:
    """A trained run, which :func:`open_run` opens.

    Attributes:
        path: Its directory.
        config: The settings it was trained with; ``data`` and ``downscale`` are those of ``scene``.
        scene: Images and cameras, and the space that the field fills.
        routers: The networks by name: "field", whose colours count, and "coarse" or "proposal" where it has them.
        renderer: How rays become colours.

    Examples:
        >>> from voronerf import Run
        >>> from voronerf.nerf import turntable_cameras
        >>> def turntable(run: Run, frames: int) -> list:  # such as a viewer's
        ...     cameras = turntable_cameras(run.scene.train.cameras, frames)
        ...     return [run.render(cameras, frame).colour for frame in range(frames)]
    """

    path: Path
    config: TrainConfig
    scene: Scene
    routers: dict[str, VoronoiRouter]
    renderer: Renderer

    @property
    def router(self) -> VoronoiRouter:
        """The router of the field."""
        return self.routers["field"]

    @property
    def diagram(self) -> VoronoiDiagram:
        """The cells of the field."""
        return self.router.diagram

    def cropped(self, box: Tensor | Sequence[Sequence[float]]) -> Run:
        """This run, of which only what lies in a box [2, 3] is rendered.

        Raises:
            ConfigError: The box is empty or not finite.
        """
        return replace(self, scene=replace(self.scene, box=_box(box, "--crop")))

    def render(self, camera: int | Cameras, index: int = 0, *, heaviest: bool = True) -> RenderedImage:
        """Renders a picture, without gradients and without randomness.

        Args:
            camera: The number of a test view, or cameras of any kind.
            index: Which of several cameras.
            heaviest: Also find the place that each pixel shows, which takes a little longer.

        Returns:
            Colour [h, w, 3] over the scene's background, opacity [h, w], depth [h, w] in scene units, and the heaviest
            sample [h, w, 3] of each pixel's ray.

        Raises:
            IndexError: If there is no such camera.
        """
        cameras, index = (self.scene.test.cameras, camera) if isinstance(camera, int) else (camera, index)
        if not 0 <= index < len(cameras):
            raise IndexError(f"render: there are {len(cameras)} cameras, got number {index}")
        return render_camera(self.renderer, self.scene, cameras, index, heaviest=heaviest)

    def find_lpips(self, weights: Path | str | None = None) -> tuple[Lpips | None, str]:
        """The LPIPS network for the images of this run, or None; and where it was found, or why it was not.

        Args:
            weights: A file or folder, or "off"; None searches as in training, see ``TrainConfig.lpips``.
        """
        if weights is None:
            check_stored_paths(self.path, lpips=self.config.lpips)
        weights = self.config.lpips if weights is None else Path(weights)
        return find_lpips(weights, self.config.data, self.scene.test.cameras.smallest[::-1])

    def evaluate(self, *, views: int | None = None, lpips: Lpips | Path | str | None = None) -> dict[str, Any]:
        """Scores of the test views, and their means.

        Args:
            views: Number of test views, evenly spread; None for all.
            lpips: The network, or the weights for :meth:`find_lpips`.

        Returns:
            "psnr" in dB, "ssim", "lpips" (None without its weights) and "psnr_of_mean_error" over all views, and
            "views", a list with "name", "psnr", "ssim" and "lpips" of each.
        """
        if not isinstance(lpips, Lpips):
            lpips, _ = self.find_lpips(lpips)
        return score_views(self.renderer, self.scene, views=views, lpips=lpips)


def read_crop(folder: Path) -> Tensor | None:
    """The box [2, 3] that the viewer has saved in a run directory, or None.

    Raises:
        ValueError: The file is no box.
    """
    file = folder / CROP
    return _box(read_json(file), str(file)) if file.is_file() else None


def write_crop(folder: Path, box: Tensor) -> None:
    """Saves a box [2, 3] in a run directory, for ``--crop saved``."""
    write_text(folder / CROP, json_text(box.tolist()) + "\n")


def _box(value: Any, where: str) -> Tensor:
    """A box float32 [2, 3], the lowest and the highest corner."""
    try:
        box = torch.as_tensor(value, dtype=torch.float32).cpu()
    except (TypeError, ValueError, RuntimeError):
        box = torch.empty(0)
    if box.shape != (2, 3) or not bool(box.isfinite().all()) or not bool((box[0] < box[1]).all()):
        got = value.flatten().tolist() if isinstance(value, Tensor) else value
        raise ConfigError(f"{where} must be x y z of a corner and of a larger one, got {got!r:.200}")
    return box


def _shows(name: str) -> bool:
    """Whether a tensor of a checkpoint is for pictures, not for training alone."""
    return not name.startswith("optimizer.") or name.endswith(".average")


def open_run(
    path: Path | str,
    *,
    scene: Scene | None = None,
    data: str | Path | None = None,
    downscale: int | None = None,
    allow_outside: bool = False,
    samples: int | None = None,
    fine_samples: int | None = None,
    occupancy: bool = False,
    device: str = "cpu",
    backend: str = "auto",
) -> Run:
    """Opens a run that ``voronerf train`` or :class:`voronerf.app.train.trainer.Trainer` has written.

    On the CPU the networks are pages of the checkpoint. The system reads them when they are needed, and drops them when
    memory gets short, so that networks may be larger than the memory.

    Args:
        path: The run directory.
        scene: The scene, if it is loaded already.
        data: Scene folder; None for that of the training, if it lies in the run directory, the working directory or
            ``VORONERF_DATA``, since a run may be another person's.
        downscale: Factor on the images; None for that of the training.
        allow_outside: Also read images that lie outside of the scene folder.
        samples: Samples per ray in the first pass; None for those of the training.
        fine_samples: Samples per ray in the second pass; None for those of the training.
        occupancy: Skip empty space, found by evaluating the field once. A run trained with occupancy always uses its
            own grid, because its field has learnt nothing about empty space.
        device: Torch device.
        backend: Backend of the operations.

    Raises:
        CheckpointError: If there is no usable checkpoint.
        ConfigError: For an argument that cannot be used, occupancy for a run that cannot use a grid, a scene that
            must be given, or a folder of the run that is a link to elsewhere.
        SceneError: If the scene cannot be read.

    Examples:
        >>> import tempfile, voronerf  # a tiny run of the built-in scene, trained and opened again
        >>> from pathlib import Path
        >>> from voronerf.app.scenes import builtin_scene
        >>> from voronerf.app.train.config import TrainConfig
        >>> from voronerf.app.train.trainer import Trainer
        >>> folder = tempfile.TemporaryDirectory()
        >>> scene = builtin_scene(16, train_views=4, test_views=2)
        >>> config = TrainConfig(out=Path(folder.name), steps=20, cells=(4,), width=8, depth=1, rays=64)
        >>> summary = Trainer(config, scene).run()
        >>> run = voronerf.open_run(folder.name, scene=scene)
        >>> run.diagram.num_cells
        4
        >>> picture = run.render(0)
        >>> picture.colour.shape, picture.depth.shape
        (torch.Size([16, 16, 3]), torch.Size([16, 16]))
        >>> run.evaluate()["psnr"] == summary["psnr"]
        True
        >>> folder.cleanup()
    """
    path = Path(path)
    check_device(device)
    check_folders(path)
    if (path / TOWN).is_file():
        raise ConfigError(f"{path}: is a run made of several runs, which voronerf.town.open_run opens")
    checkpoint = last_checkpoint(path, keep=_shows)
    config, _ = stored_values(checkpoint)
    if scene is None and data is None:
        check_stored_paths(path, data=config.data)
    check_shapes(config, checkpoint)
    routers = make_routers(config, device)
    restore_routers(routers, checkpoint, assign=torch.device(device).type == "cpu")
    load_averages([p for group in parameter_groups(routers, config) for p in group], checkpoint)
    for router in routers.values():
        router.backend = backend
        router.eval()
    config = replace(
        config,
        data=config.data if data is None else str(data),
        downscale=config.downscale if downscale is None else downscale,
    )
    scene = load_scene(config.data, allow_outside=allow_outside, **config.reading) if scene is None else scene
    renderer = make_renderer(config, scene, routers, samples=samples, fine_samples=fine_samples, backend=backend)
    state = checkpoint.group("occupancy")
    grid = None
    if state:
        grid = OccupancyGrid.from_state(state, contraction=renderer.contraction, device=renderer.device)
    elif occupancy:
        grid = make_picture_grid(config, scene, renderer)
    if grid is not None:
        renderer.sampler = through_grid(renderer.sampler, grid, picture_samples=samples)
    return Run(path, config, scene, routers, renderer)
