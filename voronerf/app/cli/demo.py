"""``voronerf demo``: a city that one small network cannot hold, and cells of that network, at equal training time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from rich.progress import track
from torch import Tensor

from voronerf.app.cli.display import console, say
from voronerf.app.cli.train import run_training
from voronerf.app.evaluate.panels import contact_sheet, picture_of_colour, save_picture
from voronerf.app.render.video import check_video, write_video
from voronerf.app.run import Run, open_run
from voronerf.app.scenes import BUILTIN_SIZE, city_scene
from voronerf.app.scenes.builtin.city import city_views
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.run_directory import held
from voronerf.nerf.cameras import Cameras, orbit_cameras

#: Views of each block.
TRAIN_VIEWS, TEST_VIEWS = 24, 4
#: Pixels along a side of the picture and of the video, and frames of one turn around the city.
PICTURE, FRAME, FRAMES, FPS = 400, 240, 60, 20


def demo(
    out: Path = Path("runs/demo"),
    budget: float = 30.0,
    cells: int = 64,
    blocks: int = 3,
    size: int = 50,
) -> int:
    """Train a built-in city twice for the same time, with one small network and with one in each cell, and compare.

    Args:
        out: Folder for the two runs, wipe.png and wipe.mp4; `one` and `cells` inside it are replaced.
        budget: Training seconds of each run.
        cells: Voronoi cells.
        blocks: Blocks on each side of the city.
        size: Pixels along the side of the images, 100 over a whole number.
    """
    downscale = BUILTIN_SIZE // size if 1 <= size <= BUILTIN_SIZE else 0
    if not downscale or BUILTIN_SIZE // downscale != size:
        raise ConfigError(f"--size must be {BUILTIN_SIZE} over a whole number, 50, 33, 25, 20, 16, ..., got {size}")
    if cells < 2:
        raise ConfigError(f"--cells must be at least 2, got {cells}")
    configs = {
        name: TrainConfig(
            data=f"builtin-city:{blocks}x{blocks}",
            downscale=downscale,
            out=out / name,
            budget=budget,
            field="nerf",
            width=16,
            cells=levels,
            split_at=(0.1,) * len(levels),
            samples=(96,),
            evaluations=1,
            eval_views=10**6,  # all of them, beside the budget
        )
        for name, levels in (("one", ()), ("cells", (cells,)))
    }
    scene = city_scene(size, blocks=blocks, train_views=TRAIN_VIEWS, test_views=TEST_VIEWS, images="cached")
    check_video(out / "wipe.mp4")
    say(f"a city of {blocks} x {blocks} blocks: {len(scene.train)} views of {size} x {size} pixels")
    runs, scores = {}, {}
    for name, config in configs.items():
        with held(out / name):
            _remove_run(out / name)
        say(f"{f'{cells} cells with a network of that size each' if config.cells else 'one network'}, {budget:g} s")
        scores[name] = run_training(config, scene, panels=0, quiet=True)
        if not scores[name]["complete"]:
            return 130
        runs[name] = open_run(out / name, scene=scene)
    captions = {name: f"{score['psnr']:.2f} dB" for name, score in scores.items()}
    caption = f"one network, {captions['one']} | {cells} cells, {captions['cells']}"
    around = _around(blocks, PICTURE)
    truth = city_views(_part(around, 0, 0, PICTURE), (blocks, blocks)).truth(0, scene.background_colour())
    pictures = {caption: _wiped(runs, around, 0, PICTURE // 2), "truth": picture_of_colour(truth)}
    save_picture(out / "wipe.png", contact_sheet(pictures))
    around = _around(blocks, FRAME)
    lines = [round(FRAME * (0.5 + 0.5 * math.cos(2 * math.pi * frame / FRAMES))) for frame in range(FRAMES)]
    frames = track(range(FRAMES), "the video", console=console, transient=True)
    write_video(out / "wipe.mp4", (_wiped(runs, around, frame, lines[frame]) for frame in frames), FPS)
    for line in _verdict(scores["one"], scores["cells"], cells, budget):
        say(line)
    say(f"{out / 'wipe.png'} and {out / 'wipe.mp4'}: left of the line one network, right of it {cells} cells")
    return 0


def _verdict(one: dict[str, Any], many: dict[str, Any], cells: int, budget: float) -> Iterator[str]:
    """What both came to, and what cells gave or cost."""
    for name, found in (("one network", one), (f"{cells} cells", many)):
        yield (
            f"{name + ':':<12} {found['psnr']:.2f} dB, SSIM {found['ssim']:.3f}, {found['steps']:,} steps, "
            f"{found['parameters']:,} parameters"
        )
    gain = many["psnr"] - one["psnr"]
    yield (
        f"After the same {budget:g} s, {cells} cells are {abs(gain):.2f} dB {'better' if gain >= 0 else 'worse'} on "
        f"{one['views']} views that neither has seen: {abs(1 - 10 ** (-gain / 10)):.0%} "
        f"{'less' if gain >= 0 else 'more'} squared error."
    )


def _around(blocks: int, size: int) -> Cameras:
    """A turn around the middle of the city, above its roofs."""
    return orbit_cameras(
        FRAMES,
        radius=1.1 * blocks,
        elevation=35.0,
        width=size,
        height=size,
        focal=1.25 * size,
        centre=(0.0, 0.0, 0.1),
        start=20.0,
    )


def _part(cameras: Cameras, number: int, first: int, last: int) -> Cameras:
    """One camera, of whose picture there are columns first to last - 1."""
    intrinsics = cameras.intrinsics[number : number + 1] - torch.tensor((0.0, 0.0, first, 0.0))
    return Cameras(cameras.poses[number : number + 1], intrinsics, last - first, cameras.height)


def _wiped(runs: dict[str, Run], cameras: Cameras, number: int, line: int) -> Tensor:
    """A picture uint8 [h, w, 3]: one network left of a column, cells from it on, and a white line where they meet."""
    sides = (("one", 0, line), ("cells", line, cameras.width))
    parts = [
        picture_of_colour(runs[name].render(_part(cameras, number, first, last), heaviest=False).colour)
        for name, first, last in sides
        if first < last
    ]
    picture = torch.cat(parts, dim=1)
    if len(parts) == 2:
        picture[:, line - 1 : line + 1] = 255
    return picture


def _remove_run(run: Path) -> None:
    """Removes the files of an earlier demo, and no file that a run does not write."""
    for pattern in ("config.json", "metrics.jsonl", "summary.json", "eval.json", "scene.json"):
        (run / pattern).unlink(missing_ok=True)
    for folder in ("checkpoints", "images", "plots", "samples"):
        for file in (run / folder).glob("*"):
            file.unlink()
