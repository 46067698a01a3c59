"""``voronerf train``: runs a training, with its display, signal handling and pictures."""

from __future__ import annotations

import contextlib
import functools
import glob
import importlib.util
import inspect
import itertools
import os
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import torch
import tyro

from voronerf.app.cli.display import TrainingDisplay, busy, exit_on_sigterm, say, tracked
from voronerf.app.cli.export import export
from voronerf.app.cli.process import AS_IN_PROCESS, CaptureSettings, find_cameras, prefixed_options
from voronerf.app.cli.render import render
from voronerf.app.cli.view import import_viewer
from voronerf.app.evaluate.lpips import find_lpips
from voronerf.app.evaluate.panels import write_panels
from voronerf.app.files import read_json
from voronerf.app.run import open_run
from voronerf.app.scenes import Scene, SceneError, load_scene, needs_cameras
from voronerf.app.scenes.process import RECORD, Settings
from voronerf.app.train.build import build, present_device
from voronerf.app.train.callbacks import (
    CHECKPOINT_EVERY,
    Checkpoints,
    Divergence,
    Scores,
    TensorBoard,
    tensorboard_writer,
)
from voronerf.app.train.checkpoint import Checkpoint, checkpoint_paths, last_checkpoint
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.defaults import machine_speed, why_no_occupancy
from voronerf.app.train.loop import Callback, run
from voronerf.app.train.resume import load
from voronerf.app.train.run_directory import (
    check_stored_paths,
    choose_directory,
    held,
    is_outside,
    read_config,
    read_curve,
    remember_choice,
    stored_config,
    write_curve,
)
from voronerf.app.train.state import HALVES, State
from voronerf.nerf.distributed import PeerLost, Ranks
from voronerf.ops._core import backends

#: The maximum length of a picture's name without its suffix, in bytes, on most file systems.
LONGEST_NAME = 255 - len(".png")
#: Default number of panels.
PANELS = 4
#: The folder of a run with the scene that was made of a video or of pictures.
CAPTURE = "capture"
#: Signals that end a training with a checkpoint: Ctrl-C, kill, a closed terminal, and the warning that Slurm can send.
STOPPING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1") if hasattr(signal, name)]

#: Printed before a training without any options.
WHAT_TO_TRY = """This trains the built-in scene for 480 s, into runs/. Ctrl-C stops it. Other things to try:
  voronerf train --budget 60                the same for a minute
  voronerf train --data walk.mp4            your video or your pictures: finds the cameras first
  voronerf train --data DIR --downscale 4   your scene: Blender, transforms.json, COLMAP or LLFF
  voronerf train --view                     watch it in a browser
  voronerf demo                             a picture and a video of the built-in scene in two minutes
  voronerf train --help                     every option"""


def train(
    config: TrainConfig,
    *,
    resume: bool = False,
    file: Annotated[Path | None, tyro.conf.arg(name="config")] = None,
    checkpoint_every: float = CHECKPOINT_EVERY,
    panels: int | None = None,
    tensorboard: bool = False,
    view: bool = False,
    host: str = "127.0.0.1",
    port: int = 8080,
    explain: bool = False,
    capture: CaptureSettings = AS_IN_PROCESS,
) -> int:
    """Train a scene: first one coarse network, then a network for each Voronoi cell.

    With --resume, omitted options keep their value from the run in --out. If --data is a video, or a folder of pictures
    or videos without cameras, COLMAP finds the cameras first, see voronerf process. Then the folder capture of the run
    is the scene, and the trained run gets a video and a page for browsers.

    Args:
        config: The settings.
        resume: Continue the run in --out from its last checkpoint. With several processes, also start a run, so that a
            restart by torchrun continues it.
        file: JSON of settings by name, such as the config.json of a run; options on the command line override it.
        checkpoint_every: Seconds of training between checkpoints, which are written in the background.
        panels: Number of test views drawn as panels at the end: truth, render, error, depth, cells. Default 4; with a
            --budget, as many as fit into a tenth of it, at least one.
        tensorboard: Also write loss, speed, cells and scores for TensorBoard, into the folder tensorboard of the run.
        view: Show the training in a browser, and its result until Ctrl-C.
        host: Address that --view listens on; the default is for this machine only, 0.0.0.0 lets others in.
        port: Port that --view listens on; 0 is any free port.
        explain: Only print how a training step is computed, and what prevents a faster implementation.
        capture: The settings of COLMAP.
    """
    ranks = Ranks.join(present_device(config.device))  # fails before the scene is read
    if ranks.size > 1:
        if config.out is None:
            raise ConfigError("--out must be given with several processes, so that a restart finds the run")
        if config.device.startswith("cuda:"):
            raise ConfigError(f"--device must be cuda, without a number, with several processes, got {config.device}")
        if needs_cameras(config.data):
            rule = "--data must be a scene with several processes; voronerf process makes one"
            raise ConfigError(f"{rule}, got {config.data}")
        if ranks.rank:
            return 0 if explain else follow(config, ranks)
    if panels is not None and panels < 0:
        raise ConfigError(f"--panels must be 0 or more, got {panels}")
    if not checkpoint_every > 0:
        raise ConfigError(f"--checkpoint-every must be a positive number of seconds, got {checkpoint_every:g}")
    if view:
        import_viewer().check_address(host, port)
    if tensorboard:
        tensorboard_writer()
    if not resume and needs_cameras(config.data):
        config, status = with_cameras(config, capture)
        if status:
            return status
    is_capture = config.out is not None and Path(config.data).resolve() == (config.out / CAPTURE).resolve()
    try:
        with busy(f"reading {config.data}"):
            scene = load_scene(config.data, **config.reading)
    except SceneError:
        if not checkpoint_paths(Path(config.data)):
            raise
        again = shlex.join(["voronerf", "train", "--resume", "--out", config.data])
        raise ConfigError(f"--data must be a scene, got the run {config.data}; {again} continues it") from None
    if is_capture:
        scene = replace(scene, name=Path(config.data).resolve().parent.name)
    if explain:
        state = build(config, scene)
        for line in (*state.ray_loss.explain().splitlines(), state.training_step.explain()):
            say(line)
        return 0
    chosen = choose_directory(config, scene.name, resume=resume)
    assert chosen.out is not None
    for path in (config.data, config.lpips):
        if path is not None and is_outside(chosen.out, path):
            remember_choice(path)
    with contextlib.ExitStack() as stack:
        if config.out is None:
            stack.callback(_remove_empty, chosen.out)
        viewers: list[Any] = []

        def watch(state: State, scores: Scores) -> Callback:
            watched = import_viewer().watch(state, scores, host=host, port=port)
            stack.callback(watched.viewer.close)
            say(watched.viewer.audience)
            viewers.append(watched.viewer)
            return watched

        options: dict[str, Any] = {"checkpoint_every": checkpoint_every, "panels": panels, "tensorboard": tensorboard}
        summary = run_training(chosen, scene, resume=resume, watch=watch if view else None, **options)
        if is_capture and summary["complete"]:
            status = finish(chosen.out)
            if status:
                return status
        for viewer in viewers:
            if summary["complete"]:
                say(f"{viewer.address} shows the run until Ctrl-C")
                opened = open_run(chosen.out, scene=scene, backend=config.backend)
                viewer.show(import_viewer().Subject.of(opened), read_curve(chosen.out))
                with contextlib.suppress(KeyboardInterrupt):
                    viewer.serve()
    return 0 if summary["complete"] or ranks.size > 1 else 130  # torchrun starts failed processes again


def follow(config: TrainConfig, ranks: Ranks) -> int:
    """Trains as any process but the first, which alone prints, evaluates and writes files.

    Returns:
        The exit status.
    """
    scene = load_scene(config.data, **config.reading)
    try:
        none: tuple[float, Checkpoint | None] = (1.0, None)
        speed, checkpoint = ranks.first(none)
        state = build(config, scene, speed=speed, ranks=ranks)
        if checkpoint is not None:
            load(state, checkpoint)
            state.strategy.forget()  # these samples belong to the first process
        with stopped_by_signals(state.stop):
            run(state)
    except PeerLost:  # the first process prints the reason, or torchrun if that process has ended
        return 1
    return 0


def with_cameras(config: TrainConfig, settings: CaptureSettings) -> tuple[TrainConfig, int]:
    """Makes a scene of a video or a folder of pictures, in the folder `CAPTURE` of a run.

    Without --out, the run is one that has the same data and settings and was stopped before its training, or a new one.

    Returns:
        (the settings with this scene and run, 0 or the exit status after a stop).
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise ImportError("finding cameras needs pycolmap: pip install 'voronerf[colmap]'")
    source = Path(config.data)
    name = source.resolve().stem if source.is_file() else source.resolve().name
    wanted = Settings.of([source], **vars(settings))
    begun = _begun(name, wanted) if config.out is None else None
    chosen = choose_directory(replace(config, out=begun or config.out), name)
    assert chosen.out is not None
    capture = chosen.out / CAPTURE
    with contextlib.ExitStack() as stack:
        if config.out is None:
            stack.callback(_remove_empty, chosen.out)
        stack.enter_context(held(chosen.out))
        stack.enter_context(exit_on_sigterm())
        with prefixed_options(settings):
            is_made = (capture / "colmap" / RECORD).is_file() and wanted.is_done(capture)
        status = 0 if is_made else find_cameras([source], capture, settings)
    return replace(chosen, data=str(capture)), status


def _begun(name: str, settings: Settings) -> Path | None:
    """Returns the last run of this name that has these settings and was stopped before its training, or None."""
    for record in sorted(Path("runs").glob(f"{glob.escape(name)}*/{CAPTURE}/colmap/{RECORD}"), reverse=True):
        run = record.parents[2]
        with contextlib.suppress(ValueError, OSError, ConfigError):  # damaged, or in use by another process
            if not checkpoint_paths(run) and read_json(record, dict) == settings._asdict():
                with held(run):
                    return run
    return None


def finish(run: Path) -> int:
    """Makes a video and a page of a trained run, and returns the exit status."""
    try:
        with exit_on_sigterm():
            for make in (lambda: render(run), lambda: export(run, web=run / "scene.html")):
                try:
                    make()
                except (ValueError, ImportError, OSError) as error:  # such as a field for which pages have no code
                    say(f"{error}")
    except (KeyboardInterrupt, SystemExit) as stop:
        say(f"stopped; the run is trained: voronerf render {shlex.quote(str(run))} makes its video")
        return stop.code if isinstance(stop, SystemExit) and isinstance(stop.code, int) else 130
    return 0


def continuation(config: TrainConfig) -> str:
    """Returns the command line that continues a stopped run."""
    assert config.out is not None
    words = ["voronerf", "train", "--resume", "--out", str(config.out)]
    for option, path in (("--data", config.data), ("--lpips", config.lpips)):
        if path is not None and is_outside(config.out, path):
            words += [option, str(path)]
    return shlex.join(words + ["--allow-outside"] * config.allow_outside)


def _remove_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()  # fails for a folder with files, which stays


def _compile_kernels(config: TrainConfig) -> None:
    """Compiles the Warp kernels of a step, with a progress bar; on a GPU, prints which backend runs the operations."""
    device, dtype = torch.device(config.device), HALVES.get(config.precision, torch.float32)
    if device.type == "cuda" and config.backend == "auto":
        say(f"operations run on {backends.automatic(device)}")
    if backends.chosen("grouped_mlp", device, dtype, backend=config.backend) != "warp":
        return
    if device.type == "cpu":
        say("--backend warp computes on the CPU here, far slower than --backend auto; for a GPU add --device cuda")
    kernels = importlib.import_module("voronerf.kernels")
    start = time.perf_counter()
    for compiled in tracked(kernels.loads(device, dtype), "compiling Warp kernels"):
        compiled()
    if (seconds := time.perf_counter() - start) > 1:
        say(f"Warp compiled kernels in {seconds:.0f} s, and keeps them in {kernels.describe()['cache']}")


def run_training(
    config: TrainConfig,
    scene: Scene,
    *,
    resume: bool = False,
    checkpoint_every: float = CHECKPOINT_EVERY,
    panels: int | None = None,
    tensorboard: bool = False,
    watch: Callable[[State, Scores], Callback] | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Trains into ``config.out`` with a display, then draws panels and the curve; returns the summary.

    ``watch`` makes the callback that shows the training in a viewer. ``quiet`` prints only the live line. Of
    several processes, the first calls this function; the others call `follow`.

    Ctrl-C, SIGTERM, SIGHUP and SIGUSR1 end training after the current step: the checkpoint and the summary are written,
    the pictures are not. A second signal ends the process at once.
    """
    out = config.out
    assert out is not None
    longest = max(scene.test.names, key=lambda name: len(os.fsencode(name)))
    if panels != 0 and len(os.fsencode(longest)) > LONGEST_NAME:
        raise ConfigError(f"--panels must be 0 with image names of more than {LONGEST_NAME} bytes, got {longest}")
    _compile_kernels(config)
    with held(out):
        display = TrainingDisplay(scene.name, quiet=quiet)
        with display.progress:
            for note in scene.notes:
                display.on_event(f"{scene.name}: {note}")
            # A resumed run keeps its settings.
            measured = config.budget is not None and not resume and present_device(config.device) == "cpu"
            speed = machine_speed() if measured else 1.0
            checkpoint = last_checkpoint(out) if resume else None
            ranks = Ranks.join(present_device(config.device))
            ranks.first((speed, checkpoint))
            state = build(config, scene, on_event=display.on_event, speed=speed, ranks=ranks)
            if checkpoint is not None:
                load(state, checkpoint)
            lpips = find_lpips(config.lpips, config.data, scene.test.cameras.smallest[::-1])
            if config.occupancy and not state.config.occupancy:
                obstacle = why_no_occupancy(state.config) or "a scene without a box"
                display.on_event(f"every sample is evaluated, also in empty space: no occupancy grid with {obstacle}")
            checkpoints, scores = Checkpoints(out, checkpoint_every), Scores(out, lpips, display.track)
            callbacks: list[Callback] = [Divergence(out), checkpoints, scores, display.following(scores)]
            if tensorboard:
                callbacks.append(TensorBoard(out / "tensorboard", scores))
            watched = None if watch is None else watch(state, scores)
            callbacks += [] if watched is None else [watched]
            with stopped_by_signals(state.stop):
                try:
                    run(state, callbacks)
                except SceneError:  # truncated image files: the checkpoint keeps the training so far
                    checkpoints.on_end(state)
                    raise
        if not scores.summary["complete"]:
            say(f"stopped; continue with: {continuation(config)}")
            return scores.summary
        if panels is None:
            panels = scores.affordable(config.budget, PANELS)
        if panels:
            with state.averaged():
                write_panels(state.renderer, state.router.diagram, scene, out / "images", views=panels, track=tracked)
        write_curve(out)
        if not quiet:
            say(f"wrote {out}: summary.json, metrics.jsonl, images/, plots/, checkpoints/")
        return scores.summary


@contextlib.contextmanager
def stopped_by_signals(stop: Callable[[], None]) -> Iterator[None]:
    """A context in which the first signal of ``STOPPING`` calls ``stop``, and a second signal ends the process."""
    # An ignored signal stays ignored, as under nohup or in a shell's background job.
    handlers = {number: signal.getsignal(number) for number in STOPPING}
    handlers = {number: handler for number, handler in handlers.items() if handler not in (signal.SIG_IGN, None)}

    def restore() -> None:
        for number, handler in handlers.items():
            signal.signal(number, handler)

    def handle(number: int, frame: FrameType | None) -> None:
        stop()
        restore()

    for number in handlers:
        signal.signal(number, handle)
    try:
        yield
    finally:
        restore()


def without_early_resume(words: list[str]) -> list[str]:
    """Returns the arguments of a training, without --resume if several processes have no checkpoint to resume.

    ``torchrun`` repeats the same command after a process has ended, perhaps before the first checkpoint.
    """
    out, file = _option_path(words, "--out"), _option_path(words, "--config")
    is_several = os.environ.get("WORLD_SIZE", "1") != "1"
    if not is_several or out is None or file is not None or checkpoint_paths(out):
        return words
    return [word for word in words if word != "--resume"]


def with_stored_settings(command: Callable[..., int], args: list[str]) -> Callable[..., int]:
    """Returns a training command whose defaults are the settings of --config or, to resume, of the run in --out."""
    file, out = _option_path(args, "--config"), _option_path(args, "--out")
    if file is None and "--resume" not in args:
        return command
    if file is not None and "--resume" in args:
        raise ConfigError("--config must be left out with --resume, which continues with the settings of the run")
    if file is not None and not file.is_file():
        inside = file / "config.json"
        hint = f"it is a folder; did you mean {inside}?" if inside.is_file() else "it is a folder"
        raise ConfigError(f"--config {file}: {hint if file.is_dir() else 'there is no such file'}")
    stored = read_config(file) if file is not None else None if out is None else stored_config(out)
    folder = out if file is None else file.parent
    if folder is None or stored is None:
        if {"-h", "--help"}.intersection(args):
            return command
        nothing = "--resume needs --out, the run directory to continue"
        raise ConfigError(nothing if out is None else f"no run at {out}: there is nothing to resume")

    def is_given(name: str) -> bool:
        return any(word == f"--{name}" or word.startswith(f"--{name}=") for word in args)

    check_stored_paths(
        folder, data=None if is_given("data") else stored.data, lpips=None if is_given("lpips") else stored.lpips
    )
    # On the command line, --steps replaces a stored budget, and --budget replaces stored steps. The placeholder set
    # here is overwritten by the option.
    length = {name for name in ("budget", "steps") if is_given(name)}
    if length == {"steps"} and stored.budget is not None:
        stored = replace(stored, budget=None, steps=2**53 - 1)
    elif length == {"budget"} and stored.steps is not None:
        stored = replace(stored, budget=sys.float_info.max, steps=None)

    @functools.wraps(command)
    def with_settings(config: TrainConfig = stored, **others: Any) -> int:
        return command(config, **others)

    first, *others = inspect.signature(command).parameters.values()
    signature = inspect.Signature([first.replace(default=stored), *others])
    with_settings.__signature__ = signature  # type: ignore[attr-defined]
    return with_settings


def _option_path(args: list[str], option: str) -> Path | None:
    """Returns the value of an option that is a path, or None."""
    path = next((value for word, value in itertools.pairwise(args) if word == option), None)
    path = next((word.removeprefix(f"{option}=") for word in args if word.startswith(f"{option}=")), path)
    return None if path is None else Path(path)
