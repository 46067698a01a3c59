"""``voronerf demo``: trains a built-in scene for half a minute; draws it, its cells, and a small copy on top of it."""

from __future__ import annotations

import importlib.util
import shlex
import shutil
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor

from voronerf.app.cli.display import console, say, tracked
from voronerf.app.cli.train import run_training
from voronerf.app.evaluate.panels import contact_sheet, picture_of_cells, picture_of_colour, save_picture
from voronerf.app.render.video import check_video, write_video
from voronerf.app.run import Run, open_run
from voronerf.app.scenes import Scene, load_scene
from voronerf.app.train.callbacks import counted
from voronerf.app.train.config import TrainConfig
from voronerf.app.train.run_directory import choose_directory
from voronerf.app.web import export_web
from voronerf.editing import open_run as open_parts
from voronerf.editing import place
from voronerf.nerf.cameras import Cameras, orbit_cameras

#: Pixels along a side of the images, the pictures and the video.
SIZE = 400
FRAMES, FPS = 48, 16
#: The CPU time of the video in seconds above which a slow field gets fewer frames, but at least ``FEWEST``.
LONGEST, FEWEST = 50.0, 8
#: Position and scale of the small copy of the scene, which stands on the globe of the built-in scene.
TOP, SCALE = (0.0, 0.0, 1.0), 0.35


def demo(out: Path | None = None, budget: float = 35.0) -> int:
    """Train a built-in scene for half a minute and show it: a picture, a video, its cells, a copy placed in it, a page.

    Args:
        out: A new run directory, which also gets the pictures and the video; default runs/demo, runs/demo-2, ...
        budget: Training time in seconds.
    """
    config = TrainConfig(data=f"builtin:{SIZE}", out=out, budget=budget, evaluations=1, eval_views=8)
    say(f"computing the built-in scene: 125 views of {SIZE} x {SIZE} pixels")
    scene = replace(load_scene(config.data), name="demo")
    config = choose_directory(config, scene.name)
    run = config.out
    assert run is not None
    check_video(run / "turn.mp4")
    scores = run_training(config, scene, panels=0, quiet=console.is_terminal)
    if not scores["complete"]:
        return 130
    try:
        show(run, scene, scores, budget)
    except (KeyboardInterrupt, SystemExit) as stop:  # Ctrl-C, SIGTERM
        say(f"stopped; the trained run is in {run}: {shlex.join(['voronerf', 'render', str(run)])} makes a video of it")
        return stop.code if isinstance(stop, SystemExit) and isinstance(stop.code, int) else 130
    return 0


def show(run: Path, scene: Scene, scores: dict[str, Any], budget: float) -> None:
    """Writes pictures, a video and a page into a trained run, and prints a line about each."""
    opened, score = open_run(run, scene=scene), f"{scores['psnr']:.1f} dB after {budget:g} s"
    started = time.process_time()
    save_picture(run / "turn.png", next(frames(opened, turn(FRAMES), [FRAMES // 8], score)))
    seconds = time.process_time() - started
    count = min(FRAMES, max(FEWEST, int(LONGEST / max(seconds, 1e-3))))
    if count < FRAMES:
        say(f"the video has {count} frames instead of {FRAMES}, since a frame takes {seconds:.1f} s of CPU time")
    numbers = tracked(range(count), "the video")
    write_video(run / "turn.mp4", frames(opened, turn(count), numbers, score), FPS * count / FRAMES)
    place(run, run, TOP, run / "placed", scale=SCALE)
    above = turn(FRAMES, height=0.3, distance=1.25)
    image = open_parts(run / "placed", scene=scene).render(above, FRAMES // 8, heaviest=False)
    save_picture(run / "placed.png", picture_of_colour(image.colour))
    path = sys.argv[0] if Path(sys.argv[0]).name == "voronerf" else "python -m voronerf"  # or .venv/bin/voronerf
    program = "voronerf" if shutil.which("voronerf") else path
    quoted = shlex.quote(str(run))
    xyz = " ".join(f"{x:g}" for x in TOP)
    say(
        f"{score} on {scores['views']} views it has not seen, {counted(scores['cells'], 'cell')}, "
        f"{scores['steps']:,} steps: {run}"
    )
    say(f"wrote {run / 'turn.png'} and {run / 'turn.mp4'}: the scene beside its cells in colour")
    say(f"wrote {run / 'placed.png'}: {program} place {quoted} {quoted} --at {xyz} --scale {SCALE:g}, without training")
    _, size = export_web(opened, run / "scene.html")
    say(f"wrote {run / 'scene.html'}, {size / 1e6:.1f} MB: the scene for any browser with WebGPU, also on a phone")
    has_viewer = importlib.util.find_spec("viser") is not None
    say(f"next: {program} {f'view {quoted}' if has_viewer else 'train --data DIR, with your pictures'}")
    say(f"open {run / 'scene.html'}")


def turn(count: int, *, height: float = 0.0, distance: float = 1.0) -> Cameras:
    """Returns an orbit around the built-in scene, raised by ``height``, with ``distance`` times the default radius."""
    return orbit_cameras(
        count,
        radius=3.9 * distance,
        elevation=25.0,
        width=SIZE,
        height=SIZE,
        focal=1.39 * SIZE,
        centre=(0.0, 0.0, 0.04 + height),
        start=20.0,
    )


def frames(run: Run, cameras: Cameras, numbers: Iterable[int], score: str) -> Iterator[Tensor]:
    """Yields a picture uint8 [h, w, 3] for each camera index in ``numbers``: the view, and its cells beside it."""
    for number in numbers:
        image = run.render(cameras, number)
        cells = run.diagram.locate(image.heaviest)
        yield contact_sheet(
            {
                f"{cameras.width} x {cameras.height}, {score}": picture_of_colour(image.colour),
                f"its {counted(run.diagram.num_cells, 'cell')}": picture_of_cells(cells, image.opacity, image.colour),
            }
        )
