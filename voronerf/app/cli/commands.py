"""The commands behind ``voronerf train | eval | render | info | preload | process``. Each returns the exit status."""

from __future__ import annotations

import contextlib
import importlib
import os
import shlex
import signal
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType, ModuleType
from typing import Annotated, Any, Literal

import torch
import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from voronerf.app.cli.board import Board
from voronerf.app.cli.display import StageDisplay, TrainingDisplay, printable
from voronerf.app.cli.opening import AS_IN_TRAINING, Crop, Opening, check_counts, crop_box
from voronerf.app.evaluate.panels import write_panels
from voronerf.app.export.video import export_video
from voronerf.app.files import json_text, write_text
from voronerf.app.render.paths import CameraPath, read_camera_path
from voronerf.app.render.video import check_video
from voronerf.app.run import Run, open_run
from voronerf.app.scenes import BUILTIN, Scene, SceneError, load_scene
from voronerf.app.scenes.process import process as make_scene
from voronerf.app.train.checkpoint import checkpoint_paths
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.config_checks import check_device, check_joint, why_no_occupancy
from voronerf.app.train.networks import resolve_config
from voronerf.app.train.progress import Progress
from voronerf.app.train.run_directory import check_stored_paths, choose_directory, held, is_outside, write_curve
from voronerf.app.train.trainer import Trainer
from voronerf.ops._core import backends
from voronerf.town.distributed.group import Group, joined, local_rank, restarts, world_size
from voronerf.town.distributed.same import check_same, check_same_scene
from voronerf.town.joint import JointTrainer

console = Console(soft_wrap=True)

#: Makes a `voronerf.app.viewer.Training`, which shows a trainer.
Watch = Callable[[Trainer], Any]

#: Bytes of a picture's name without its end, which most file systems take.
LONGEST_NAME = 255 - len(".png")
#: What ends a training with a checkpoint: Ctrl-C, kill, a closed terminal, and the warning that Slurm can send.
STOPPING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1") if hasattr(signal, name)]


def say(line: str) -> None:
    """Prints a line as plain text, with control characters escaped."""
    console.print(printable(line), highlight=False, markup=False, emoji=False)


def train(
    config: TrainConfig,
    *,
    file: Annotated[Path | None, tyro.conf.arg(name="config")] = None,
    view: bool = False,
    host: str = "127.0.0.1",
    port: int = 8080,
    explain: bool = False,
) -> int:
    """Train a scene: coarse network, balanced Voronoi cells, cells trained further.

    With --resume, options that are not given keep their value from the run in --out.

    Args:
        config: The settings.
        file: JSON of settings by their names, such as the config.json of a run; options that are given come first.
        view: Show the training in a browser, and its result until Ctrl-C.
        host: Address that --view listens at; the default is for this machine only, 0.0.0.0 lets others in.
        port: Port that --view listens at; 0 is any that is free.
        explain: Only say how a training step is computed, and what keeps it from a faster way.
    """
    if world_size() > 1:
        return train_on_ranks(config, view=view)
    check_device(config.device)
    if view:
        import_viewer().check_address(host, port)
    scene = load_scene(config.data, allow_outside=config.allow_outside, **config.reading)
    if view and (config.territories or 1) > 1:
        raise ConfigError(
            f"--view must be off with several territories, got {config.territories}; `voronerf view` shows their last "
            "checkpoint"
        )
    if explain:
        unused = replace(config, out=config.out or Path("runs"), resume=config.resume and config.out is not None)
        joint = (config.territories or 1) > 1
        text = JointTrainer(unused, scene).explain() if joint else Trainer(unused, scene).learner.explain()
        for line in text.splitlines():
            say(line)
        return 0
    chosen = choose_directory(config, scene)
    assert chosen.out is not None
    with contextlib.ExitStack() as stack:
        if config.out is None:
            stack.callback(_remove_empty, chosen.out)

        def watch(trainer: Trainer) -> Any:
            watched = import_viewer().watch(trainer, host=host, port=port)
            stack.callback(watched.viewer.close)
            say(watched.viewer.audience)
            viewers.append(watched.viewer)
            return watched

        viewers: list[Any] = []
        summary = run_training(chosen, scene, watch=watch if view else None)
        for viewer in viewers:
            if summary["complete"]:
                say(f"{viewer.address} shows the run until Ctrl-C")
                viewer.show(import_viewer().Subject.of(open_run(chosen.out, scene=scene, backend=config.backend)))
                serve_runs(viewer)
    return 0 if summary["complete"] else 130


def _remove_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()  # fails if something was written, and is then not needed


def train_on_ranks(config: TrainConfig, *, view: bool) -> int:
    """Trains together with the other ranks; all of them call it, and rank 0 alone writes files.

    Args:
        config: The settings.
        view: Whether a viewer was asked for.

    Raises:
        ConfigError: A setting that multi-process training does not support.
        RankLost: Another rank has ended, or says what is wrong.
    """
    device = torch.device(f"cuda:{local_rank()}" if config.device == "cuda" else config.device)
    config = replace(config, device=str(device))
    check_device(config.device)
    if config.territories is None:
        config = replace(config, territories=1 << (world_size() - 1).bit_length())
    with joined(device) as group:
        check_same(group, config)
        if view:
            raise ConfigError(
                f"--view must be off with several ranks, got {world_size()}; `voronerf view` shows their last "
                "checkpoint"
            )
        check_joint(config, world_size())
        assert config.out is not None
        reading = config.reading
        if config.data not in BUILTIN:  # each rank reads its own of one copy
            reading["images"] = "disk"
        scene = load_scene(config.data, allow_outside=config.allow_outside, **reading)
        check_same_scene(group, scene)
        if group.rank == 0:  # alone, for what it writes is there already when others look
            again = restarts() > 0 and bool(checkpoint_paths(config.out))
            config = choose_directory(replace(config, resume=config.resume or again), scene)
        config = replace(config, resume=group.from_first(config.resume))
        summary = run_training(config, scene, group=group)
        first = group.rank == 0
    if first and summary["complete"]:  # not before the others have left: they would wait for the pictures
        _draw_joint(config, scene)
    return 0 if summary["complete"] else 130


def _draw_joint(config: TrainConfig, scene: Scene) -> None:
    """Draws the panels of a joint run from its files."""
    assert config.out is not None
    if config.panels:
        opened = open_run(config.out, scene=scene, backend=config.backend)
        write_panels(opened.renderer, opened.diagram, scene, config.out / "images", views=config.panels)


def run_training(
    config: TrainConfig, scene: Scene, *, watch: Watch | None = None, group: Group | None = None, quiet: bool = False
) -> dict[str, Any]:
    """Trains into ``config.out`` with a display, then draws panels and the curve; returns the summary.

    ``watch`` makes what shows the training in a viewer; ``group`` are the ranks that train together. ``quiet`` leaves
    out all lines but the live one.

    Ctrl-C, SIGTERM, SIGHUP and SIGUSR1 end training after the step in hand: the checkpoint and the summary are written,
    the pictures are not. A second one ends the process at once.
    """
    assert config.out is not None
    longest = max(scene.test.names, key=lambda name: len(os.fsencode(name)))
    if config.panels and len(os.fsencode(longest)) > LONGEST_NAME:
        raise ConfigError(f"--panels must be 0 with image names of more than {LONGEST_NAME} bytes, got {longest}")
    with held(config.out) if group is None or group.rank == 0 else contextlib.nullcontext():
        return _train_and_draw(config, config.out, scene, watch, group, quiet)


def _train_and_draw(
    config: TrainConfig, out: Path, scene: Scene, watch: Watch | None, group: Group | None, quiet: bool
) -> dict[str, Any]:
    with contextlib.ExitStack() as stack:
        display = TrainingDisplay(console, scene.name, quiet=quiet)
        with display.progress:
            for note in scene.notes:
                display.on_event(f"{scene.name}: {note}")
            told: dict[str, Any] = {"on_step": display.on_step, "on_event": display.on_event}
            trainer: Trainer | JointTrainer
            if (config.territories or 1) > 1:
                trainer = JointTrainer(config, scene, group=group, **told)
            else:
                trainer = Trainer(config, scene, **told)
            if trainer.lpips is None:
                display.on_event(trainer.lpips_source)
            if config.occupancy and trainer.occupancy is None:
                resolved = resolve_config(config, scene)
                bare = resolved.contraction == "none"
                other = "a scene without a box" if bare else "a contraction, unless by --occupancy-resolution 64"
                obstacle = why_no_occupancy(resolved) or other
                display.on_event(f"every sample is evaluated, also in empty space: no occupancy grid with {obstacle}")
            watched = None
            board = Board(out / "tensorboard", trainer) if config.tensorboard and trainer.writes else None
            if watch is not None and isinstance(trainer, Trainer):
                watched = watch(trainer)
                stack.callback(watched.close)

            def on_step(now: Progress) -> None:
                display.on_step(now)
                if watched is not None:
                    watched.on_step(now)
                if board is not None:
                    board.on_step(now)

            trainer.on_step = on_step
            summary = _train(trainer)
            if board is not None:
                board.close()
        if not summary["complete"]:
            again = f" --data {shlex.quote(config.data)}" if is_outside(out, config.data) else ""
            say(f"stopped; continue with: voronerf train --resume --out {shlex.quote(str(out))}{again}")
            return summary
        if config.panels and isinstance(trainer, Trainer):
            with trainer.averaged():
                write_panels(trainer.renderer, trainer.diagram, scene, out / "images", views=config.panels)
        elif group is None:
            _draw_joint(config, scene)
        if trainer.writes:
            write_curve(out)
        if not quiet:
            say(f"wrote {out}: summary.json, metrics.jsonl, images/, plots/, checkpoints/")
        return summary


def _train(trainer: Trainer | JointTrainer) -> dict[str, Any]:
    """Runs a trainer that the signals of ``STOPPING`` stop; returns the summary."""
    # One that is ignored stays so, as under nohup or where a shell started it in the background.
    before = {number: signal.getsignal(number) for number in STOPPING}
    before = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def stop(number: int, frame: FrameType | None) -> None:
        trainer.request_stop()
        restore()

    for number in before:
        signal.signal(number, stop)
    try:
        return trainer.run()
    except SceneError:  # of images on disk that were cut short: what was learnt stays
        if isinstance(trainer, Trainer):  # ranks could not save together
            trainer.save()
        raise
    finally:
        restore()


def evaluate_run(
    run: Path,
    /,
    opening: Opening = AS_IN_TRAINING,
    views: int | None = None,
    panels: int = 4,
    lpips: Path | None = None,
) -> int:
    """Score a trained run on its test views and draw panels: truth, render, error, depth, cells.

    Args:
        run: The run directory.
        opening: How the run is opened.
        views: Number of test views, evenly spread; default all.
        panels: Number of views drawn.
        lpips: LPIPS weights, a file or folder, or "off"; default as in training, else VORONERF_LPIPS, the folder lpips
            of VORONERF_DATA or beside the scene, the installed lpips package.
    """
    if panels < 0:
        raise ConfigError(f"--panels must not be negative, got {panels}")
    check_counts(views=views)
    opened = opening.open(run)
    perceived, source = opened.find_lpips(lpips)
    if perceived is None:
        say(source)
    result = opened.evaluate(views=views, lpips=perceived or "off")
    table = Table("view", "psnr [dB]", "ssim", "lpips")
    for view in result["views"]:
        table.add_row(escape(printable(view["name"])), *_figures(view))
    table.add_section()
    table.add_row("mean", *_figures(result))
    console.print(table)
    say(f"PSNR of the mean squared error: {result['psnr_of_mean_error']:.2f} dB")
    write_text(run / "eval.json", json_text(result, indent=2) + "\n")
    if panels:
        write_panels(opened.renderer, opened.diagram, opened.scene, run / "images", views=panels)
    say(f"wrote {run / 'eval.json'}" + (f" and {run / 'images'}" if panels else ""))
    return 0


def render(
    run: Path,
    /,
    out: Path | None = None,
    path: Path | None = None,
    spiral: bool = False,
    frames: int = 60,
    fps: float | None = None,
    crop: Crop = None,
    opening: Opening = AS_IN_TRAINING,
) -> int:
    """Render a video of a trained run: a turntable, a spiral, or a camera path.

    Args:
        run: The run directory.
        out: The video file, .mp4; default turntable.mp4, spiral.mp4 or the name of the path in the run directory.
        path: Camera path in nerfstudio's format, such as the viewer saves; it has the frames and their size.
        spiral: Go where the training cameras are: up and down around an object, or a small spiral before a scene that
            was taken from one side, for which it is the default.
        frames: Frames of a turntable or a spiral.
        fps: Frames per second; default 24, or those of the path.
        crop: Show a box only, x y z of its lowest and of its highest corner, or "saved" for the viewer's.
        opening: How the run is opened.
    """
    check_counts(frames=frames)
    if fps is not None and not 0.01 <= fps <= 1000:
        raise ConfigError(f"--fps must be 0.01 to 1000, got {fps:g}")
    given = given_path(path, spiral)
    opened = opening.open_without_images(run, pictures=True)
    spiral = spiral or opened.scene.kind == "forward"
    name = path.stem if path is not None else "spiral" if spiral else "turntable"
    out = out or run / f"{name}.mp4"
    check_video(out)
    if given is not None:
        given = replace(given, frames=given.frames.downscaled(opening.downscale or 1))
    box = crop_box(opened, crop)
    export_video(opened, out, flight=given, spiral=spiral, frames=frames, fps=fps, box=box, track=tracked)
    say(f"wrote {out}")
    return 0


def given_path(path: Path | None, spiral: bool) -> CameraPath | None:
    """Reads the camera path of --path, if there is one."""
    if path is not None and spiral:
        raise ConfigError("--spiral must be off with --path, which has the frames")
    return None if path is None else read_camera_path(path)


def tracked(parts: Sequence[Any], name: str) -> Iterable[Any]:
    """The parts of a work, with a bar of its progress on a terminal."""
    return track(parts, description=name, console=console, disable=not console.is_terminal)


def import_viewer() -> ModuleType:
    """The viewer, which needs the extra."""
    try:
        return importlib.import_module("voronerf.app.viewer")
    except ImportError as error:
        raise ImportError(f"the viewer needs viser: pip install 'voronerf[viewer]' ({error})") from None


def serve_runs(viewer: Any, opening: Opening = AS_IN_TRAINING) -> None:
    """Serves a viewer of runs until Ctrl-C; its pages can open other runs, and train.

    Args:
        viewer: A `voronerf.app.viewer.Viewer`.
        opening: How runs are opened.
    """

    def read_images(run: Run) -> None:
        try:
            if opening.data is None:
                check_stored_paths(run.path, data=run.config.data)
            whole = load_scene(run.config.data, allow_outside=opening.allow_outside, **run.config.reading)
        except (ConfigError, ValueError, OSError) as error:
            say(f"without the images of the scene: {error}")
        else:
            viewer.do(lambda: viewer.subject.run is run and viewer.take_images(whole))

    def open_one(path: Path) -> Run:
        run = opening.open_without_images(path, pictures=True)
        if not len(run.scene.train.images) and opening.memory is None:
            threading.Thread(target=read_images, args=(run,), daemon=True).start()
        return run

    def train_one(config: TrainConfig, scene: Scene) -> None:
        run_training(config, scene, watch=partial(import_viewer().Training, viewer))

    viewer.open, viewer.train = open_one, train_one
    with contextlib.suppress(KeyboardInterrupt):
        viewer.warm_up()
        shown = viewer.subject.run
        if not len(shown.scene.train.images) and opening.memory is None:
            threading.Thread(target=read_images, args=(shown,), daemon=True).start()
        viewer.serve()


def preload(device: str = "cpu") -> int:
    """Compile the Warp kernels now rather than at their first use; WARP_CACHE_PATH says where they are kept.

    Args:
        device: Torch device to compile for.
    """
    check_device(device)
    target = torch.device(device)
    reason = backends.missing("warp", target)
    if reason is not None:
        raise backends.BackendUnavailable(f"preload: {reason}")
    # By name and here, since importing it needs Warp.
    kernels = importlib.import_module("voronerf.kernels")
    seconds = kernels.preload(target)
    table = Table("kernels", "seconds")
    for name, took in seconds.items():
        table.add_row(name, f"{took:.2f}")
    console.print(table)
    cache = kernels.describe()["cache"]
    say(f"{len(seconds)} files in {sum(seconds.values()):.1f} s, kept in {cache}")
    return 0


def process(
    source: Path,
    out: Path,
    /,
    frames: int = 150,
    matching: Literal["auto", "exhaustive", "sequential"] = "auto",
    camera_model: str = "SIMPLE_RADIAL",
    mapper: Literal["auto", "global", "incremental"] = "auto",
    max_features: int = 4096,
    verbose: bool = False,
) -> int:
    """Make a scene of a video or of images: COLMAP finds the cameras. A stopped one goes on with the same command.

    Args:
        source: A video, or a folder of PNG or JPEG images.
        out: The folder to make; it gets images, sparse/0, transforms.json and colmap, which keeps every stage.
        frames: Frames taken of a video, evenly spread.
        matching: Which images are compared: all with all, each with those next to it by name, or those that share
            their largest features (auto).
        camera_model: COLMAP's name of the lens, such as SIMPLE_RADIAL, OPENCV or OPENCV_FISHEYE.
        mapper: How cameras are found; auto is global, and incremental too if that model has faults.
        max_features: Of an image.
        verbose: Show what COLMAP says.
    """
    check_counts(frames=frames, max_features=max_features)
    display = StageDisplay(console)
    with display.progress:
        make_scene(
            source,
            out,
            frames=frames,
            matching=matching,
            camera_model=camera_model,
            mapper=mapper,
            max_features=max_features,
            verbose=verbose,
            say=display.say,
            progress=display.show,
        )
    return 0


def _figures(score: dict[str, Any]) -> list[str]:
    """What a table shows of a score; a dash for what was not computed."""
    places = {"psnr": 2, "ssim": 4, "lpips": 4}
    return ["-" if score[name] is None else f"{score[name]:.{digits}f}" for name, digits in places.items()]
