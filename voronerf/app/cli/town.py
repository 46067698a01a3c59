"""``voronerf join | cut | place | train-territories``: runs of several parts."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
import tyro

from voronerf.app.cli.display import TrainingDisplay, busy, say, tracked
from voronerf.app.cli.train import continuation, stopped_by_signals
from voronerf.app.evaluate.panels import write_panels
from voronerf.app.files import json_text, write_text
from voronerf.app.run import BOX
from voronerf.app.scenes import BUILTIN, load_scene
from voronerf.app.scenes.record import read_scene
from voronerf.app.train.build import present_device
from voronerf.app.train.callbacks import CHECKPOINT_EVERY, counted
from voronerf.app.train.checkpoint import checkpoint_paths
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.run_directory import choose_directory, held
from voronerf.app.wording import as_typed
from voronerf.town import editing, open_run
from voronerf.town import train as territories_train
from voronerf.town.editing import Source, check_out
from voronerf.town.geometry import Similarity, Solid
from voronerf.town.group import Group, local_rank, restarts
from voronerf.town.run import stored_territories

#: The text that describes a transform in error messages.
MOVE = "seven finite numbers tx ty tz rx ry rz s, the scale s 1e-9 to 1e9"


def tell(out: Path, written: Source) -> int:
    """Prints the path, cells, parts and size of a written run."""
    counts = {"cell": written.parts.num_cells, "part": len(written.parts.parts)}
    cells, parts = (counted(count, name) for name, count in counts.items())
    size = sum(file.stat().st_size for file in (out / "checkpoints").iterdir())
    say(f"wrote {out}: {cells} in {parts}, {size / 2**20:.1f} MiB")
    return 0


def join(
    runs: tuple[Path, ...],
    /,
    out: Path,
    move: tyro.conf.UseAppendAction[tuple[tuple[str, str], ...]] = (),
    align: bool = False,
) -> int:
    """Join several runs into one. Where they overlap, the nearest centre decides; the runs are not changed.

    Args:
        runs: Two run directories or more; the first gives data, background and settings.
        out: The new run directory.
        move: N "tx ty tz rx ry rz s", once for each run to move: run N, counted from 1, is scaled by s, turned by
            angles in degrees about x, y, z, then moved.
        align: Find the transforms of all runs but the first, from the cameras of images that have the same name in
            both runs.
    """
    check_out(out)
    if len(runs) < 2:
        raise ConfigError(f"join needs two runs or more, got {len(runs)}")
    frames = given_frames(len(runs), move)
    if align and frames:
        raise ConfigError("give --align or --move, not both")
    if align:
        first, *others = (read_scene(run / "scene.json") for run in runs)
        for number, scene in enumerate(others, 1):
            frame, error, count = editing.align(first, scene, str(runs[number]))
            say(
                f"{runs[number]}: scale {frame.scale:.6g}, {count} images in common, "
                f"their cameras {error:.3g} scene units apart"
            )
            frames[number] = frame
    transforms = [frames.get(number, Similarity()) for number in range(len(runs))]
    with busy("joining"):
        written = editing.join(runs, out, frames=transforms)
    return tell(out, written)


def given_frames(runs: int, move: Sequence[tuple[str, str]]) -> dict[int, Similarity]:
    """Parses --move into a transform for each moved run; runs are counted from 0."""
    frames: dict[int, Similarity] = {}
    for number, text in move:
        if not number.isdecimal() or not 1 <= int(number) <= runs:
            raise ConfigError(f"--move {number}: must be the number of a run, 1 to {runs}")
        if int(number) - 1 in frames:
            raise ConfigError(f"--move {number}: must be given once")
        try:
            tx, ty, tz, rx, ry, rz, s = map(float, text.replace(",", " ").split())
            frames[int(number) - 1] = Similarity.of((tx, ty, tz), (rx, ry, rz), s)
        except ValueError:
            raise ConfigError(f"--move {number} must be {MOVE}, got {text!r}") from None
    return frames


def cut(
    run: Path,
    /,
    out: Path,
    box: tuple[float, float, float, float, float, float] | None = None,
    sphere: tuple[float, float, float, float] | None = None,
    cells: tuple[int, ...] | None = None,
    outside: bool = False,
) -> int:
    """Make a new run with only a region of a run, or with --outside all but the region; the run is not changed.

    Args:
        run: The run directory.
        out: The new run directory.
        box: x y z of the lowest and of the highest corner.
        sphere: x y z of the centre, and the radius.
        cells: Numbers of cells, as the viewer shows them.
        outside: Keep everything outside the region instead.
    """
    check_out(out)
    named = {name: value for name, value in (("box", box), ("sphere", sphere), ("cells", cells)) if value is not None}
    if len(named) != 1:
        options = " and ".join(f"--{name}" for name in named) or "none"
        raise ConfigError(f"cut needs one of --box, --sphere and --cells, got {options}")
    try:
        solid = Solid.box(box[:3], box[3:]) if box is not None else None if sphere is None else Solid(ball=sphere)
    except ValueError:
        rule = BOX if box is not None else "finite x y z of the centre and a radius above 0"
        ((name, value),) = named.items()
        raise ConfigError(f"--{name} must be {rule}, got {as_typed(value)}") from None
    kept = list(cells or ()) if solid is None else solid
    with busy("cutting"):
        written = editing.cut(run, kept, out, outside=outside)
    return tell(out, written)


def place(
    run: Path,
    object_run: Path,
    /,
    out: Path,
    at: tuple[float, float, float],
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    scale: float = 1.0,
) -> int:
    """Place an object into a scene, as a new run; its density is added to the scene's. Neither run is changed.

    Args:
        run: The run directory of the scene.
        object_run: The run directory of the object, cut out with voronerf cut, or trained on white.
        out: The new run directory.
        at: Position x y z in the scene of the bottom centre of the object's box.
        turn: Degrees about the axes x, y, z, in this order.
        scale: Factor on the object's size.
    """
    check_out(out)
    for name, value in (("at", at), ("turn", turn)):
        if not all(map(math.isfinite, value)):
            raise ConfigError(f"--{name} must be three finite numbers, got {as_typed(value)}")
    try:
        Similarity.of(scale=scale)
    except ValueError:
        raise ConfigError(f"--scale must be 1e-9 to 1e9, got {as_typed(scale)}") from None
    with busy("placing"):
        written = editing.place(run, object_run, at, out, degrees=turn, scale=scale)
    return tell(out, written)


def train_territories(
    config: TrainConfig,
    *,
    territories: int | None = None,
    resume: bool = False,
    file: Annotated[Path | None, tyro.conf.arg(name="config")] = None,
    checkpoint_every: float = CHECKPOINT_EVERY,
    panels: int = 4,
) -> int:
    """Train a large scene in territories, each with its own cells, hash table, views and rays.

    The rays of a territory may cross into other territories.

    `torchrun --nproc-per-node 4 -m voronerf train-territories --out RUN` distributes the territories over processes.
    The run is the same bit for bit on any number of processes. The finished run is scored; `eval`, `view`, `join` and
    `cut` open it.

    Args:
        config: The settings of each territory.
        territories: Number of territories; default as in a resumed run, else the smallest power of two that gives every
            process a territory.
        resume: Continue the run in --out from its last checkpoint.
        file: JSON of settings by name, such as the config.json of a run; options on the command line override it.
        checkpoint_every: Seconds of training between checkpoints.
        panels: Number of test views drawn as panels at the end.
    """
    name = present_device(config.device)
    device = torch.device(present_device(f"cuda:{local_rank()}") if name == "cuda" else name)
    config = replace(config, device=str(device))
    group = Group.join(device)
    try:
        with contextlib.ExitStack() as stack:
            if group.rank:  # only rank 0 prints
                null = stack.enter_context(open(os.devnull, "w"))
                stack.enter_context(contextlib.redirect_stdout(null))
                stack.enter_context(contextlib.redirect_stderr(null))
            group.meet()
            stored = stored_territories(config.out) if resume and config.out is not None else None
            count = territories or stored or 1 << (group.size - 1).bit_length()
            return _train_territories(config, group, count, resume, checkpoint_every, panels)
    except Exception as error:
        if group.may_tell(error):
            raise
        return 1


def _train_territories(
    config: TrainConfig, group: Group, count: int, resume: bool, checkpoint_every: float, panels: int
) -> int:
    """Trains on this rank; rank 0 writes the scores of the finished run."""
    group.check_same(config, count)
    territories_train.check_territories(config, count, group.size)
    out, reading = config.out, dict(config.reading)
    assert out is not None
    if group.size > 1 and config.data != BUILTIN:  # ranks read their images from one copy on disk
        reading["images"] = "disk"
    with busy(f"reading {config.data}"):
        scene = load_scene(config.data, **reading)
    group.check_same_scene(scene)
    if group.rank == 0:  # only rank 0: other ranks would find the directory that it has made
        resume = resume or (restarts() > 0 and bool(checkpoint_paths(out)))
        choose_directory(config, scene, resume=resume)
    resume = group.gather(resume)[0]
    with held(out) if group.rank == 0 else contextlib.nullcontext():
        display = TrainingDisplay(scene.name)
        with display.progress:
            town = territories_train.build_town(config, scene, count, group, on_event=display.on_event)
            if resume:
                territories_train.resume(town)
            with stopped_by_signals(town.stop):
                territories_train.train(town, [display], checkpoint_every=checkpoint_every)
        summary = territories_train.summary_of(town)
        group.leave()  # so that the other ranks do not wait for the pictures
        if group.rank == 0:
            if summary["complete"]:
                opened = open_run(out, scene=scene, backend=config.backend)
                summary |= opened.evaluate(views=config.eval_views, lpips=config.lpips, track=tracked)
                cells = counted(summary["cells"], "cell")
                say(f"{count} territories, {cells}: psnr {summary['psnr']:.2f} dB")
                if panels:
                    write_panels(
                        opened.renderer, opened.diagram, opened.scene, out / "images", views=panels, track=tracked
                    )
            write_text(out / "summary.json", json_text(summary, indent=2) + "\n")
            start = f"torchrun --nproc-per-node {group.size} -m " * (group.size > 1)
            again = continuation(f"{start}voronerf train-territories", config)
            say(f"wrote {out}" if summary["complete"] else f"stopped; continue with: {again}")
    return 0 if summary["complete"] else 130
