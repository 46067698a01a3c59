"""Opens a trained run from its directory, to render it and to score it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from voronerf.app.evaluate.lpips import Lpips, find_lpips
from voronerf.app.evaluate.scores import score_views
from voronerf.app.files import json_text, read_json, write_text
from voronerf.app.scenes import Scene, load_scene
from voronerf.app.scenes.record import placed, read_scene, recorded, with_refined, within
from voronerf.app.scenes.scene import Split
from voronerf.app.train.checkpoint import NETWORKS, checkpoint_path, last_checkpoint
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.config_checks import check_device
from voronerf.app.train.networks import check_shapes, open_routers, parameter_groups, restore_routers
from voronerf.app.train.renderers import make_picture_grid, make_renderer, through_grid
from voronerf.app.train.run_directory import check_folders, check_stored_paths
from voronerf.app.train.state import stored_values
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.average import load_averages
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.renderer import RenderedImage, Renderer, render_camera
from voronerf.router import VoronoiRouter
from voronerf.town import editing, updating
from voronerf.town.editing import check_out
from voronerf.town.joint import joint_config
from voronerf.town.parts import Parts, Similarity, Solid
from voronerf.town.run_parts import restore_coarse
from voronerf.town.streaming import Pages, bytes_of

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
    routers: dict[str, VoronoiRouter | Parts]
    renderer: Renderer

    @property
    def router(self) -> VoronoiRouter | Parts:
        """The router of the field, or the parts of a run that was joined or cut."""
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

    # --- runs made of runs -------------------------------------------------------------------------------------------

    @property
    def source(self) -> editing.Source:
        """What other runs can be made of.

        Raises:
            ConfigError: For a field of cones, or one in normalised device coordinates.
        """
        return editing.Source.of(self.path.name, self.config, self.scene, self.router, self.renderer)

    @classmethod
    def join(
        cls,
        runs: Sequence[Run],
        out: Path | str,
        *,
        frames: Sequence[Similarity] | None = None,
    ) -> Run:
        """One run of several: where they overlap the nearest centre decides.

        Args:
            runs: At least two; the first gives data, background and settings.
            out: A new directory; the runs stay as they are.
            frames: From the scene of each run into that of the new one; None for where they are.

        Raises:
            ConfigError: For runs that cannot be joined; see the guide.
            OSError: When it cannot be written; nothing is left then.
        """
        if len(runs) < 2 or (frames is not None and len(frames) != len(runs)):
            count = "none" if frames is None else f"{len(frames)}"
            raise ConfigError(
                f"join needs two runs or more, and a frame for each: got {len(runs)} runs, {count} frames"
            )
        return cls._made(runs[0], out, editing.join([run.source for run in runs], frames or [Similarity()] * len(runs)))

    def cut(self, kept: Solid | Sequence[int], out: Path | str, *, outside: bool = False) -> Run:
        """A run of what lies in a solid or in some cells, in new files; networks that show nothing of it are dropped.

        Args:
            kept: A solid of the scene, such as ``Solid.box(low, high)``, or numbers of cells.
            out: A new directory.
            outside: What does not lie there, in its place.

        Raises:
            ConfigError: When nothing is left, or there is no such cell.
            OSError: When it cannot be written; nothing is left then.
        """
        source = self.source
        if isinstance(kept, Solid):
            return self._made(self, out, editing.cut(source, replace(kept, outside=kept.outside != outside)))
        k = source.parts.num_cells
        if not kept or not 0 <= min(kept) <= max(kept) < k:
            raise ConfigError(f"--cells must be numbers of 0..{k - 1}, at least one, got {[*kept][:20]}")
        chosen = torch.full((k,), outside)
        chosen[list(kept)] = not outside
        return self._made(self, out, editing.cut(source, chosen))

    def place(
        self,
        thing: Run,
        at: Sequence[float],
        out: Path | str,
        *,
        degrees: Sequence[float] = (0, 0, 0),
        scale: float = 1.0,
    ) -> Run:
        """This run with an object in it, in new files; its density comes on top of the scene's.

        Args:
            thing: The object, cut out or trained on white.
            at: Where the middle of the bottom of its box shall be.
            out: A new directory.
            degrees: Turned about the axes x, y, z, in this order.
            scale: Of its size.

        Raises:
            ConfigError: For an object without bounds.
            OSError: When it cannot be written; nothing is left then.
        """
        source = thing.source
        frames = [Similarity(), editing.standing(source, at, degrees, scale)]
        return self._made(self, out, editing.join([self.source, source], frames, on_top=[False, True]))

    def update(
        self,
        scene: Scene,
        out: Path | str,
        *,
        seconds: float | None = None,
        data: str | None = None,
        old: bool = True,
        more: bool = False,
        seed: int = 0,
        clock: Callable[[], float] = time.perf_counter,
        say: Callable[[str], None] = lambda line: None,
    ) -> Run:
        """This run brought up to date with new pictures, in new files.

        Cells whose error has grown learn; the networks of all others, and the tables that these share, are the same
        bits afterwards.

        Args:
            scene: The new pictures. Photographs that were moved as they were read are moved to where the run has them.
            out: A new directory.
            seconds: To train for; None for a tenth of the time that the run was trained for, and 10 at least.
            data: Where the new pictures were loaded from, for the settings of the new run.
            old: Also learn from the pictures of this run's scene, where they agree with the new ones.
            more: The scene is the same, and these are more pictures of it: all cells learn, from old and new pixels
                alike.
            seed: Of the rays that are drawn.
            clock: Counts seconds.
            say: Told a line for what is found.

        Raises:
            ConfigError: For pictures that show nothing new, nothing of the scene, or another scene.
            SceneError: For pictures with another background, or in another frame.
            OSError: When it cannot be written; nothing is left then.
        """
        check_out(Path(out))
        if self.config.appearance:
            raise ConfigError("--appearance must be off for a run that is updated: gains of new pictures are not known")
        checkpoint = last_checkpoint(self.path, keep=lambda name: more or name.startswith("errors."))
        if seconds is None:
            seconds = max(10.0, float(checkpoint.values["seconds"]) / 10)
        if not 0 < seconds < math.inf:
            raise ConfigError(f"--budget must be positive, got {seconds}")
        new = placed(scene, self.scene)
        before = self.scene if old and len(self.scene.train.images) else None
        given: dict[str, Any] = {"seed": seed, "clock": clock, "say": say}
        if more:
            every = new if before is None else replace(new, train=Split.joined(before.train, new.train))
            updating.train_on(checkpoint, every, Path(out), seconds=seconds, data=data, **given)
            return open_run(out, scene=new, backend=self.renderer.backend)
        source = editing.join([self.source], [Similarity()])
        usual = checkpoint.group("errors").get("usual")
        if self.renderer.sampler.passes > 1 or (usual is not None and len(usual) != source.parts.num_cells + 1):
            usual = None  # of other samples, or cells
        found = updating.update(source, new, before, usual, seconds=seconds, **given)
        config = replace(found.source.config, data=data or self.config.data)
        editing.write(replace(found.source, config=config, scene=new), Path(out))
        return open_run(out, scene=new, backend=self.renderer.backend)

    @classmethod
    def _made(cls, first: Run, out: Path | str, source: editing.Source) -> Run:
        """Writes what was made and opens it."""
        editing.write(source, Path(out))
        images = len(first.scene.test.images) > 0
        scene = first.scene if images else read_scene(Path(out) / "scene.json")
        return open_run(out, scene=scene, backend=first.renderer.backend)

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


def _shows_without_networks(name: str) -> bool:
    return name != NETWORKS and _shows(name)


def open_run(
    path: Path | str,
    *,
    scene: Scene | None = None,
    data: str | Path | Sequence[str | Path] | None = None,
    downscale: int | None = None,
    allow_outside: bool = False,
    samples: int | None = None,
    fine_samples: int | None = None,
    occupancy: bool = False,
    device: str = "cpu",
    backend: str = "auto",
    memory: str | int | None = None,
    detail: float = 0.0,
) -> Run:
    """Opens a run that ``voronerf train`` or :class:`voronerf.app.train.trainer.Trainer` has written.

    On the CPU the networks are pages of a file: of the checkpoint, or where processes have written a file each, of a
    temporary one (``TMPDIR``) with all cells. The system reads them when they are needed, and drops them when memory
    gets short, so that networks may be larger than the memory.

    Args:
        path: The run directory.
        scene: The scene, if it is loaded already.
        data: Scene folder; None for that of the training, if it lies in the run directory, the working directory or
            ``VORONERF_DATA``, since a run may be another person's. Several for a run that was joined of runs of these,
            in their order: its scene has the views of all of them, where the run has them.
        downscale: Factor on the images; None for that of the training.
        allow_outside: Also read images that lie outside of the scene folder.
        samples: Samples per ray in the first pass; None for those of the training.
        fine_samples: Samples per ray in the second pass; None for those of the training.
        occupancy: Skip empty space, found by evaluating the field once. A run trained with occupancy always uses its
            own grid, because its field has learnt nothing about empty space.
        device: Torch device.
        backend: Backend of the operations.
        memory: Bound on the memory of this process and on what the files of networks take of the system's, such as
            "512M", for a run of several parts or territories on the CPU. Networks are read as rays meet them, those
            that were not used for longest are dropped, and their checksums are not compared. Pictures are the same bit
            for bit.
        detail: Draw a part of a joined run by its coarse level, where a voxel of it is no wider than so many pixels;
            0 to draw all by their networks.

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
    folders = [str(data)] if isinstance(data, (str, Path)) else [str(folder) for folder in data or ()]
    check_device(device)
    check_folders(path)
    if not 0 <= detail < math.inf:
        raise ConfigError(f"--detail must be a number of pixels, 0 or more, got {detail}")
    pages = None if memory is None else Pages(checkpoint_path(path).parent, bytes_of(memory))
    checkpoint = last_checkpoint(path, keep=_shows if pages is None else _shows_without_networks)
    if pages is not None and ("parts" not in checkpoint.values or torch.device(device).type != "cpu"):
        raise ConfigError(
            f"--memory needs --device cpu and a run of parts, as join, cut, place and train --territories make;"
            f" {path} is none"
        )
    if pages is not None and any(name.endswith(".average") for name in checkpoint.tensors):
        raise ConfigError(
            f"--memory needs networks in files of their own, and {path} was trained after it was joined: its averaged "
            "weights are in one file. voronerf cut of all of it writes them apart"
        )
    config, _ = stored_values(checkpoint)
    if scene is None and not folders:
        check_stored_paths(path, data=config.data)
    check_shapes(config, checkpoint)
    routers = open_routers(config, device, checkpoint, pages)
    if isinstance(routers["field"], VoronoiRouter):
        restore_routers(routers, checkpoint, assign=torch.device(device).type == "cpu")
    load_averages([p for group in parameter_groups(routers, config) for p in group], checkpoint)
    for router in routers.values():
        router.backend = backend
        router.eval()
    config = replace(
        config,
        data=folders[0] if folders else config.data,
        downscale=config.downscale if downscale is None else downscale,
    )
    several = "parts" in checkpoint.values
    if scene is None and len(folders) > 1:
        scene = _joined_scene(
            [load_scene(each, allow_outside=allow_outside, **config.reading) for each in folders], path
        )
    scene = load_scene(config.data, allow_outside=allow_outside, **config.reading) if scene is None else scene
    territories = (config.territories or 1) > 1
    scene = within(scene, path, joined=not territories) if several else scene
    scene = with_refined(scene, path) if config.refine_cameras else scene
    if several and territories:  # as it was trained: its parts know their own settings
        config = joint_config(config, scene)
    renderer = make_renderer(config, scene, routers, samples=samples, fine_samples=fine_samples, backend=backend)
    field = routers["field"]
    if isinstance(field, Parts):
        restore_coarse(field, checkpoint)
        field.detail = detail
    if detail and not (isinstance(field, Parts) and any(part.coarse for part in field)):
        raise ConfigError("--detail needs coarse levels, which join, cut and place give a run of several parts")
    state = checkpoint.group("occupancy")
    grid = None
    if state:
        grid = OccupancyGrid.from_state(state, contraction=renderer.contraction, device=renderer.device)
    elif occupancy and not several:
        grid = make_picture_grid(config, scene, renderer)
    if grid is not None:
        renderer.sampler = through_grid(renderer.sampler, grid, picture_samples=samples)
    if pages is not None:
        del checkpoint, state
        pages.forget(checkpoint_path(path))
    return Run(path, config, scene, routers, renderer)


def _joined_scene(scenes: Sequence[Scene], run: Path) -> Scene:
    """The views of all scenes whose runs were joined.

    Raises:
        ConfigError: For a run of others, or of one.
    """
    found = recorded(scenes, read_scene(run / "scene.json"))
    if found is None:
        names = ", ".join(scene.name for scene in scenes)
        raise ConfigError(
            f"{run}: several scenes must be those of the runs that it was joined of, in order, got {names}"
        )
    return found
