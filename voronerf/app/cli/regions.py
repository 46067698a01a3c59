"""``voronerf regions``: the commands that train a large scene in parts."""

from __future__ import annotations

import shlex
from pathlib import Path

from voronerf.app.cli.display import busy, say
from voronerf.app.scenes import load_scene
from voronerf.app.scenes.regions import tiles


def regions(data: str, /, count: int, out: Path = Path("runs")) -> int:
    """Print commands that train a large scene in parts: one job for each box of the scene, then a join.

    The jobs need no communication, so they can run on one machine one after another, or on many machines. The boxes
    have equally many points of the sparse model or, without a model, equally many cameras. Each printed command takes
    further options of voronerf train, which should be the same in all of them and leave the coordinates of the scene as
    they are.

    Args:
        data: The scene, as for voronerf train.
        count: Number of boxes.
        out: Folder of the run directories that the commands name.
    """
    with busy(f"reading {data}"):
        boxes = tiles(load_scene(data), count)
    runs = [str(out / f"region-{number:0{len(str(count - 1))}}") for number in range(count)]
    for run, box in zip(runs, boxes, strict=True):
        corners = [f"{value:.6g}" for value in box.flatten().tolist()]
        say(shlex.join(["voronerf", "train", "--data", data, "--region", *corners, "--out", run]))
    if count > 1:
        say(shlex.join(["voronerf", "join", *runs, "--out", str(out / "joined")]))
    return 0
