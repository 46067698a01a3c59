"""A trained run, opened from its directory for rendering and scoring."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from voronerf.app.evaluate.lpips import Lpips, find_lpips
from voronerf.app.evaluate.scores import Track, evaluate, in_silence, mean_scores
from voronerf.app.files import json_text, read_json, write_text
from voronerf.app.render.camera import render_camera
from voronerf.app.scenes import Scene, load_scene
from voronerf.app.train.build import make_picture_grid, make_renderer, present_device
from voronerf.app.train.checkpoint import is_shown, last_checkpoint
from voronerf.app.train.config import ConfigError, TrainConfig, check_samples
from voronerf.app.train.resume import open_routers, stored_values
from voronerf.app.train.run_directory import check_folders, check_stored_paths
from voronerf.app.wording import as_typed
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.renderer import RenderedImage, Renderer
from voronerf.nerf.samplers import Occupancy

#: The file of a run's crop box, with its lowest and highest corner.
CROP = "crop.json"
#: The description of a box in error messages.
BOX = "x y z of a corner and of a larger one"


class HasCells(Protocol):
    """A field with Voronoi cells, such as a router."""

    @property
    def diagram(self) -> VoronoiDiagram:
        """The Voronoi diagram of the cells."""
        ...

    def assign(self, positions: Tensor) -> Tensor:
        """Returns the cells int32 [n] of positions [n, 3]."""
        ...


@dataclass(frozen=True)
class Run:
    """A trained run, which :func:`open_run` opens.

    Attributes:
        path: The run directory.
        config: The settings of the training, with ``data`` and ``downscale`` of ``scene``.
        scene: Images and cameras, and the space of the field.
        router: The field with its cells.
        renderer: The renderer of the field.

    Examples:
        >>> from voronerf.app import Run
        >>> from voronerf.nerf import turntable_cameras
        >>> def turntable(run: Run, frames: int) -> list:  # such as a viewer's
        ...     cameras = turntable_cameras(run.scene.train.cameras, frames)
        ...     return [run.render(cameras, frame).colour for frame in range(frames)]
    """

    path: Path
    config: TrainConfig
    scene: Scene
    router: HasCells
    renderer: Renderer

    @property
    def diagram(self) -> VoronoiDiagram:
        """The Voronoi diagram of the field's cells."""
        return self.router.diagram

    def cropped(self, box: Tensor | Sequence[Sequence[float]]) -> Run:
        """Returns a copy of this run that renders only inside a box [2, 3].

        Raises:
            ConfigError: If the box is empty or not finite.
        """
        return replace(self, scene=replace(self.scene, box=_box(box, "--crop")))

    def render(self, camera: int | Cameras, index: int = 0, *, heaviest: bool = True) -> RenderedImage:
        """Renders a picture, deterministically and without gradients.

        Args:
            camera: The number of a test view, or cameras of any kind.
            index: The number of the camera in ``camera``.
            heaviest: Also find the heaviest sample of each pixel's ray, which takes slightly longer.

        Returns:
            Colour [h, w, 3] over the scene's background, opacity [h, w], depth [h, w] in scene units, and the position
            [h, w, 3] of the heaviest sample of each pixel's ray.

        Raises:
            IndexError: If there is no camera with this number.
        """
        cameras, index = (self.scene.test.cameras, camera) if isinstance(camera, int) else (camera, index)
        if not 0 <= index < len(cameras):
            raise IndexError(f"render: there are {len(cameras)} cameras, got number {index}")
        return render_camera(self.renderer, self.scene, cameras, index, heaviest=heaviest)

    def find_lpips(self, weights: Path | str | None = None) -> Lpips | None:
        """Returns the LPIPS network for the images of this run, or None without weights or for images too small for it.

        Args:
            weights: A file or folder of weights, or "off"; None searches as in training, see ``TrainConfig.lpips``.
        """
        if weights is None:
            check_stored_paths(self.path, lpips=self.config.lpips)
        weights = self.config.lpips if weights is None else Path(weights)
        return find_lpips(weights, self.config.data, self.scene.test.cameras.smallest[::-1])

    def evaluate(
        self, *, views: int | None = None, lpips: Lpips | Path | str | None = None, track: Track = in_silence
    ) -> dict[str, Any]:
        """Scores the test views.

        Args:
            views: Number of test views, evenly spaced; None for all.
            lpips: The LPIPS network, or the weights for :meth:`find_lpips`.
            track: Function that shows progress: takes a sequence and the task's name, and yields the items.

        Returns:
            A dict with the mean "psnr" in dB, "ssim" and "lpips" (None without weights), "psnr_of_mean_error",
            "far_views", and "views", a list with the values of a :class:`voronerf.app.evaluate.ViewScore` for each
            view.
        """
        if views is not None and views < 1:
            raise ConfigError(f"views must be at least 1, got {views}")
        if not isinstance(lpips, Lpips):
            lpips = self.find_lpips(lpips)
        scores = evaluate(self.renderer, self.scene, views=views, lpips=lpips, track=track)
        return {**mean_scores(scores), "views": [asdict(score) for score in scores]}


def read_crop(folder: Path) -> Tensor | None:
    """Returns the crop box [2, 3] that the viewer has saved in a run directory, or None."""
    file = folder / CROP
    return _box(read_json(file), str(file)) if file.is_file() else None


def write_crop(folder: Path, box: Tensor) -> None:
    """Saves a crop box [2, 3] in a run directory, for ``--crop saved``."""
    write_text(folder / CROP, json_text(box.tolist()) + "\n")


def _box(value: Any, where: str) -> Tensor:
    """Returns a box float32 [2, 3], lowest and highest corner, after checking it."""
    try:
        box = torch.as_tensor(value, dtype=torch.float32, device="cpu")
    except (TypeError, ValueError, RuntimeError):
        box = torch.empty(0, device="cpu")
    if box.shape != (2, 3) or not bool(box.isfinite().all()) or not bool((box[0] < box[1]).all()):
        actual = value.flatten().tolist() if isinstance(value, Tensor) else value
        raise ConfigError(f"{where} must be {BOX}, got {as_typed(actual):.200}")
    return box


def shown_scene(
    path: Path,
    config: TrainConfig,
    scene: Scene | None,
    data: str | Path | None,
    downscale: int | None,
    allow_outside: bool,
) -> tuple[TrainConfig, Scene]:
    """Returns a run's settings, updated by arguments of :func:`open_run`, and the scene, which is loaded if None."""
    if scene is None and data is None:
        check_stored_paths(path, data=config.data)
    config = replace(
        config,
        data=config.data if data is None else str(data),
        downscale=config.downscale if downscale is None else downscale,
    )
    if scene is None:
        scene = load_scene(config.data, **{**config.reading, "allow_outside": allow_outside})
    return config, scene


def open_run(
    path: Path | str,
    *,
    scene: Scene | None = None,
    data: str | Path | None = None,
    downscale: int | None = None,
    allow_outside: bool = False,
    samples: tuple[int, ...] | None = None,
    occupancy: bool = False,
    device: str = "cpu",
    backend: str = "auto",
) -> Run:
    """Opens a run that ``voronerf train`` has written.

    Args:
        path: The run directory.
        scene: The scene, if it is loaded already.
        data: Scene folder; None for the folder of the training. Since a run may be another person's, the folder of the
            training must lie in the run directory, the working directory or ``VORONERF_DATA``, unless this user has
            passed it to a training.
        downscale: Downscale factor of the images; None for the factor of the training.
        allow_outside: Whether to read images outside the scene folder too.
        samples: Samples per ray of each pass; None for the numbers of the training.
        occupancy: Skip empty space, found by evaluating the field once. A run trained with occupancy always uses its
            own grid, because its field has learnt nothing in empty space.
        device: The device, such as "cpu", "cuda:0" or "auto".
        backend: Backend of the operations.

    Raises:
        CheckpointError: If there is no usable checkpoint.
        ConfigError: If an argument is unusable, the run cannot use a grid for ``occupancy``, the scene folder must be
            given, or a subfolder of the run is a link out of the run.
        SceneError: If the scene cannot be read.

    Examples:
        >>> import tempfile  # a tiny run of the built-in scene, trained and opened again
        >>> from pathlib import Path
        >>> from voronerf.app import open_run
        >>> from voronerf.app.scenes import builtin_scene
        >>> from voronerf.app.train import Checkpoints, Scores, TrainConfig, build, run
        >>> folder = tempfile.TemporaryDirectory()
        >>> out = Path(folder.name)
        >>> scene = builtin_scene(16, train_views=4, test_views=2)
        >>> state = build(TrainConfig(steps=20, cells=(4,), width=8, depth=1, rays=64), scene)
        >>> run(state, [Checkpoints(out), scores := Scores(out)])
        >>> opened = open_run(out, scene=scene)
        >>> opened.diagram.num_cells
        4
        >>> picture = opened.render(0)
        >>> picture.colour.shape, picture.depth.shape
        (torch.Size([16, 16, 3]), torch.Size([16, 16]))
        >>> opened.evaluate()["psnr"] == scores.summary["psnr"]
        True
        >>> folder.cleanup()
    """
    path = Path(path)
    device = present_device(device)
    check_folders(path)
    checkpoint = last_checkpoint(path, keep=is_shown)
    config, _ = stored_values(checkpoint)
    check_samples(replace(config, samples=samples))
    routers = open_routers(config, checkpoint, device, backend)
    config, scene = shown_scene(path, config, scene, data, downscale, allow_outside)
    renderer = make_renderer(config, scene, routers, samples=samples, backend=backend)
    state, grid = checkpoint.group("occupancy"), None
    if state:
        contraction = renderer.sampler.space.contraction
        grid = OccupancyGrid.from_state(state, contraction=contraction, device=renderer.device)
    elif occupancy:
        grid = make_picture_grid(config, scene, renderer)
    if grid is not None:
        sampler, picture_samples = renderer.sampler, None if samples is None else samples[0]
        renderer.sampler = Occupancy(
            grid, sampler.samples, picture_samples=picture_samples, space=sampler.space, backend=sampler.backend
        )
    return Run(path, config, scene, routers["field"], renderer)
