"""A scene that changes: `Run.update` against training everything again, at equal process CPU time.

    python -m benchmarks.updating city --runs DIR
    python -m benchmarks.updating city --runs DIR --data builtin-city:3x3 --seconds 60 --seeds 1
    python -m benchmarks.updating lego --runs DIR --data LEGO --seconds 45 --downscale 4
    python -m benchmarks.updating lego --runs DIR --data LEGO --seconds 150 --downscale 2 --seeds 0 1
    python -m benchmarks.updating fox --runs DIR --data FOX --seconds 25 --downscale 4 --seeds 0 1
    python -m benchmarks.updating fox --runs DIR --data FOX --seconds 70 --downscale 1 --seeds 0 1

city: `builtin-city:4x4` with a block rebuilt. lego: the loader's bucket recoloured, in pictures edited by where a
trained run sees their pixels. fox: every other view first, the others later. Trainings that are in DIR already are not
made again; rows are added to the JSON.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.harness import metadata
from voronerf.app.run import Run, open_run
from voronerf.app.scenes import Scene, load_scene
from voronerf.app.scenes.scene import Split
from voronerf.app.train.config import TrainConfig
from voronerf.app.train.trainer import Trainer
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.renderer import render_camera

RESULT = Path(__file__).parent / "results" / "updating.json"
#: Where the bucket of Lego's loader is, and the most views of which pictures are compared.
BUCKET, VIEWS = torch.tensor([[-0.75, -1.25, 0.4], [0.75, -0.5, 1.2]]), 48


def train(scene: Scene, data: str, seconds: float, seed: int, downscale: int, out: Path) -> Run:
    if (out / "summary.json").is_file():
        return open_run(out, scene=scene)
    config = TrainConfig(data=data, downscale=downscale, out=out, budget=seconds, seed=seed, lpips=Path("off"))
    config = replace(config, evaluations=1, final_views=1, panels=0)
    Trainer(config, scene, clock=time.process_time).run()
    return open_run(out, scene=scene)


def views(scene: Scene, chosen: Tensor, test: Tensor | None = None) -> Scene:
    """A scene with some of its training views, and test views."""

    def part(split: Split, rows: Tensor) -> Split:
        names = ("poses", "intrinsics", "distortion", "models", "sizes")
        own = {name: getattr(split.cameras, name) for name in names}
        cameras = {name: None if value is None else value[rows] for name, value in own.items()}
        masks = None if split.masks is None else split.masks[rows]
        made = Cameras(width=split.cameras.width, height=split.cameras.height, **cameras)
        return Split(made, split.images[rows], tuple(split.names[i] for i in rows.tolist()), masks)

    return replace(scene, train=part(scene.train, chosen), test=scene.test if test is None else part(scene.test, test))


def scores(run: Run, scene: Scene, before: Scene) -> dict[str, float]:
    """PSNR of the test views of a scene, of their pixels that have changed, and of the others."""
    errors: dict[str, list[Tensor]] = {"changed": [], "unchanged": [], "all": []}
    white = scene.background_colour()
    for i in range(0, len(scene.test), max(1, len(scene.test) // VIEWS)):
        truth = scene.test.truth(i, white)
        changed = (truth - before.test.truth(i, white)).abs().amax(-1) > 0.03
        image = render_camera(run.renderer, scene, scene.test.cameras, i, heaviest=False).colour
        error = (image - truth).square().mean(-1)
        for name, rows in (("changed", changed), ("unchanged", ~changed), ("all", changed | ~changed)):
            errors[name].append(error[rows])
    return {
        name: round(-10 * math.log10(float(torch.cat(e).mean())), 3) for name, e in errors.items() if sum(map(len, e))
    }


def recoloured(scene: Scene, run: Run) -> Scene:
    """Lego with a bucket whose yellow is blue."""

    def edited(split: Split) -> Split:
        images = split.images.clone()
        for i in range(len(split)):
            seen = render_camera(run.renderer, scene, split.cameras, i)
            colour = images[i, ..., :3].float()
            inside = ((seen.heaviest >= BUCKET[0]) & (seen.heaviest <= BUCKET[1])).all(-1) & (seen.opacity > 0.5)
            yellow = inside & (colour[..., 0] > 1.3 * colour[..., 2] + 20)
            images[i, ..., :3][yellow] = images[i, ..., :3][yellow].flip(-1)
        return replace(split, images=images)

    return replace(scene, train=edited(scene.train), test=edited(scene.test))


def measure(
    kind: str, data: str, seconds: float, share: float, seed: int, downscale: int, folder: Path
) -> dict[str, Any]:
    said: list[str] = []
    if kind == "fox":
        scene = load_scene(data, downscale=downscale)
        every = torch.arange(len(scene.train))
        before, after = views(scene, every[::2]), views(scene, every[1::2])
        whole, share = scene, 1.0
    else:
        before = load_scene(data, downscale=downscale)
        after = load_scene(f"{data},rebuilt=5", downscale=downscale) if kind == "city" else before
    name = f"{Path(data).name.replace(':', '-')}-{seconds:g}-{seed}"
    old = train(before, data, seconds, seed, downscale, folder / f"{name}-old")
    if kind == "lego":
        after = recoloured(before, old)
    began = time.process_time()
    shutil.rmtree(folder / f"{name}-made", ignore_errors=True)
    given: dict[str, Any] = {"clock": time.process_time, "say": said.append, "seed": seed, "more": kind == "fox"}
    made = old.update(after, folder / f"{name}-made", seconds=share * seconds, **given)
    spent = time.process_time() - began
    total = (1 + share) * seconds if kind == "fox" else seconds
    every = whole if kind == "fox" else replace(after, box=before.box)
    again = train(every, data, total, seed, downscale, folder / f"{name}-again")
    rows = {name: scores(run, after, before) for name, run in (("old", old), ("updated", made), ("again", again))}
    cells = {"before": old.router.num_cells, "after": made.router.num_cells}
    size = list(old.scene.train.cameras.smallest)
    return {
        "data": Path(data).name,
        "size": size,
        "seed": seed,
        "said": said,
        "cells": cells,
        "seconds": {"old": seconds, "updated": spent, "again": total},
        "psnr": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=["city", "lego", "fox"])
    parser.add_argument("--data", default="builtin-city:4x4")
    parser.add_argument("--seconds", type=float, default=120)
    parser.add_argument("--share", type=float, default=0.1)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--runs", type=Path, required=True)
    given = parser.parse_args()
    torch.set_num_threads(1)
    stored = json.loads(RESULT.read_text())
    known, kinds = stored["results"], stored["metadata"].get("kinds", {})
    for seed in given.seeds:
        args = given.kind, given.data, given.seconds, given.share, seed, given.downscale, given.runs
        row = measure(*args)
        print(json.dumps(row, indent=1))
        same = ("data", "size", "seed")
        rest = [old for old in known.get(given.kind, []) if [old.get(k) for k in same] != [row[k] for k in same]]
        known[given.kind] = [*rest, row]
        kinds[given.kind] = metadata(command=__doc__)  # each of a machine of its own
        RESULT.write_text(json.dumps({"metadata": {"kinds": kinds}, "results": known}, indent=1) + "\n")


if __name__ == "__main__":
    main()
